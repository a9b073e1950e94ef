"""Numbers in sentences, and the files of results that they come from."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

SCALES = {
    "mm": (1e3, 1.0), "cm": (1e2, 0.1), "m": (1.0, 1e-3), "%": (1e2, 1.0), "ms": (1.0, 1e3), "s": (1.0, 1e-3),
    "°": (1.0, np.degrees(1.0)), "": (1.0,),
}  # fmt: skip
"""Unit of a sentence → factors of values in a file, which are in metres or millimetres, shares or percent, …"""
NUMBER = re.compile(r"(?<![\w.])(?:\d[\d,]*\d|\d)(?:\.\d+)?(?!\w|-\w)|(?<![\w.])\.\d+")
UNIT = re.compile(r"\s?(mm|cm|ms|m|s|%|°)(?![\w/])")
LIST = re.compile(r"(?:\s|,|;|–|−|\+|/|and|to|or|times|at most)*")
NO_RESULTS = re.compile(
    r"(?i)\]\([^)]*\)|`[^`]*`|https?://\S+|\$[^$]*\$"
    r"|\b(?:figures?|sections?|notebooks?|equations?|starling|seeds?|chapters?)\s\[?[\d.]+(?:(?:, | and | to )[\d.]+)*"
)
"""Links, code, formulas, and numbers that are names."""


class Stated(NamedTuple):
    """A number as written, and its unit: the one that follows it, or the list that it is in."""

    text: str
    unit: str


def stated_numbers(text: str) -> list[Stated]:
    """The numbers of a text in order, without those that are names or code."""
    text, unit, after = NO_RESULTS.sub(" _ ", text), "", len(text)
    numbers: list[Stated] = []
    for match in reversed(list(NUMBER.finditer(text))):
        own = UNIT.match(text, match.end())
        if own or not LIST.fullmatch(text, match.end(), after):
            unit = own[1] if own else ""
        numbers.append(Stated(match[0], unit))
        after = match.start()
    return numbers[::-1]


def value_of(source: str, root: Path) -> float:
    """The value that a source names. Parts are separated by `` | ``, files are given from the root:

    - ``table.csv | query of pandas | column``, also ``.parquet``, and a fourth part for several rows: ``min``, ``max``,
      ``mean``, ``median``, ``sum``, ``count`` or ``nunique``; an empty query stands for all rows;
    - ``metrics.json | key``;
    - ``page.md | text of one row | head of a column``, and ``2`` as a fourth part for the second number of that cell;
      a row may be told by ``two & texts``, and a table by ``head beside another``;
    - ``page.md | words``: the first number after them.

    `` / `` and `` - `` between two sources are their ratio and their difference."""
    for sign, combine in ((" / ", float.__truediv__), (" - ", float.__sub__)):
        if sign in source:
            first, _, second = source.partition(sign)
            return combine(value_of(first, root), value_of(second, root))
    name, *parts = (part.strip() for part in source.split("|"))
    path = root / name
    if path.suffix == ".json":
        return float(json.loads(path.read_text(encoding="utf-8"))[parts[0]])
    if path.suffix in (".csv", ".parquet"):
        table = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
        found = (table.query(parts[0]) if parts[0] else table)[parts[1]]
        if len(parts) > 2:
            return float(getattr(found, parts[2])())
        (only,) = found.unique()
        return float(only)
    text = path.read_text(encoding="utf-8")
    if len(parts) == 1:
        assert text.count(parts[0]) == 1, f"{parts[0]!r} stands {text.count(parts[0])} times in {name}"
        return float(stated_numbers(text.partition(parts[0])[2])[0].text.replace(",", ""))
    (cell,) = cells_of(text, parts[0], parts[1])
    return float(stated_numbers(cell)[int(parts[2]) - 1 if len(parts) > 2 else 0].text.replace(",", ""))


def cells_of(page: str, row: str, column: str) -> list[str]:
    """The cells below a head in the rows of a page's tables that contain a text."""
    heads: list[str] = []
    found = []
    column, _, other = column.partition(" beside ")
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        heads = heads if cells and heads else cells
        if all(text in line for text in row.split(" & ")) and cells != heads and {column, other or column} <= {*heads}:
            found.append(cells[heads.index(column)])
    return found


def is_value(number: Stated, value: float) -> bool:
    """Whether a number is the value, in its unit and rounded like it."""
    wanted, digits = float(number.text.replace(",", "")), len(number.text.partition(".")[2])
    near = 0.5 * 10**-digits * (1 + 1e-6)
    return any(abs(abs(value) * scale - wanted) <= near for scale in SCALES[number.unit])
