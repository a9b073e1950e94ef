"""The command line: what it prints, and the exit codes; the notebooks themselves run in test_reproduce.py."""

import os
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import steelnb
from steelnb import cli, reproduce
from steelnb.errors import EmptyCloudError
from steelnb.results import Difference
from tests.test_reproduce import make_project


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project that was never run, and is the current folder."""
    root = make_project(tmp_path / "project")
    monkeypatch.chdir(root)
    return root


def files(root: Path) -> list[Path]:
    return sorted(root.rglob("*"))


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"steelnb {steelnb.__version__}\n"
    assert cli.main([]) == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in ("list", "reproduce", "check", "segment"))


def test_list(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    header, pair, single = capsys.readouterr().out.splitlines()
    assert header.split() == ["id", "title", "figures", "notebook", "parts", "state"]
    assert pair.split() == ["pair", "Two", "parts", "1.1", "tiny.ipynb", "2", "never", "run"]
    assert single.split() == ["single", "One", "part", "tiny.ipynb", "1", "never", "run"]
    assert not (project / ".cache").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bogus"], ["bogus"]),
        (["reproduce", "--bogus"], ["--bogus"]),
        (["reproduce", "--jobs", "two"], ["--jobs"]),
        (["reproduce", "--jobs", "0"], ["jobs = 0", "at least 1"]),
        (["reproduce", "singel"], ["'singel'", "did you mean 'single'", "pair"]),
        (["check", "singel"], ["'singel'"]),
        (["check"], ["results/pair/metrics.json", "nothing to compare with"]),
        (["reproduce", "--budget", "huge"], ["budget = 'huge'", "full, smoke"]),
        (["reproduce", "-p", "value=2"], ["-p value", "-o FOLDER"]),
        (["reproduce", "-p", "value"], ["NAME=VALUE"]),
        (["reproduce", "-p", "valeu=2", "-o", "out"], ["'valeu'", "did you mean 'value'"]),
        (["reproduce", "-p", "value=fast", "-o", "out"], ["value = 'fast'", "a finite number"]),
        (["reproduce", "-p", "noise=['random-walk:-1']", "-o", "out"], ["random_walk_m = -1.0"]),
        (["reproduce", "-p", "tof.rate_hz=0", "-o", "out"], ["rate_hz = 0", "greater than 0"]),
        (["reproduce", "-o", "environment.lock/out"], ["environment.lock/out", "cannot be written"]),
        (["segment"], ["Missing argument"]),
        (["segment", "x.ply", "--voxel", "small"], ["--voxel"]),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    project: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
) -> None:
    before = files(project)
    assert cli.main(arguments) == 2
    shown = capfd.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("steelnb: error: ")
    assert shown.err.count("\n") == 1
    assert all(word in shown.err for word in words), shown.err
    assert files(project) == before


def replace(monkeypatch: pytest.MonkeyPatch, name: str, answer: Any) -> list[tuple[tuple, dict]]:
    """Put a function that notes its arguments in the place of one of `reproduce`'s."""
    calls: list[tuple[tuple, dict]] = []

    def answering(*positional: Any, **named: Any) -> Any:
        calls.append((positional, named))
        if isinstance(answer, BaseException):
            raise answer
        return answer

    monkeypatch.setattr(reproduce, name, answering)
    return calls


def test_reproduce_hands_over_its_options(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = replace(monkeypatch, "run", reproduce.Report(["single"], [], [project / "out" / "single"]))
    options = ["--budget", "smoke", "-p", "value=2", "-p", "tof.rate_hz=10", "-p", "trajectory=orbit"]
    assert cli.main(["reproduce", "single", *options, "-o", "out", "--jobs", "3", "--force"]) == 0
    (positional, named) = calls[0]
    given = {"value": 2, "tof.rate_hz": 10, "trajectory": "orbit"}
    assert positional == (["single"], "smoke", given, Path("out"), 3)
    assert named["force"] is True
    assert capsys.readouterr().out == "out/single/ written\n"
    replace(monkeypatch, "run", reproduce.Report([], ["single"], []))
    assert cli.main(["reproduce"]) == 0
    assert capsys.readouterr().out == "everything is up to date\n"


@pytest.mark.parametrize("code", [1, 2])
def test_failed_notebooks_get_a_line_each(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], code: int
) -> None:
    replace(monkeypatch, "run", reproduce.NotebooksFailedError(["a: X: one", "b: Y: two\nlines"], code))
    assert cli.main(["reproduce"]) == code
    assert capsys.readouterr().err == "steelnb: error: a: X: one\nsteelnb: error: b: Y: two lines\n"


