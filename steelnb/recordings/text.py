"""Points from text: one point a line, in whatever dialect the exporting program speaks."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.datatypes import Array
from steelnb.errors import EmptyCloudError, FileContentError

NOT_A_NUMBER = ("nan", "-nan", "+nan", "NaN", "-NaN", "NAN", "Nan", "nan(ind)", "-nan(ind)")
_SAMPLE_BYTES = 1 << 16
_COMMENTS = ("#", "//")
_AXIS_NAME = re.compile(r"\W*([xyz])(?:_?m|\W*m?\W*)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class TextLayout:
    """How to read the lines: ``skip`` lines come first; ``columns`` are those of x, y and z; ``separator`` None means
    blanks and tabs; ``rows`` is the number of points that the file promises, None where it promises nothing."""

    skip: int = 0
    separator: str | None = None
    decimal: str = "."
    columns: tuple[int, int, int] = (0, 1, 2)
    rows: int | None = None

    def split(self, line: str) -> list[str]:
        """The fields of a line, without the blanks around them and without a comment behind them."""
        return [field.strip() for field in line.partition("#")[0].strip().split(self.separator)]

    def numbers(self, line: str) -> list[float]:
        """x, y and z of a line; raises ValueError or IndexError where they are not three numbers."""
        fields = self.split(line)
        return [float(fields[column].replace(self.decimal, ".")) for column in self.columns]

    @property
    def expected(self) -> str:
        between = {None: "blanks or tabs", ";": "semicolons", ",": "commas", "\t": "tabs"}[self.separator]
        return f"numbers between {between}, with x, y and z in columns {', '.join(str(c + 1) for c in self.columns)}"


def read_text(path: Path) -> Array:
    """Points ``(N, 3)`` of a text file of unknown dialect, NaN where NaN is written; see `sniff` and `read_lines`."""
    return read_lines(path, sniff(path))


def read_lines(path: Path, layout: TextLayout) -> Array:
    """Points ``(N, 3)`` of the lines that a layout describes.

    A last line without a line end is refused where it has fewer columns or fewer decimals than 95 % of the others: it
    has then been cut in the middle of a number. Raises `FileContentError` with the number of the line.
    """
    try:
        frame = pd.read_csv(
            path, sep=layout.separator or r"\s+", decimal=layout.decimal, header=None, usecols=sorted(layout.columns),
            dtype=np.float64, skiprows=layout.skip, nrows=layout.rows, comment="#", skipinitialspace=True,
            quoting=csv.QUOTE_NONE, keep_default_na=False, na_values=list(NOT_A_NUMBER), encoding="utf-8",
            encoding_errors="replace",
        )  # fmt: skip
    except pd.errors.EmptyDataError:
        raise EmptyCloudError(f"{path}: no line with a point") from None
    except ValueError as fault:  # pandas' ParserError is one
        _refuse_bad_line(path, layout)
        raise FileContentError(f"{path}: {str(fault).splitlines()[0]}; expected {layout.expected}") from None
    points = np.ascontiguousarray(frame[list(layout.columns)].to_numpy(dtype=np.float64))
    if np.isnan(points).any():  # written as NaN, or a line with too few columns, which pandas fills up
        _refuse_bad_line(path, layout)
    if layout.rows is not None and len(points) != layout.rows:
        raise FileContentError(f"{path}: {len(points)} points, expected the {layout.rows} that its header promises")
    _refuse_cut_end(path, layout)
    return points


def sniff(path: Path) -> TextLayout:
    """Find header, separator, decimal sign and the columns of x, y and z from the start of a file.

    Comment lines (``#``, ``//``), a count of points on its own line (PTS) and one line of column names may come first.
    Columns named x, y and z are used wherever they are; without such names, the first three. Raises `EmptyCloudError`,
    or `FileContentError` where the file is not text or its first line of data holds no three numbers.
    """
    with path.open("rb") as file:
        sample = file.read(_SAMPLE_BYTES)
    if b"\0" in sample:
        raise FileContentError(f"{path}: holds zero bytes; expected text in UTF-8 or ASCII")
    lines = sample.decode("utf-8-sig", errors="replace").splitlines()
    names: str | None = None
    named_at = 0
    rows: int | None = None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        comment = next((mark for mark in _COMMENTS if text.startswith(mark)), "")
        if not text or comment:
            names = text.removeprefix(comment) if comment and _axis_columns(text.removeprefix(comment)) else names
            continue
        if text.isdigit() and rows is None:
            rows = int(text)
            continue
        if not named_at and not _starts_with_number(text):
            names, named_at = text, number
            continue
        separator, decimal = _separators("\n".join(lines[number - 1 : -1] or [line]))
        layout = TextLayout(number - 1, separator, decimal, rows=rows)
        columns = _axis_columns(names) if names else None
        if columns is not None:
            layout = TextLayout(number - 1, separator, decimal, columns, rows)
        try:
            layout.numbers(text)
        except (ValueError, IndexError):
            raise _bad_line(path, number, text, layout) from None
        return layout
    if len(sample) == _SAMPLE_BYTES:
        raise FileContentError(f"{path}: no line of numbers in its first {_SAMPLE_BYTES} bytes; expected x, y and z")
    raise EmptyCloudError(f"{path}: no line with a point")


def _starts_with_number(text: str) -> bool:
    try:
        float(re.split(r"[\s;,]", text, maxsplit=1)[0])
    except ValueError:
        return False
    return True


def _separators(data: str) -> tuple[str | None, str]:
    first = data.partition("\n")[0]
    if ";" in first:
        return ";", "," if "," in data and "." not in data else "."
    if "," not in first:
        return None, "."
    fields = first.split()
    if len(fields) >= 3 and all(_DECIMAL_COMMA.fullmatch(field) for field in fields[:3]):
        return None, ","
    return ",", "."


def _axis_columns(names: str) -> tuple[int, int, int] | None:
    separator = next((mark for mark in ";,\t" if mark in names), None)
    fields = [field for field in names.strip().split(separator) if separator or not re.match(r"[\[(]", field)]
    found = {match[1].lower(): k for k, field in enumerate(fields) if (match := _AXIS_NAME.fullmatch(field.strip()))}
    return (found["x"], found["y"], found["z"]) if len(found) == 3 else None


def _data_lines(path: Path, layout: TextLayout) -> Iterator[tuple[int, str]]:
    with path.open(encoding="utf-8", errors="replace") as file:
        found = 0
        for number, line in enumerate(file, start=1):
            if number > layout.skip and line.partition("#")[0].strip():
                yield number, line
                found += 1
                if found == layout.rows:
                    return


def _refuse_bad_line(path: Path, layout: TextLayout) -> None:
    """The slow way, to name the first line that is at fault."""
    for number, line in _data_lines(path, layout):
        try:
            layout.numbers(line)
        except (ValueError, IndexError):
            raise _bad_line(path, number, line, layout) from None


def _bad_line(path: Path, number: int, line: str, layout: TextLayout) -> FileContentError:
    text = line.strip()
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    return FileContentError(f"{path}, line {number}: {shown!r}; expected {layout.expected}")


def _refuse_cut_end(path: Path, layout: TextLayout) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(size - _SAMPLE_BYTES, 0))
        tail = file.read().decode("utf-8", errors="replace")
    if tail.endswith(("\n", "\r")):
        return
    *lines, end = tail.splitlines()[layout.skip if size <= _SAMPLE_BYTES else 1 :]
    column = max(layout.columns)
    last = layout.split(end)
    others = [fields for fields in map(layout.split, lines) if len(fields) > column]
    if len(last) != column + 1 or len(others) < 2:
        return  # something stands behind the coordinates, so they are whole; or there is nothing to judge by

    def content(fields: list[str]) -> tuple[int, int]:
        return len(fields), len(fields[column].partition(layout.decimal)[2])

    if np.mean([content(fields) <= content(last) for fields in others]) < 0.05:
        raise FileContentError(
            f"{path}: its last line, {end.strip()!r}, has no line end and less in it than the others; "
            "expected a complete line (add a line end if it is)"
        )
