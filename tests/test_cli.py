"""The command line: what it prints, and the exit codes."""

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import steelnb
from steelnb import cli, cli_options, cli_progress, settings
from steelnb.io.clouds import write_ply
from tests.lattice import lattice, scanned


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(root: Path) -> list[Path]:
    return sorted(root.rglob("*"))


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"steelnb {steelnb.__version__}\n"
    assert cli.main([]) == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in ("study", "segment"))


@pytest.mark.parametrize("command", ["study", "record", "fly", "run", "info", "segment"])
def test_help_has_examples_and_exit_codes_and_no_type_at_a_flag(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"\n  Examples:\n    steelnb {command} " in shown
    assert "\n  Exit codes: 0 done" in shown
    assert "bool" not in shown
    cli.main(["--help"])
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.partition("Exit codes:")[2].splitlines() if line] == [
        "0",
        "1",
        "2",
        "130",
    ]
    (about,) = (line for line in shown.splitlines() if line.split()[:1] == [command])
    assert about.endswith(".")
    assert "..." not in about


def test_the_names_of_options_are_those_of_the_settings() -> None:
    assert set(cli_options.METHODS) == {*settings.METHODS, "segments"}
    assert cli_options.SENSORS == settings.SENSORS
    assert tuple(sorted(get_args(settings.PlannerGoal))) == cli_options.GOALS
    assert cli_options.TRAJECTORIES == settings.TRAJECTORIES
    assert set(cli_options.NOISES) == {*settings.REPORT_NOISE, "none"}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("steelnb re", ["record"]),
        ("steelnb run a.bag --odometry be", ["best"]),
        ("steelnb run a.bag --odometry best --odometry gicp-", ["gicp-4dof"]),
        ("steelnb run a.bag --noise random-walk:0.002+y", ["random-walk:0.002+yaw-random-walk"]),
        ("steelnb run a.bag --sensor s", ["starling2", "starling2-honest"]),
        ("steelnb record a.bag --trajectory o", ["orbit", "orbit-3.3"]),
        ("steelnb run --fo", ["--force"]),
    ],
)
def test_the_shell_completes_commands_options_and_names(line: str, expected: list[str]) -> None:
    """By the protocol of the script that `steelnb --show-completion` prints, and without loading anything heavy."""
    words = line.split(" ")
    given = {"_STEELNB_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    code = (
        "import sys\nfrom steelnb import cli\ntry:\n    cli.main([])\nfinally:\n    assert 'numpy' not in sys.modules"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | given, capture_output=True, text=True, check=True
    )
    assert shown.stdout.split() == expected


def test_a_bar_moves_on_a_terminal_until_the_end_of_a_stage_and_beyond(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with cli_progress.progress() as shown:
        assert "loading libraries" in terminal.getvalue(), "before anything is imported"
        shown.show("correcting", 1.0)
        shown.show("writing")
        (task,) = shown._bars.tasks  # type: ignore[attr-defined]
        assert (task.description, task.finished, task.total) == ("writing", False, None)
        shown.say("a run failed")
    assert "a run failed" in terminal.getvalue()
    assert terminal.getvalue().endswith("\x1b[2K"), "the line is gone at the end"


def test_where_there_is_no_terminal_a_stage_is_told_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(cli_progress.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(cli_progress, "LINE_PERIOD_S", 10.0)
    with cli_progress.progress() as shown:
        for now_s in (101.0, 109.0, 111.0, 120.0, 122.0):
            shown.show("correcting", (now_s - 100.0) / 40)
    assert capsys.readouterr().err == "correcting: 28%, 0:00:26 left\ncorrecting: 55%, 0:00:17 left\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bogus"], ["bogus"]),
        (["segmnt", "x.ply"], ["'segmnt'", "Did you mean 'segment'?"]),
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


@pytest.mark.parametrize("command", sorted(cli.REMOVED))
def test_a_removed_command_names_its_successor(project: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert cli.main([command, "x", "--rate", "max", "-o"]) == 2
    shown = capsys.readouterr().err
    assert shown == f"steelnb: error: {command}: no longer a command; {cli.REMOVED[command]}\n"
    assert files(project) == []


def test_installed_command(project: Path) -> None:
    command = [sys.executable, "-m", "steelnb.cli", "segment", "nothing.ply"]
    shown = subprocess.run(command, cwd=project, capture_output=True, text=True, env=os.environ, check=False)
    assert shown.returncode == 2
    assert shown.stderr.splitlines()[-1].startswith("steelnb: error: nothing.ply")


@pytest.mark.parametrize("name", ["segments.csv", "segments.png"])
def test_a_folder_in_the_place_of_an_output_of_segment_keeps_the_earlier_ones(project: Path, name: str) -> None:
    write_ply(project / "tower.ply", scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01))
    (project / "out" / name / "mine").mkdir(parents=True)
    (project / "out" / "segments.ply").write_text("earlier")
    before = files(project)
    command = [sys.executable, "-m", "steelnb.cli", "segment", "tower.ply", "-o", "out"]
    shown = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)
    assert (shown.returncode, shown.stdout) == (2, "")
    error = shown.stderr.splitlines()[-1]  # on a slow machine, stages before it
    assert error == f"steelnb: error: out/{name}: exists already; expected a new name, or a file to replace"
    assert files(project) == before
    assert (project / "out" / "segments.ply").read_text() == "earlier"