def test_interruption_is_exit_130(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(monkeypatch, "run", KeyboardInterrupt())
    assert cli.main(["reproduce"]) == 130
    assert capsys.readouterr().err.startswith("steelnb: error: interrupted")


def test_check_prints_differences_and_exits_1(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    excused = Difference("single.loose_m", "", "1", "2", "depends on the weather")
    found = Difference("single.x_m", "row 2", "1.0", "missing")
    replace(monkeypatch, "check", reproduce.CheckReport([excused, found], 7, 2, project / ".cache" / "check"))
    assert cli.main(["check"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "exception: single.loose*: depends on the weather",
        "excused (depends on the weather): single.loose_m: committed 1, now 2",
        "DIFFERS: single.x_m row 2: committed 1.0, now missing",
        "1 differences; the new results are in .cache/check/",
    ]
    replace(monkeypatch, "check", reproduce.CheckReport([excused], 7, 2, project))
    assert cli.main(["check"]) == 0
    assert "7 metrics of 2 experiments agree" in capsys.readouterr().out


def give_segment(monkeypatch: pytest.MonkeyPatch, segment_file: Callable[..., Any]) -> None:
    module = types.ModuleType("steelnb.segment")
    module.segment_file = segment_file  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "steelnb.segment", module)


def test_segment_is_wired(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    calls: list[tuple] = []

    def segment_file(cloud: Path, output: Path | None, **settings: Any) -> Any:
        calls.append((cloud, output, settings))
        return types.SimpleNamespace(summary=["points  9", "segments  2"])

    give_segment(monkeypatch, segment_file)
    assert cli.main(["segment", "a.ply"]) == 0
    assert capsys.readouterr().out == "points  9\nsegments  2\n"
    given = ["-o", "out", "--voxel", "0.1", "--dx", "0.2", "--min-votes", "5", "--no-structure"]
    assert cli.main(["segment", "a.ply", *given]) == 0
    assert calls == [
        (Path("a.ply"), None, {"voxel_m": None, "dx_m": None, "min_votes": None, "structure": True}),
        (Path("a.ply"), Path("out"), {"voxel_m": 0.1, "dx_m": 0.2, "min_votes": 5, "structure": False}),
    ]


def test_segment_refuses_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def segment_file(*_: Any, **__: Any) -> None:
        raise EmptyCloudError("a.ply: no finite point;\nexpected some")

    give_segment(monkeypatch, segment_file)
    assert cli.main(["segment", "a.ply"]) == 2
    assert capsys.readouterr().err == "steelnb: error: a.ply: no finite point; expected some\n"


def test_progress_lines(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [50.0]
    monkeypatch.setattr(cli.time, "monotonic", lambda: now_s[0])
    lines = cli._Lines()
    for event, fraction, left_s in [("a: started", 0.0, None), ("", 0.1, 80.2), ("a: done in 9 s", 0.5, 9.0)]:
        lines.show(reproduce.Status(1, 2, ("a", "b"), fraction, left_s, event))
    now_s[0] += 31
    lines.show(reproduce.Status(1, 2, ("b",), 0.7, 80.2, ""))
    assert capsys.readouterr().err.splitlines() == [
        "[1/2   0%, time left unknown] a: started",
        "[1/2  50%, 0:09 left] a: done in 9 s",
        "[1/2  70%, 1:21 left] running b",
    ]


def test_installed_command(project: Path) -> None:
    command = [sys.executable, "-m", "steelnb.cli", "reproduce", "nothing"]
    shown = subprocess.run(command, cwd=project, capture_output=True, text=True, env=os.environ, check=False)
    assert shown.returncode == 2
    assert shown.stderr == "steelnb: error: unknown experiment 'nothing'; known: pair, single\n"
