"""The files that a notebook writes, and its progress."""

import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from steelnb.core.errors import OutputError, SteelnbError
from steelnb.notebook.progress import Progress
from steelnb.notebook.results import write_results


def write(folder: Path | str, metrics: dict, figures: tuple[str, ...] = (), **more) -> None:
    table = pd.DataFrame({"x": [1.0, np.nan]})
    figures_ = {name: Figure() for name in figures}
    write_results(folder, table=table, metrics=metrics, figures=figures_, **{"provenance": {}, **more})


def test_write_results_writes_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shown = []
    monkeypatch.setattr("IPython.display.display", shown.append)
    write("", {"x": 1.0}, ("1", "2"))
    assert not list(tmp_path.iterdir())
    assert shown[0].data.count("<img ") == 2
    files = {"structure_a.json": lambda path: path.write_text("{}")}
    write("out", {"b": np.float32(0.5), "a": np.int64(2)}, ("fig_1", "2"), files=files)
    out = tmp_path / "out"
    assert (out / "metrics.json").read_text() == '{\n  "a": 2,\n  "b": 0.5\n}\n'
    assert (out / "table.csv").read_text() == 'x\n1\n""\n'
    common = ["metrics.json", "provenance.json", "table.csv"]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["fig_1.png", "fig_2.png", "structure_a.json", *common]
    )
    (out / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for value in ("1", True, None):
        with pytest.raises(ValueError, match=r"metrics: x = .*a number"):
            write("out", {"x": value})
    with pytest.raises(ValueError, match="Out of range"):
        write("out", {"x": 2}, provenance={"settings": {"x": np.nan}})
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    write("out", {"x": 1, "of nothing": np.nan, "off": np.inf}, ("3",))
    assert (out / "metrics.json").read_text() == '{\n  "x": 1\n}\n'
    assert sorted(path.name for path in out.iterdir()) == sorted(["fig_3.png", "notes.txt", *common])
    assert json.loads((out / "provenance.json").read_text())["files"] == sorted(["fig_3.png", *common])
    (tmp_path / "file").touch()
    for folder in ("file", "file/below"):
        with pytest.raises(OutputError, match="file"):
            write(folder, {"x": 1})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "out"]


def test_files_that_no_notebook_wrote_stay(tmp_path: Path) -> None:
    own = {"fig_mine.png": "my figure", "fig_1.png": "of another name than fig_[1].png", "curves.csv": "1,2"}
    for name, text in own.items():
        (tmp_path / name).write_text(text)
    for figures in (("[1]", "2"), ("3",)):
        write(tmp_path, {"x": 1}, figures)
        assert {name: (tmp_path / name).read_text() for name in own} == own
    assert sorted(path.name for path in tmp_path.glob("fig*")) == ["fig_1.png", "fig_3.png", "fig_mine.png"]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("table.csv", "x\n7\n", r"table\.csv: not listed as written by a notebook; expected another folder"),
        ("provenance.json", '{"parts": {}}', r"provenance\.json: not listed as written by a notebook"),
        ("provenance.json", "[]", r"provenance\.json: not the provenance of results: "),
    ],
)
def test_a_folder_whose_table_is_not_a_notebook_s_is_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SteelnbError, match=words):
        write(tmp_path, {"x": 1})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: text}


def test_progress_writes_the_fraction_of_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, now_s = tmp_path / "progress", [100.0]
    monkeypatch.setenv("STEELNB_PROGRESS_FILE", str(file))
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    progress = Progress(4)
    shown = []
    for _ in progress.each(range(4)):
        for fraction in (0.25, 0.5):
            progress(fraction)
            shown.append(file.read_text())
            now_s[0] += 0.15
    assert shown == ["6%", "6%", "25%", "25%", "50%", "50%", "75%", "75%"]
    assert file.read_text() == "100%"


def test_progress_is_a_bar_where_nobody_asks_for_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STEELNB_PROGRESS_FILE", raising=False)
    progress = Progress(2, "flights")
    progress.step()
    progress.step()
    assert "flights: 100%" in capsys.readouterr().err
