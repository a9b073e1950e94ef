"""Points from text, one a line: pandas reads the numbers, after one guess of header, separator and columns."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.errors import EmptyCloudError, FileContentError
from steelnb.files import open_lines, text_lines
from steelnb.types import Array

_NAN = ("nan", "-nan", "NaN", "-NaN", "NAN")
_SAMPLE_BYTES = 1 << 16
_AXIS_NAME = re.compile(r"\W*([xyz])(?:_?m|\W*m?\W*)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(\.?\d|nan|inf)", re.IGNORECASE)


@dataclass(frozen=True)
class TextLayout:
    """``skip`` lines come first; ``columns`` are those of x, y and z; ``separator`` None means blanks and tabs;
    ``rows`` is the number of points that the file promises, None where it promises nothing."""

    skip: int = 0
    separator: str | None = None
    decimal: str = "."
    columns: tuple[int, int, int] = (0, 1, 2)
    rows: int | None = None

    def fields(self, line: str) -> list[str]:
        """Fields of a line, without the blanks around them and without a comment behind them."""
        return [field.strip() for field in line.partition("#")[0].strip().split(self.separator)]

    def check(self, path: Path, number: int, line: str) -> None:
        """Raise `FileContentError` unless line ``number`` has numbers in the columns of x, y and z."""
        try:
            for column in self.columns:
                float(self.fields(line)[column].replace(self.decimal, "."))
        except (ValueError, IndexError):
            where = ", ".join(str(column + 1) for column in self.columns)
            raise FileContentError(
                f"{path}, line {number}: {line.strip()[:60]!r}; expected numbers between "
                f"{repr(self.separator) if self.separator else 'blanks or tabs'}, with x, y and z in columns {where}"
            ) from None


def text_chunks(path: Path, layout: TextLayout, size: int) -> Iterator[Array]:
    """Points ``(n, 3)``, at most ``size`` at a time, NaN where NaN is written.

    Raises `FileContentError` with the number of the first bad line, for fewer points than promised, and for a last
    number that is cut short.
    """
    import pandas as pd

    count = 0
    if layout.rows == 0:
        return
    try:
        with open_lines(path) as file, pd.read_csv(
            file, sep=layout.separator or r"\s+", decimal=layout.decimal, header=None, usecols=sorted(layout.columns),
            dtype=np.float64, skiprows=layout.skip, nrows=layout.rows, comment="#", skipinitialspace=True,
            quoting=csv.QUOTE_NONE, keep_default_na=False, na_values=list(_NAN), encoding="utf-8",
            encoding_errors="replace", chunksize=size,
        ) as frames:  # fmt: skip
            for frame in frames:
                points = np.ascontiguousarray(frame[list(layout.columns)].to_numpy(dtype=np.float64))
                if np.isnan(points).any():  # written as NaN, or a line with too few columns, which pandas fills up
                    _refuse_bad_line(path, layout)
                count += len(points)
                yield points
    except pd.errors.EmptyDataError:
        raise EmptyCloudError(f"{path}: no line with a point") from None
    except ValueError:  # pandas' ParserError is one
        _refuse_bad_line(path, layout)
        raise
    if layout.rows is not None and count != layout.rows:
        raise FileContentError(f"{path}: {count} points, expected the {layout.rows} that its header promises")
    _refuse_cut_end(path, layout)


def sniff(path: Path) -> TextLayout:
    """Find header, separator and the columns of x, y and z from the start of a file.

    Comment lines (``#``, ``//``), a count of points on its own line (PTS) and one line of column names may come first.
    Columns named x, y and z are used wherever they are; without such names, the first three. A comma is a decimal sign
    beside semicolons or tabs. Raises `EmptyCloudError`, or `FileContentError` where the file is not text or its first
    line of data holds no three numbers.
    """
    with open_lines(path) as file:
        sample = file.read(_SAMPLE_BYTES)
    columns: tuple[int, int, int] | None = None
    rows: int | None = None
    named = False
    for number, line in enumerate(sample.decode("utf-8-sig", errors="replace").splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith(("#", "//")):
            columns = _named_columns(text.lstrip("#/")) or columns
        elif text.isdigit() and rows is None:
            rows = int(text)
        elif not named and not _NUMBER.match(text):
            columns, named = _named_columns(text), True
        else:
            separator = ";" if ";" in text else "," if "," in text and "\t" not in text else None
            decimal = "," if separator != "," and "," in text else "."
            layout = TextLayout(number - 1, separator, decimal, columns or (0, 1, 2), rows)
            layout.check(path, number, line)
            return layout
    raise EmptyCloudError(f"{path}: no line with a point in its first {len(sample)} bytes")


def _named_columns(names: str) -> tuple[int, int, int] | None:
    separator = next((mark for mark in ";,\t" if mark in names), None)
    fields = [field for field in names.strip().split(separator) if separator or not re.match(r"[\[(]", field)]
    found = {match[1].lower(): k for k, field in enumerate(fields) if (match := _AXIS_NAME.fullmatch(field.strip()))}
    return (found["x"], found["y"], found["z"]) if len(found) == 3 else None


def _refuse_bad_line(path: Path, layout: TextLayout) -> None:
    """Name the first line that is at fault, the slow way."""
    found = 0
    for number, line in text_lines(path):
        if number > layout.skip and found != layout.rows:
            layout.check(path, number, line)
            found += 1


def _refuse_cut_end(path: Path, layout: TextLayout) -> None:
    """Refuse a last line without line end that has fewer columns or decimals than 95 % of those before it."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _SAMPLE_BYTES, 0))
        tail = file.read().decode("utf-8", errors="replace")
    column = max(layout.columns)
    lines = [layout.fields(line) for line in tail.splitlines() if _NUMBER.match(line.strip())]
    *others, last = [fields for fields in lines if len(fields) > column] or [[]]
    if tail.endswith(("\n", "\r")) or len(last) != column + 1 or len(others) < 2:
        return  # the coordinates of the last line are whole, or there is nothing to judge them by
    shown = [(len(fields), len(fields[column].partition(layout.decimal)[2])) for fields in (*others, last)]
    if shown[-1] < sorted(shown[:-1])[len(others) // 20]:
        raise FileContentError(
            f"{path}: its last line, {last}, has no line end and less in it than the others; "
            "expected a complete line (add a line end if it is)"
        )
