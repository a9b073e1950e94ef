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


def file_values(path: Path) -> np.ndarray:
    """The absolute values in a file of results or in a page, each once, and the number of rows of a table."""
    if path.suffix == ".csv":
        table = pd.read_csv(path)
        found = np.append(table.select_dtypes("number").to_numpy(float).ravel(), len(table))
    elif path.suffix == ".json":
        found = np.array(list(json.loads(path.read_text(encoding="utf-8")).values()), float)
    else:
        found = np.array([float(each.text.replace(",", "")) for each in stated_numbers(path.read_text("utf-8"))])
    return np.unique(np.abs(found[np.isfinite(found)]))


def is_in(number: Stated, values: np.ndarray) -> bool:
    """Whether one of the values is the number, in its unit and rounded like it."""
    wanted, digits = float(number.text.replace(",", "")), len(number.text.partition(".")[2])
    near = 0.5 * 10**-digits * (1 + 1e-6)
    return any((np.abs(values * scale - wanted) <= near).any() for scale in SCALES[number.unit])
