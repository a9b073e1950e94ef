"""Tables of numbers in text files, with the separators, names and comments of many programs."""

import csv
import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.core.types import Array
from steelnb.io.encodings import decoded, plain_nan

HEAD_BYTES, COLUMNS_MAX = 1 << 16, 1000
"""The form of a table is found in its first bytes; no table of points or poses has so many columns."""
COMMENT = re.compile(rb"^[ \t]*(?://|%|#)", re.MULTILINE)
NOT_A_NUMBER = ("", "nan", "NaN", "NAN", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "NA", "N/A", "null", "NULL", "None")
UNITS = {
    "m": "m meter meters metre metres", "mm": "mm", "cm": "cm", "km": "km", "ft": "ft feet", "s": "s sec secs seconds",
    "ms": "ms msec msecs millisec milliseconds", "us": "us µs usec usecs microsec microseconds",
    "ns": "ns nsec nsecs nanosec nanosecs nanoseconds", "deg": "deg degree degrees °", "rad": "rad radian radians",
}  # fmt: skip
UNIT_OF = {word: unit for unit, words in UNITS.items() for word in words.split()}
QUOTED = re.compile('"[^"]*"')
DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Table:
    """Lines of numbers, from ``data`` on.

    ``columns``: fields a line, separated by ``separator`` (a blank stands for any white space), with the sign
    ``decimal``. ``names``: of the columns, in lower case, with ``_`` for all other signs, and ``units`` ("" if not
    given); both are empty without names. ``has_header``: the names stand in a line of their own, not in a comment.
    ``declared``: number of lines according to the first one; ``first``: number of the first line in the file.
    For tables without names, ``own``: all columns but an index and an empty last one; ``said``: the words of comments,
    in the form of names, whatever their number.
    """

    data: bytes
    columns: int
    separator: str = " "
    decimal: str = "."
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    has_header: bool = False
    declared: int | None = None
    first: int = 1
    own: tuple[int, ...] = ()
    said: tuple[str, ...] = ()

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

    def values(self, wanted: Sequence[int], rows: int | None = None) -> Array:
        """Columns ``wanted (C,)`` of all lines, or of the first ``rows``, ``(N, C)``; missing numbers are NaN.

        Raises ValueError that names the line which has another number of fields, or a text where a number is wanted.
        """
        if self.columns > 8 and self.columns * self.data.count(b"\n") > len(self.data):
            self._check((), rows)  # pandas would fill up short lines, in much memory
        self._check_signs(wanted)
        rows = rows if rows is None else min(rows, len(self.data))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about texts among the numbers of other columns
                table = pd.read_csv(
                    io.BytesIO(self.data), sep=self.separator.replace(" ", r"\s+"), decimal=self.decimal, header=None,
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
        return table[list(wanted)].to_numpy(np.float64)

    def _check(self, wanted: Sequence[int], rows: int | None) -> None:
        """Raise ValueError for the first line with too many or too few fields, or without a number that is wanted."""
        seen = 0
        for number, line in enumerate(self.data.splitlines(), self.first):
            text = line.partition(b"#")[0].decode("utf-8", "replace").strip()
            if not text:
                continue
            cells = _split(text, self.separator)
            if len(cells) != self.columns:
                raise ValueError(f"line {number} has {len(cells)} fields, {_quoted(text)}; expected {self.columns}")
            for cell in (cells[k] for k in wanted):
                if not _is_number(cell, self.decimal) and cell not in NOT_A_NUMBER:
                    raise ValueError(f"line {number}: {_quoted(cell)}; expected a number")
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
                cells = _split(line.decode("utf-8", "replace").replace('"', ""), self.separator)
                if len(cells) == self.columns and all(_is_number(cells[k], self.decimal) for k in wanted):
                    raise ValueError(f"line {number} begins like a comment, but has all {len(cells)} fields")


def read_table(path: Path) -> Table:
    """Find the form of the table in a file. Its separator is what stands in its first line of numbers.

    The names of the columns stand in the line before, or in a comment before (``#``, ``//``, ``%``) that has as many
    words as the line has numbers. A first line with one integer is a count, and one with 0, 1, 2, … numbers the
    columns. Raises ValueError.
    """
    data = plain_nan(decoded(path.read_bytes()))
    if b"/" in data or b"%" in data:
        data = COMMENT.sub(b"#", data)
    lines, content = _head(data)
    if not content:
        raise ValueError("no line of numbers")
    texts = [line.decode("utf-8", "replace").strip() for line in lines]
    comments = [text.lstrip("#").strip() for text in texts[: content[0]] if text.startswith("#")]
    bodies = [texts[k].partition("#")[0].strip() for k in content]
    declared, names, heading_at = None, None, 0
    # A first line with one integer is a count, unless the table has one column.
    if len(bodies) > 1 and re.fullmatch("[0-9]{1,18}", bodies[0]) and re.search(r"\S[\s,;]+\S", bodies[1]):
        declared = int(bodies[0])
        content, bodies = content[1:], bodies[1:]
    heading = _split(bodies[0], "\t" if "\t" in bodies[0] else _separator(bodies[0])[0])
    is_index = len(bodies) > 1 and heading[0] == "" and _counts(heading[1:])  # as pandas writes it
    if is_index or (_counts(heading) and "," in bodies[0] and "." in "".join(bodies[1:2])):
        content, bodies = content[1:], bodies[1:]
    elif not any(_is_number(cell, decimal) for cell in heading for decimal in ".,"):
        names, heading_at = heading, content[0]
        content, bodies = content[1:], bodies[1:]
        if not bodies:
            raise ValueError(f"{_quoted(' '.join(heading))} and no line of numbers after it")
    separator, decimal = _separator(bodies[0])
    if "\t" in bodies[0] and names and "\t" in texts[content[0] - 1]:
        separator = "\t"  # the words of a name, and missing numbers, are kept together
    decimal = "," if _has_decimal_commas(bodies, separator) else decimal
    cells = _split(bodies[0], separator)
    if not any(_is_number(cell, decimal) for cell in cells):
        raise ValueError(f"line {content[0] + 1}: {_quoted(bodies[0])}; expected numbers")
    if len(cells) > COLUMNS_MAX:
        raise ValueError(f"line {content[0] + 1} has {len(cells)} numbers; expected those of one point or pose a line")
    is_open = len(cells) > 1 and not cells[-1]
    if names is not None and len(names) not in (len(cells), len(cells) - is_open):
        raise ValueError(f"{len(names)} names of columns, but {len(cells)} fields in line {content[0] + 1}")
    first = content[0] if names is None else heading_at + 1  # a label below it may look like a comment
    said = [_words(comment) for comment in reversed(comments)]
    in_comment = next((words for words in said if len(words) == len(cells)), [])
    plain = [_plain(name) for name in (in_comment if names is None else names)]
    begin = sum(map(len, lines[:first]))
    return Table(
        data[begin:] if begin else data, len(cells), separator, decimal, tuple(name for name, _ in plain),
        tuple(unit for _, unit in plain), names is not None, declared, first + 1,
        tuple(range(is_index, len(cells) - is_open)), tuple(_plain(word)[0] for words in said for word in words),
    )  # fmt: skip


def _head(data: bytes) -> tuple[list[bytes], list[int]]:
    """The first lines of a table, at least two with more than a comment, and the numbers of those."""
    size = HEAD_BYTES
    while True:
        lines = data[:size].splitlines(keepends=True)
        lines = lines[:-1] if len(data) > size and len(lines) > 1 else lines
        content = [k for k, line in enumerate(lines) if line.partition(b"#")[0].strip()]
        if len(content) > 1 or size >= len(data):
            return lines, content
        size *= 4


def _counts(cells: list[str]) -> bool:
    """Whether these are 0, 1, 2, …: columns without names."""
    return len(cells) > 2 and cells == [str(k) for k in range(len(cells))]


def _has_decimal_commas(lines: list[str], separator: str) -> bool:
    """Whether numbers in these lines have commas instead of points: between other separators or in quotes."""
    pattern = r'"[+-]?\d+,\d+' if separator == "," else r"\d,\d"
    if not any(re.search(pattern, line) for line in lines) or any(re.search(r"\d\.\d", line) for line in lines):
        return False
    return separator != " " or all(DECIMAL_COMMA.fullmatch(word) for line in lines for word in line.split())


def _words(comment: str) -> list[str]:
    """The words of a comment that could be names of columns: one of them is an x; units stay with their names."""
    comment = comment.rpartition(":")[2].replace("|", " ").strip()
    words = _split(re.sub(r"\s+([\[(])", r"\1", comment), _separator(comment)[0])
    return words if any(_plain(word)[0].endswith("x") for word in words) else []


def _plain(name: str) -> tuple[str, str]:
    """A column's name and unit: "p_RS_R_x [m]" → ("p_rs_r_x", "m"), "stamp_ns" → ("stamp", "ns"), "X" → ("x", "")."""
    name, _, rest = name.strip("\"' \t").lower().replace("(", "[").partition("[")
    bracket = rest.rstrip("]) ")
    words = [word for word in re.split(r"[\W_]+", name) if word]
    if bracket and not bracket.isdecimal():
        return "_".join(words), UNIT_OF.get(bracket.strip(), bracket)
    words += [bracket] if bracket else []
    unit = UNIT_OF.get(words[-1], "") if words else ""
    return "_".join(words[:-1] if unit else words), unit


def _separator(line: str) -> tuple[str, str]:
    """Separator and decimal sign of a line of numbers."""
    line = QUOTED.sub("0", line)
    if ";" in line:
        return ";", "."
    words = line.split()
    if "," in line and len(words) > 2 and all(DECIMAL_COMMA.fullmatch(word) for word in words):
        return " ", ","
    if "," in line:
        return ",", "."
    return " ", "."


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":  # what pandas takes for white space
        return re.split(r"[ \t]+", line.strip())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return "_" not in cell and (decimal == "." or "." not in cell)


def _quoted(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:40]}…")
