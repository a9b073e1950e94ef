"""Contents of ``segments.csv`` and ``structure.json``."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from steelnb.core.errors import InputError
from steelnb.core.types import Segments
from steelnb.fusion.structure import Structure
from steelnb.io import write_segments, write_structure

START, END = np.array([[0.0, 0, 0], [0, 0, 4]]), np.array([[0.0, 0, 4], [3, 0, 4]])
SEGMENTS = Segments(START, END, np.array([900, 400]), np.array([0.02, 0.0123456]))


def test_each_segment_has_a_row(tmp_path: Path) -> None:
    write_segments(SEGMENTS, tmp_path / "a.csv", np.array([[0.001, 0.002], [0.003, 0.004]]))
    table = pd.read_csv(tmp_path / "a.csv")
    np.testing.assert_array_equal(table.filter(regex="^start"), START)
    assert table[["length_m", "count", "radius_m"]].to_numpy().tolist() == [[4.0, 900, 0.02], [3.0, 400, 0.0123]]
    assert table["sigma_end_mm"].tolist() == [2.0, 4.0]


def test_a_structure_keeps_all_digits_and_unknown_values_are_null(tmp_path: Path) -> None:
    width, opening = np.array([0.1 + 0.2, np.nan]), np.array([[0.6, 0.8, 0.0], [np.nan] * 3])
    joint, tie = np.array([[0.0, 0, 4]]), np.array([[0, 0], [0, 1]])
    sigma = np.array([0.001, np.nan])
    tube = np.array([False, True])
    structure = Structure(SEGMENTS, width, np.array([4, 2]), sigma, joint, tie, opening=opening, tube=tube)
    write_structure(structure, tmp_path / "a.json", {"source": "made up"})
    read = json.loads((tmp_path / "a.json").read_text())
    assert (read["format"], read["version"], read["units"]) == ("steelnb structure", 5, {"length": "metre"})
    assert [bar["width_m"] for bar in read["bars"]] == [0.1 + 0.2, None]
    assert [bar["section"] for bar in read["bars"]] == ["angle", "round"]
    assert read["bars"][1]["opening"] is None
    assert read["bars"][1]["radius_m"] == 0.0123456
    assert read["joints"] == [{"position_m": [0.0, 0.0, 4.0]}]
    assert read["ties"] == [{"joint": 0, "bar": 0}, {"joint": 0, "bar": 1}]
    write_structure(Structure.empty("no bar"), tmp_path / "b.json")
    assert json.loads((tmp_path / "b.json").read_text())["reason"] == "no bar"


def test_an_unknown_radius_is_null_and_ties_to_nothing_are_refused(tmp_path: Path) -> None:
    bars = Segments(START, END, np.array([900, 400]), np.array([np.nan, 0.01]))
    write_structure(Structure.of(bars), tmp_path / "a.json")
    assert [bar["radius_m"] for bar in json.loads((tmp_path / "a.json").read_text())["bars"]] == [None, 0.01]
    parts = {"width_m": np.ones(2), "sightings": np.ones(2, int), "sigma_m": np.ones(2), "joint": np.zeros((1, 3))}
    for tie in ([[1, 0]], [[0, 2]], [[-1, 0]]):
        with pytest.raises(InputError, match=r"Structure\.tie"):
            Structure(bars, tie=np.array(tie), **parts)
    with pytest.raises(InputError, match=r"Structure.tube"):
        Structure(bars, tie=np.zeros((0, 2), int), tube=np.ones(3, bool), **parts)
