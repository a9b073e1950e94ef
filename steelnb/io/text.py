"""Tables of numbers in text files: their lines, fields and values."""

import csv
import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np
import pandas as pd

from steelnb.core.checks import shown
from steelnb.core.types import Array

NOT_A_NUMBER = ("", "nan", "NaN", "NAN", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "NA", "N/A", "null", "NULL", "None")


@dataclass(frozen=True)
class Table:
    """Lines of numbers, from ``data`` on.

    ``columns``: fields a line, separated by ``separator`` (a blank stands for any white space). ``names``: of the
    columns, in lower case, with ``_`` for all other signs, and ``units`` ("" if not given); both are empty without
    names. ``has_header``: the names stand in a line of their own, not in a comment.
    ``declared``: number of lines according to the first one; ``first``: number of the first line in the file.
    ``has_title``: other words stand before the numbers. For tables without names, ``own``: all columns but an index and
    an empty last one; ``said``: the words of comments, in the form of names, whatever their number.
    """

    data: bytes
    columns: int
    separator: str = " "
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    has_header: bool = False
    declared: int | None = None
    first: int = 1
    own: tuple[int, ...] = ()
    said: tuple[str, ...] = ()
    has_title: bool = False

    def find(self, *patterns: str) -> int | None:
        """Number of the column whose name matches the first of these patterns that any name matches, or None.

        Raises ValueError if two names match it.
        """
        for pattern in patterns:
            found = [k for k, name in enumerate(self.names) if re.fullmatch(pattern, name)]
            if len(found) > 1:
                raise ValueError(f"columns {self.names[found[0]]} and {self.names[found[1]]}; expected one of the two")
            if found:
                return found[0]
        return None

    def values(self, wanted: Sequence[int], rows: int | None = None, more: Sequence[int] = ()) -> Array:
        """Columns ``wanted (C,)`` of all lines, or of the first ``rows``, ``(N, C or more)``; missing numbers are NaN.

        Those of ``more`` follow, up to the first with a text. Raises ValueError that names the line which has another
        number of fields, or a text where a number is wanted.
        """
        if self.columns > 8 and self.columns * self.data.count(b"\n") > len(self.data):
            self._check((), rows)  # pandas would fill up short lines, in much memory
        self._check_signs(wanted)
        rows = rows if rows is None else min(rows, len(self.data))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about texts among the numbers of other columns
                table = pd.read_csv(
                    io.BytesIO(self.data), sep=self.separator.replace(" ", r"\s+"), header=None,
                    comment="#", nrows=rows, dtype=dict.fromkeys(wanted, np.float64), keep_default_na=False,
                    na_values=NOT_A_NUMBER, encoding_errors="replace",
                )  # fmt: skip
        except (ValueError, OverflowError):  # pandas names neither the line nor the text
            self._check(wanted, rows)
            raise ValueError(f"no lines of numbers that can be read from line {self.first} on") from None
        if len(table.columns) != self.columns or table.iloc[:, -1].isna().any():  # short lines end in NaN
            self._check((), rows)
        if self.declared is not None and self.declared != len(table):
            raise ValueError(f"{len(table)} lines of numbers; expected {self.declared}, as its first line says")
        numeric = takewhile(lambda k: table[k].dtype.kind in "iuf", more)
        return table[[*wanted, *numeric]].to_numpy(np.float64)

    def texts(self, column: int) -> list[str]:
        """The fields of a column as they are written."""
        lines = (line.partition(b"#")[0].decode("utf-8", "replace") for line in self.data.splitlines())
        return [split_cells(line, self.separator)[column].strip('"') for line in lines if line.strip()]

    def _check(self, wanted: Sequence[int], rows: int | None) -> None:
        """Raise ValueError for the first line with too many or too few fields, or without a number that is wanted."""
        seen = 0
        for number, line in enumerate(self.data.splitlines(), self.first):
            text = line.partition(b"#")[0].decode("utf-8", "replace").strip()
            if not text:
                continue
            cells = split_cells(text, self.separator)
            if len(cells) != self.columns:
                raise ValueError(f"line {number} has {len(cells)} fields, {shown(text)}; expected {self.columns}")
            for cell in (cells[k] for k in wanted):
                if not is_number(cell) and cell not in NOT_A_NUMBER:
                    raise ValueError(f"line {number}: {shown(cell)}; expected a number")
            seen += 1
            if seen == rows:
                return

    def _check_signs(self, wanted: Sequence[int]) -> None:
        """Raise ValueError for lines that pandas drops silently: those after a quotation mark that is not closed, and
        one whose label begins with the sign of a comment."""
        quotes, labels = b'"' in self.data, b"#" in self.data and self.separator != " " and 0 not in wanted
        for number, line in enumerate(self.data.splitlines() if quotes or labels else (), self.first):
            if line.partition(b"#")[0].count(b'"') % 2:
                raise ValueError(f"line {number} has a quotation mark that is not closed")
            if labels and line.lstrip().startswith(b"#"):
                cells = split_cells(line.decode("utf-8", "replace").replace('"', ""), self.separator)
                if len(cells) == self.columns and all(is_number(cells[k]) for k in wanted):
                    raise ValueError(f"line {number} begins like a comment, but has all {len(cells)} fields")


def split_cells(line: str, separator: str) -> list[str]:
    """The fields of a line."""
    if separator == " ":  # what pandas takes for white space
        return re.split(r"[ \t]+", line.strip())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def is_number(cell: str) -> bool:
    """Whether a field is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell
