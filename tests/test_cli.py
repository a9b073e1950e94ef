"""The command line: what it prints, and the exit codes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import steelnb
from steelnb import cli
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
    assert all(command in shown for command in ("study", "structure", "segment"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bogus"], ["bogus"]),
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
    assert cli.main([command, "x"]) == 2
    shown = capsys.readouterr().err
    assert shown == f"steelnb: error: {command}: no longer a command; {cli.REMOVED[command]}\n"
    assert files(project) == []


def test_installed_command(project: Path) -> None:
    command = [sys.executable, "-m", "steelnb.cli", "segment", "nothing.ply"]
    shown = subprocess.run(command, cwd=project, capture_output=True, text=True, env=os.environ, check=False)
    assert shown.returncode == 2
    assert shown.stderr.startswith("steelnb: error: nothing.ply")
    assert shown.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["segments.csv", "structure.json"])
def test_a_folder_in_the_place_of_an_output_of_segment_keeps_the_earlier_ones(project: Path, name: str) -> None:
    write_ply(project / "tower.ply", scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01))
    (project / "out" / name / "mine").mkdir(parents=True)
    (project / "out" / "segments.ply").write_text("earlier")
    before = files(project)
    command = [sys.executable, "-m", "steelnb.cli", "segment", "tower.ply", "-o", "out"]
    shown = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)
    assert (shown.returncode, shown.stdout) == (2, "")
    assert shown.stderr == f"steelnb: error: out/{name}: exists already; expected a new name, or a file to replace\n"
    assert files(project) == before
    assert (project / "out" / "segments.ply").read_text() == "earlier"
