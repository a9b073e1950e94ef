"""Points from text, one a line: pandas reads the numbers, after one guess of header, separator and columns."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.errors import EmptyCloudError, FileContentError
from steelnb.files import open_lines
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


def text_chunks(path: Path, layout: TextLayout, size: int) -> Iterator[Array]:
    """Points ``(n, 3)``, at most ``size`` at a time, NaN where NaN is written.

    Raises `EmptyCloudError`, `FileContentError` for another number of points than promised and for a last number that
    is cut short, and ValueError, as pandas words it, for what is no number.
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
                count += len(frame)
                yield np.ascontiguousarray(frame[list(layout.columns)].to_numpy(dtype=np.float64))
    except pd.errors.EmptyDataError:
        raise EmptyCloudError(f"{path}: no line with a point") from None
    if layout.rows is not None and count != layout.rows:
        raise FileContentError(f"{path}: {count} points, expected the {layout.rows} that its header promises")
    _refuse_cut_end(path, layout)


def sniff(path: Path) -> TextLayout:
    """Find header, separator and the columns of x, y and z from the start of a file.

    Comment lines (``#``, ``//``), a count of points on its own line (PTS) and one line of column names may come first.
    Columns named x, y and z are used wherever they are; without such names, the first three. A comma is a decimal sign
    beside semicolons or tabs. Raises `EmptyCloudError`, or `FileContentError` where the file is not text.
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
            return TextLayout(number - 1, separator, decimal, columns or (0, 1, 2), rows)
    raise EmptyCloudError(f"{path}: no line with a point in its first {len(sample)} bytes")


def _named_columns(names: str) -> tuple[int, int, int] | None:
    separator = next((mark for mark in ";,\t" if mark in names), None)
    fields = [field for field in names.strip().split(separator) if separator or not re.match(r"[\[(]", field)]
    found = {match[1].lower(): k for k, field in enumerate(fields) if (match := _AXIS_NAME.fullmatch(field.strip()))}
    return (found["x"], found["y"], found["z"]) if len(found) == 3 else None


def _refuse_cut_end(path: Path, layout: TextLayout) -> None:
    """Refuse a last line without line end whose last coordinate has fewer decimals than in the lines before it."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _SAMPLE_BYTES, 0))
        *lines, last = file.read().decode("utf-8", errors="replace").split("\n")
    column = max(layout.columns)
    fields = [line.split(layout.separator) for line in [*lines[-100:], last] if _NUMBER.match(line.strip())]
    decimals = [len(each[column].strip().partition(layout.decimal)[2]) for each in fields if len(each) > column]
    if last.strip() and len(decimals) > 1 and decimals[-1] < min(decimals[:-1]):
        raise FileContentError(
            f"{path}: its last line, {last[:60]!r}, has no line end and fewer decimals than the others; "
            "expected a complete line (add a line end if it is)"
        )
