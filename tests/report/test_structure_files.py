"""`steelnb structure`: what it prints, what it writes, and its exit codes."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from steelnb.report.structure_files import COLUMNS, MOST_ROWS, compare_files, differences

from steelnb import cli
from steelnb.fusion.differences import compare_structures as compare
from steelnb.fusion.structure import Structure
from steelnb.io.structures import write_structure
from tests.fusion.made import changed
from tests.io.made import frame, shifted, tower


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a.json and b.json, whose beam is 5 cm lower and whose strut is gone."""
    monkeypatch.chdir(tmp_path)
    write_structure(frame(), "a.json")
    s = frame().segments.take(np.array([0, 1]))
    tie = frame().tie[frame().tie[:, 1] < 2]
    low = Structure(s, frame().width_m[:2], frame().sightings[:2], frame().sigma_m[:2], frame().joint, tie)
    write_structure(changed(low, 1, (0, 0, -0.05), (0, 0, -0.05)), "b.json")
    return tmp_path


def test_one_structure_is_described(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["structure", "a.json"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("a.json: 3 bars (1 near vertical, 1 inclined, 1 near horizontal), 9.8 m; 3 joints, 3 pieces")


def test_an_empty_structure_says_why(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_structure(Structure.empty("7 points: too few"), "empty.json")
    assert cli.main(["structure", "empty.json"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("empty.json: 0 bars")
    assert out[1:] == ["empty     7 points: too few"]
    assert cli.main(["structure", "empty.json", "a.json"]) == 1
    assert "empty     7 points: too few" in capsys.readouterr().out


def test_equal_structures_exit_0(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["structure", "a.json", "a.json"]) == 0
    assert "result    equal within the tolerances" in capsys.readouterr().out
    assert sorted(path.name for path in files.iterdir()) == ["a.json", "b.json"]


def test_different_structures_exit_1_and_are_written(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["structure", "a.json", "b.json", "-o", "out"]) == 1
    out = capsys.readouterr().out
    assert "result    DIFFERENT" in out
    assert [line.split()[:4] for line in out.splitlines() if line.startswith(" bar ")] == [
        ["bar", "missing", "2", "-"],
        ["bar", "moved", "1", "1"],
    ]
    table = pd.read_csv("out/differences.csv")
    assert list(table.columns) == list(COLUMNS)
    moved = table[table["change"] == "moved"].iloc[0]
    assert moved[["offset_m", "angle_deg", "end_m", "length_m"]].tolist() == pytest.approx([0.05, 0, 0.05, 3])
    missing = table[table["change"] == "missing"].iloc[0]
    assert missing[["x_m", "y_m", "z_m"]].tolist() == [1, 0, 3]
    with Image.open("out/differences.png") as picture:
        assert picture.width > 800
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20


def test_tolerances_are_options(files: Path) -> None:
    write_structure(changed(frame(), 1, (0, 0, -0.05), (0, 0, -0.05)), "c.json")
    assert cli.main(["structure", "a.json", "c.json"]) == 1
    assert cli.main(["structure", "a.json", "c.json", "--offset", "0.06", "--end", "0.06"]) == 0


def test_conversion(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["structure", "a.json", "--to", "cad/a.dxf"]) == 0
    assert capsys.readouterr().out == "cad/a.dxf written\n"
    assert cli.main(["structure", "a.json", "--to", "cad/a.dxf"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert cli.main(["structure", "a.json", "--to", "cad/a.dxf", "--force"]) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.json"], "none.json: cannot be read"),
        (["a.json", "none.json"], "none.json: cannot be read"),
        (["a.json", "--to", "a.step"], "expected one of .json, .csv, .dxf, .glb, .ifc"),
        (["a.json", "b.json", "--to", "a.dxf"], "expected one structure to convert"),
        (["a.json", "-o", "out"], "expected two structures to compare"),
        (["a.json", "b.json", "--angle", "-1"], "angle_deg = -1.0: input should be greater than or equal to 0"),
        (["a.json", "b.json", "-o", "a.json"], "a.json"),
        (["bad.json"], "bad.json: version = 9; expected 4"),
        (["a.json", "bad.json"], "bad.json: version = 9; expected 4"),
        (["bad.json", "--to", "x.csv"], "bad.json: version = 9; expected 4"),
    ],
)
def test_bad_input_is_one_line(
    files: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (files / "bad.json").write_text((files / "a.json").read_text().replace('"version": 4', '"version": 9'))
    assert cli.main(["structure", *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in files.iterdir()) == ["a.json", "b.json", "bad.json"]


def test_no_bars_can_be_tabled_but_not_drawn(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_structure(Structure.empty("nothing"), "none.json")
    assert cli.main(["structure", "none.json", "--to", "none.csv"]) == 0
    assert cli.main(["structure", "none.json", "--to", "none.dxf"]) == 2
    assert "none.dxf: the structure has no bars" in capsys.readouterr().err
    assert not (files / "none.dxf").exists()


def test_a_long_table_is_cut_in_print_only(tmp_path: Path) -> None:
    whole = tower()
    for name, structure in (("a", whole), ("b", shifted(whole, np.array([0, 0.05, 0])))):
        write_structure(structure, tmp_path / f"{name}.json")
    report = compare_files(tmp_path / "a.json", tmp_path / "b.json")
    assert report.comparison.bar_moved.sum() == len(whole)
    assert len(report.table) > MOST_ROWS
    assert f"and {len(report.table) - MOST_ROWS} more" in report.summary[-1]


def test_the_most_moved_come_first() -> None:
    far = changed(changed(frame(), 0, (0.04, 0, 0), (0.04, 0, 0)), 1, (0, 0.1, 0), (0, 0.1, 0))
    table = differences(frame(), far, compare(frame(), far))
    assert table["a"].tolist() == [1, 0]


def test_empty_structures_are_compared(files: Path) -> None:
    write_structure(Structure.empty(), "none.json")
    assert cli.main(["structure", "none.json", "none.json", "-o", "out"]) == 0
    assert cli.main(["structure", "a.json", "none.json", "-o", "out"]) == 1
    assert (files / "out" / "differences.png").exists()
