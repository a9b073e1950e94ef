"""JSON: an exact round trip, and an error for each way to be wrong."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import InputError
from steelnb.fusion.structure import Structure
from steelnb.io.structures import read_structure, write_structure
from tests.io.made import UTM, frame, shifted, tower


def assert_same(a: Structure, b: Structure) -> None:
    pairs = [(getattr(a.segments, n), getattr(b.segments, n)) for n in ("start", "end", "count", "radius")]
    pairs += [(getattr(a, n), getattr(b, n)) for n in ("width_m", "sightings", "sigma_m", "joint", "tie")]
    for mine, other in pairs:
        np.testing.assert_array_equal(mine, other)  # NaN equals NaN here, and nothing is rounded
        assert mine.dtype == other.dtype
        assert mine.shape == other.shape
    assert a.reason == b.reason
    assert (a.opening is None) == (b.opening is None)
    if a.opening is not None:
        np.testing.assert_array_equal(a.opening, b.opening)
    assert (a.joint_sigma_m is None) == (b.joint_sigma_m is None)
    if a.joint_sigma_m is not None:
        np.testing.assert_array_equal(a.joint_sigma_m, b.joint_sigma_m)
    assert (a.tube is None) == (b.tube is None)
    if a.tube is not None:
        np.testing.assert_array_equal(a.tube, b.tube)


@pytest.mark.parametrize("structure", [tower(), frame(), shifted(tower(1), UTM), Structure.empty("no “bar”")])
def test_round_trip_is_exact(structure: Structure, tmp_path: Path) -> None:
    (path,) = write_structure(structure, tmp_path / "a.json", about={"source": "made up"})
    assert_same(read_structure(path), structure)


def test_what_is_not_known_is_null_and_may_be_missing(tmp_path: Path) -> None:
    opening = np.array([[0.6, 0.8, 0.0], [0.0, 0.6, -0.8], [np.nan, np.nan, np.nan]])
    known = replace(frame(), opening=opening, joint_sigma_m=np.array([np.nan, 0.003, 0.003]))
    (path,) = write_structure(known, tmp_path / "a.json")
    assert_same(read_structure(path), known)
    content = json.loads(path.read_text())
    assert (content["bars"][2].pop("opening"), content["joints"][0]["sigma_m"]) == (None, None)
    content["version"] = 2
    for bar in content["bars"]:
        bar.pop("opening", None)
        bar.pop("section")
    for joint in content["joints"]:
        joint.pop("sigma_m")
    path.write_text(json.dumps(content))
    assert_same(read_structure(path), frame())


def test_the_order_of_ties_is_kept(tmp_path: Path) -> None:
    mixed = replace(frame(), tie=frame().tie[[3, 0, 5, 1, 4, 2]])
    write_structure(mixed, tmp_path / "a.json")
    assert_same(read_structure(tmp_path / "a.json"), mixed)


def test_round_tubes_survive_and_files_without_sections_are_read(tmp_path: Path) -> None:
    none = np.full(3, np.nan)
    known = replace(frame(), opening=np.array([[0.6, 0.8, 0.0], none, none]), tube=np.array([False, True, False]))
    (path,) = write_structure(known, tmp_path / "a.json")
    assert_same(read_structure(path), known)
    content = json.loads(path.read_text())
    assert [bar["section"] for bar in content["bars"]] == ["angle", "round", None]
    content["version"] = 3
    for bar in content["bars"]:
        bar.pop("section")
    path.write_text(json.dumps(content))
    assert_same(read_structure(path), replace(known, tube=None))


def changed(tmp_path: Path, change) -> Path:
    """The file of a small structure, after ``change`` was applied to its content."""
    (path,) = write_structure(frame(), tmp_path / "changed.json")
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))  # which writes NaN as it is, as many programs do
    return path


CASES = {
    "a later version": (lambda c: c.update(version=5), InputError, "version = 5; expected 4"),
    "version 1": (lambda c: c.update(version=1), InputError, "version 1 is no longer read"),
    "farther than any map": (lambda c: c["bars"][0].update(start_m=[1e308, 0, 0]), InputError, "start_m[0]"),
    "no version": (lambda c: c.pop("version"), InputError, "version = None"),
    "no units": (lambda c: c.pop("units"), InputError, "units = None"),
    "feet": (lambda c: c.update(units={"length": "foot"}), InputError, "foot"),
    "NaN": (lambda c: c["bars"][1]["start_m"].__setitem__(2, np.nan), InputError, "bars[1].start_m[2]"),
    "infinite": (lambda c: c["joints"][0].update(position_m=[0, np.inf, 0]), InputError, "joints[0].position_m[1]"),
    "text": (lambda c: c["bars"][0].update(end_m=[1, 2, "3"]), InputError, "bars[0].end_m[2] = 3"),
    "negative width": (lambda c: c["bars"][2].update(width_m=-1), InputError, "bars[2].width_m = -1"),
    "a square bar": (lambda c: c["bars"][2].update(section="square"), InputError, "bars[2].section = square"),
    "misspelt": (lambda c: c["bars"][2].update(widht_m=1), InputError, "bars[2].widht_m"),
    "y up": (lambda c: c["frame"].update(up="y"), InputError, "frame.up = y"),
    "no bars": (lambda c: c.pop("bars"), InputError, "bars: field required"),
    "tie to no bar": (lambda c: c["ties"].append({"joint": 0, "bar": 3}), InputError, "joint 0 and bar 3"),
    "tie to no joint": (lambda c: c["ties"].append({"joint": 9, "bar": 0}), InputError, "joint 9 and bar 0"),
    "tied twice": (lambda c: c["ties"].append({"joint": 0, "bar": 0}), InputError, "twice"),
    "no length": (lambda c: c["bars"][0].update(end_m=[0, 0, 0]), InputError, "bar 0 starts and ends"),
    "a long value": (lambda c: c.update(units="x" * 70_000), InputError, "units = 'xxx"),
    "another format": (lambda c: c.update(format="steelnb segments, version 1"), InputError, "format ="),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_content_is_refused(case: str, tmp_path: Path) -> None:
    change, error, words = CASES[case]
    path = changed(tmp_path, change)
    with pytest.raises(error) as caught:
        read_structure(path)
    assert type(caught.value) is error
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))


DEEP = b'{"format": "steelnb structure", "about": ' + b"[" * 100_000


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"null", b"\xff\xfe", DEEP, b'{"format": 1}'])
def test_what_is_no_structure_is_refused(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with pytest.raises(InputError):
        read_structure(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none"):
        read_structure(tmp_path / "none.json")
    with pytest.raises(InputError):
        read_structure(tmp_path)
