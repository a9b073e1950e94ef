"""Tables of numbers in text files, with the separators, names and comments of many programs."""

import codecs
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

HEAD_BYTES, COLUMNS_MAX = 1 << 16, 1000
"""The form of a table is found in its first bytes; no table of points or poses has so many columns."""
MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
WINDOWS_NAN = re.compile(rb"-?1\.#(?:IND|QNAN|SNAN|INF)\d*")
COMMENT = re.compile(rb"^[ \t]*(?://|%|#)", re.MULTILINE)
NOT_A_NUMBER = ("", "nan", "NaN", "NAN", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "NA", "N/A", "null", "NULL", "None")
UNITS = {
    "m": "m meter meters metre metres", "mm": "mm", "cm": "cm", "km": "km", "ft": "ft feet", "s": "s sec secs seconds",
    "ms": "ms msec msecs millisec milliseconds", "us": "us µs usec usecs microsec microseconds",
    "ns": "ns nsec nsecs nanosec nanosecs nanoseconds", "deg": "deg degree degrees °", "rad": "rad radian radians",
}  # fmt: skip
UNIT_OF = {word: unit for unit, words in UNITS.items() for word in words.split()}
DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Table:
    """Lines of numbers, from ``data`` on.

    ``columns``: fields a line, separated by ``separator`` (a blank stands for any white space), with the sign
    ``decimal``. ``names``: of the columns, in lower case, with ``_`` for all other signs, and ``units`` ("" if not
    given); both are empty without names. ``has_header``: the names stand in a line of their own, not in a comment.
    ``declared``: number of lines according to the first one; ``first``: number of the first line in the file.
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
            raise ValueError("no lines of numbers that can be read") from None
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


def read_table(path: Path) -> Table:
    """Find the form of the table in a file. Its separator is what stands in its first line of numbers.

    The names of the columns stand in the line before, or in a comment before (``#``, ``//``, ``%``) that has as many
    words as the line has numbers. A first line with one integer is a count. Raises ValueError.
    """
    data = path.read_bytes()
    for mark, encoding in MARKS.items():
        if data.startswith(mark):
            data = data.removeprefix(mark)
            data = data if encoding == "utf-8" else data.decode(encoding, "replace").encode()
    if b"#" in data:  # NaN and infinity of some programs for Windows
        data = WINDOWS_NAN.sub(b"nan", data)
    if b"/" in data or b"%" in data:
        data = COMMENT.sub(b"#", data)
    lines = data[:HEAD_BYTES].splitlines(keepends=True)
    lines = lines[:-1] if len(data) > HEAD_BYTES and len(lines) > 1 else lines
    content = [k for k, line in enumerate(lines) if line.partition(b"#")[0].strip()]
    if not content:
        raise ValueError("no line of numbers")
    texts = [line.decode("utf-8", "replace").strip() for line in lines]
    comments = [text.lstrip("#").strip() for text in texts[: content[0]] if text.startswith("#")]
    bodies = [texts[k].partition("#")[0].strip() for k in content]
    declared, names = None, None
    # A first line with one integer is a count, unless the table has one column.
    if len(bodies) > 1 and re.fullmatch("[0-9]{1,18}", bodies[0]) and re.search(r"\S[\s,;]+\S", bodies[1]):
        declared = int(bodies[0])
        content, bodies = content[1:], bodies[1:]
    heading = _split(bodies[0], "\t" if "\t" in bodies[0] else _separator(bodies[0])[0])
    if not any(_is_number(cell, decimal) for cell in heading for decimal in ".,"):
        names = heading
        content, bodies = content[1:], bodies[1:]
        if not bodies:
            raise ValueError(f"{_quoted(' '.join(heading))} and no line of numbers after it")
    separator, decimal = _separator(bodies[0])
    if "\t" in bodies[0] and names and "\t" in texts[content[0] - 1]:
        separator = "\t"  # the words of a name, and missing numbers, are kept together
    if separator in ";\t" and any(re.search(r"\d,\d", body) for body in bodies):
        decimal = "." if any(re.search(r"\d\.\d", body) for body in bodies) else ","
    cells = _split(bodies[0], separator)
    if len(cells) > COLUMNS_MAX or not any(_is_number(cell, decimal) for cell in cells):
        raise ValueError(f"line {content[0] + 1}: {_quoted(bodies[0])}; expected numbers")
    if names is not None and len(names) != len(cells) - (len(cells) > 1 and not cells[-1]):
        raise ValueError(f"{len(names)} names of columns, but {len(cells)} fields in line {content[0] + 1}")
    in_comment = next((words for words in map(_words, reversed(comments)) if len(words) == len(cells)), [])
    plain = [_plain(name) for name in (in_comment if names is None else names)]
    begin = sum(map(len, lines[: content[0]]))
    return Table(
        data[begin:] if begin else data, len(cells), separator, decimal, tuple(name for name, _ in plain),
        tuple(unit for _, unit in plain), names is not None, declared, content[0] + 1,
    )  # fmt: skip


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
    if ";" in line:
        return ";", "."
    words = line.split()
    if "," in line and len(words) > 2 and all(DECIMAL_COMMA.fullmatch(word) for word in words):
        return " ", ","
    if "," in line:
        return ",", "."
    return " ", "."


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return decimal == "." or "." not in cell


def _quoted(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:40]}…")
