"""Real notebooks through papermill, in a tiny project of their own."""

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import psutil
import pytest
from matplotlib.figure import Figure

from steelnb import reproduce
from steelnb.errors import (
    FileMissingError,
    NotebookError,
    OutputError,
    SettingsError,
    SteelnbError,
    UnknownExperimentError,
)
from steelnb.project import CheckSettings, Project, find_root, parse_parameter
from steelnb.results import Progress, committed_text, compare, estimate, merge, write_results

EXPERIMENTS = """
[pair]
notebook = "tiny.ipynb"
title = "Two parts"
figures = "1.1"
matrix = { trajectory = ["vertical", "orbit"] }
full = { value = 2 }
smoke = { value = 0.5 }
expected_s = 2

[single]
notebook = "tiny.ipynb"
title = "One part"
full = { value = 3.0 }
smoke = {}
expected_s = 3

[check]
exceptions = { "single.loose*" = "depends on the weather" }
"""
PARAMETERS = """
trajectory = "vertical"
noise = ["random-walk", "constant-drift:0.0002"]
value = 1.0
count = 1
deep = False
overrides = {}
fail = ""
results_dir = ""  # empty: show only
"""
# A sleep that holds the interpreter lock, as a long call of compiled code does, as long as the gate is there.
GATE = """
import ctypes, os, pathlib, sys
from steelnb import reproduce
from steelnb.errors import SettingsError
assert sys.executable == os.environ.get("STEELNB_TEST_PYTHON", sys.executable)
assert os.environ["NUMBA_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == "1"
assert "MPLBACKEND" not in os.environ or "inline" in os.environ["MPLBACKEND"]
progress = reproduce.Progress(1, "tiny")
progress.update(0.5)
if pathlib.Path(f"gate-{trajectory}").exists():
    pathlib.Path(f"asleep-{trajectory}").write_text(str(os.getpid()))
    ctypes.PyDLL(None).sleep(120)
if fail == "exit":
    os._exit(3)
if fail:
    raise {"ValueError": ValueError, "SettingsError": SettingsError}[fail]("nothing\\ndoing")
"""
RESULT = """
import pandas
from matplotlib.figure import Figure
figure = Figure()
figure.subplots().plot([0, value])
reproduce.write_results(
    results_dir,
    table=pandas.DataFrame({"trajectory": trajectory, "noise": noise, "third_m": [value / 3, 1e-12 / 3]}),
    metrics={"third_m": value / 3, "rate_hz": overrides.get("tof.rate_hz", 5.0), "count": count},
    figures={"fig_1_1": figure},
    timing=pandas.DataFrame({"stage": ["all"], "seconds": [0.1]}),
    provenance={"settings": {"value": value}, "seeds": [1]},
)
progress.step()
"""


def make_project(root: Path, experiments: str = EXPERIMENTS) -> Path:
    """A project with one tiny notebook."""
    cells = [nbformat.v4.new_code_cell(source.strip()) for source in (PARAMETERS, GATE, RESULT)]
    cells[0].metadata["tags"] = ["parameters"]
    (root / "notebooks").mkdir(parents=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), root / "notebooks" / "tiny.ipynb")
    (root / "notebooks" / "experiments.toml").write_text(experiments, encoding="utf-8")
    (root / "environment.lock").write_text("numpy==2\n")
    return root


def contents(folder: Path, *, cache: bool = False) -> dict[str, bytes]:
    names = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(name): (folder / name).read_bytes() for name in names if cache or name.parts[0] != ".cache"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose experiments have been run; not to be changed."""
    root = make_project(tmp_path_factory.mktemp("finished") / "project")
    reported: list[reproduce.Status] = []
    with pytest.MonkeyPatch.context() as patch:
        # As in a shell where no environment is activated and another Python comes first.
        patch.setenv("PATH", os.defpath)
        patch.setenv("MPLBACKEND", "pdf")
        patch.setenv("STEELNB_TEST_PYTHON", sys.executable)
        report = reproduce.run(root=root, on_progress=reported.append)
    assert sorted(report.ran) == ["pair/orbit", "pair/vertical", "single"]
    assert report.written == [root / "results" / "pair", root / "results" / "single"]
    assert [status.event for status in reported if "started" in status.event] == [
        "single: started",  # expected to take longest
        "pair/vertical: started",
        "pair/orbit: started",
    ]
    assert reported[-1].done == reported[-1].total == 3
    assert reported[-1].fraction == pytest.approx(1)
    assert any(status.fraction > 0 and status.done == 0 for status in reported), "no fraction of a running part"
    assert max(len(status.running) for status in reported) == 2
    return root


@pytest.fixture
def project(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished project at another place."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_fresh_run_merges_parts(finished: Path) -> None:
    pair, single = finished / "results" / "pair", finished / "results" / "single"
    assert json.loads((pair / "metrics.json").read_text()) == {
        "orbit.count": 1,
        "orbit.rate_hz": 5.0,
        "orbit.third_m": 2 / 3,
        "vertical.count": 1,
        "vertical.rate_hz": 5.0,
        "vertical.third_m": 2 / 3,
    }
    assert (pair / "table.csv").read_text().splitlines() == [
        "trajectory,noise,third_m",
        "vertical,random-walk,0.666666667",
        "vertical,constant-drift:0.0002,3.33333333e-13",
        "orbit,random-walk,0.666666667",
        "orbit,constant-drift:0.0002,3.33333333e-13",
    ]
    assert sorted(path.name for path in pair.glob("*.png")) == ["fig_1_1_orbit.png", "fig_1_1_vertical.png"]
    assert sorted(path.name for path in single.iterdir()) == [
        "fig_1_1.png",
        "metrics.json",
        "provenance.json",
        "table.csv",
        "timing.csv",
    ]
    assert json.loads((single / "metrics.json").read_text())["third_m"] == 1.0
    provenance = json.loads((pair / "provenance.json").read_text())
    assert list(provenance["parts"]) == ["orbit", "vertical"]
    assert provenance["notebook"] == "tiny.ipynb"
    assert provenance["parts"]["orbit"]["settings"]["value"] == 2.0
    assert provenance["parts"]["orbit"]["versions"]["numpy"] == np.__version__
    assert len(provenance["parts"]["orbit"]["environment_lock_sha256"]) == 64
    for text in (str(finished), platform.node(), sys.prefix):
        assert text not in (pair / "provenance.json").read_text()
    assert "cores" in (single / "timing.csv").read_text()
    assert not list(finished.rglob("*.new"))
    assert not list((finished / ".cache" / "reproduce" / "scratch").iterdir())
    assert not (finished / "notebooks" / "tiny.ipynb").read_text().count("output_type"), "the notebook was written to"


def test_second_run_imports_nothing_heavy_and_says_so(project: Path) -> None:
    before = contents(project, cache=True)
    command = "import sys, steelnb.cli as cli; code = cli.main(['reproduce']); print(code, *sys.modules)"
    shown = subprocess.run([sys.executable, "-c", command], cwd=project, capture_output=True, text=True, check=True)
    line, modules = shown.stdout.splitlines()
    assert line == "everything is up to date"
    assert not {"numba", "open3d", "papermill", "pandas", "matplotlib", "numpy"} & set(modules.split())
    assert contents(project, cache=True) == before


def test_deleted_and_spoilt_results_are_restored_without_a_run(project: Path) -> None:
    before = contents(project)
    shutil.rmtree(project / "results" / "pair")
    (project / "results" / "single" / "fig_1_1.png").unlink()
    (project / "results" / "single" / "fig_old.png").touch()
    edit(project / "results" / "single" / "metrics.json", "5.0", "6.0")
    assert [state.state for state in reproduce.states(project)] == ["out of date", "out of date"]
    report = reproduce.run(root=project)
    assert report.ran == []
    assert report.written == [project / "results" / "pair", project / "results" / "single"]
    assert contents(project) == before
    assert [state.state for state in reproduce.states(project)] == ["up to date", "up to date"]
    edit(project / "results" / "single" / "timing.csv", "0.1", "0.2")  # as `git checkout results` may
    assert [state.state for state in reproduce.states(project)] == ["up to date", "up to date"]


def test_edited_parameter_reruns_that_experiment_alone(project: Path) -> None:
    edit(project / "notebooks" / "experiments.toml", "value = 3.0", "value = 6.0")
    assert [state.state for state in reproduce.states(project)] == ["up to date", "out of date"]
    report = reproduce.run(root=project)
    assert report.ran == ["single"]
    assert report.kept == ["pair/vertical", "pair/orbit"]
    assert json.loads((project / "results" / "single" / "metrics.json").read_text())["third_m"] == 2.0


def test_key_follows_what_a_part_depends_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def key() -> str:
        loaded = Project(project)
        return loaded.parts(loaded.experiments["single"], "full")[0].key

    first, notebook = key(), project / "notebooks" / "tiny.ipynb"
    document = nbformat.read(notebook, 4)
    document.cells[1].outputs = [nbformat.v4.new_output("stream", text="a stored output")]
    nbformat.write(document, notebook)
    assert key() == first
    document.cells[1].source += "\n# other"
    nbformat.write(document, notebook)
    assert key() != first
    second = key()
    (project / "environment.lock").write_text("numpy==3\n")
    assert key() not in (first, second)
    third = key()
    monkeypatch.setattr("steelnb.project.code_digest", lambda: "other code")
    assert key() not in (first, second, third)


def test_a_file_that_a_notebook_reads_is_part_of_its_key(project: Path) -> None:
    edit(
        project / "notebooks" / "experiments.toml", 'title = "One part"', 'title = "One part"\ninputs = ["data/in.csv"]'
    )

    def keys() -> list[str]:
        loaded = Project(project)
        return [loaded.parts(loaded.experiments[name], "full")[0].key for name in ("single", "pair")]

    absent = keys()
    (project / "data").mkdir()
    (project / "data" / "in.csv").write_text("1\n")
    present = keys()
    (project / "data" / "in.csv").write_text("2\n")
    changed = keys()
    assert len({absent[0], present[0], changed[0]}) == 3
    assert absent[1] == present[1] == changed[1]
    assert reproduce.run(["single"], root=project).ran == ["single"]
    assert reproduce.run(["single"], root=project).kept == ["single"]
    (project / "data" / "in.csv").write_text("3\n")
    assert reproduce.run(["single"], root=project).ran == ["single"]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"trajectry": "orbit"}, ["pair", "'trajectry'", "did you mean 'trajectory'", "count"]),
        ({"value": "fast"}, ["value = 'fast'", "a finite number", "1.0"]),
        ({"value": float("nan")}, ["value = nan"]),
        ({"value": True}, ["value = True"]),
        ({"count": 1.5}, ["count = 1.5", "whole number"]),
        ({"count": True}, ["count = True"]),
        ({"deep": 1}, ["deep = 1", "true or false"]),
        ({"trajectory": 5}, ["trajectory = 5", "a text"]),
        ({"noise": "random-walk"}, ["noise = 'random-walk'", "a list"]),
        ({"noise": ["random-walk", 3]}, ["noise[1] = 3", "a text"]),
        ({"noise": ["random-walk", "random-walk:-1"]}, ["random_walk_m = -1.0", "greater than or equal to 0"]),
        ({"trajectory": "spiral"}, ["trajectory = 'spiral'", "orbit"]),
        ({"overrides": 3}, ["overrides = 3"]),
        ({"tof.rate_hz": 0}, ["rate_hz = 0", "greater than 0"]),
        ({"tof.rate": 1}, ["unknown setting 'tof.rate'"]),
        ({"results_dir": "x"}, ["results_dir", "-o"]),
    ],
)
def test_bad_parameters_are_refused_before_anything_is_written(
    project: Path, parameters: dict, words: list[str]
) -> None:
    before = contents(project, cache=True)
    with pytest.raises(SettingsError) as caught:
        reproduce.run(parameters=parameters, output=project / "out", root=project)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)
    assert contents(project, cache=True) == before


def test_other_bad_calls_are_refused(project: Path) -> None:
    before = contents(project, cache=True)
    with pytest.raises(SettingsError, match="-o FOLDER"):
        reproduce.run(parameters={"value": 1.0}, root=project)
    with pytest.raises(SettingsError, match="outside"):
        reproduce.run(parameters={"value": 1.0}, output=project / "results", root=project)
    with pytest.raises(SettingsError, match="outside"):
        reproduce.run(budget="smoke", output=project / "notebooks" / ".." / "results" / "x", root=project)
    with pytest.raises(SettingsError, match="budget = 'huge'"):
        reproduce.run(budget="huge", root=project)
    with pytest.raises(SettingsError, match="jobs = 0"):
        reproduce.run(jobs=0, root=project)
    with pytest.raises(UnknownExperimentError, match=r"'singel', did you mean 'single'\?; known: pair, single"):
        reproduce.run(["singel"], root=project)
    with pytest.raises(OutputError, match=r"environment\.lock"):
        reproduce.run(output=project / "environment.lock" / "below", root=project)
    assert contents(project, cache=True) == before


def test_parameters_of_the_user_reach_the_notebook_and_leave_the_results_alone(project: Path) -> None:
    before = contents(project / "results")
    given = {"trajectory": "orbit", "tof.rate_hz": 10, "value": 9}
    report = reproduce.run(["pair"], parameters=given, output=project / "mine", root=project)
    assert report.ran == ["pair"], "the matrix axis that the user fixed should be gone"
    metrics = json.loads((project / "mine" / "pair" / "metrics.json").read_text())
    assert metrics == {"count": 1, "rate_hz": 10, "third_m": 3.0}
    assert "orbit,random-walk,3" in (project / "mine" / "pair" / "table.csv").read_text().splitlines()
    assert contents(project / "results") == before
    assert reproduce.run(root=project).ran == []
    shutil.rmtree(project / ".cache" / "reproduce" / "parts")
    assert reproduce.run(["pair"], parameters=given, output=project / "mine", root=project).ran == []


def test_failing_notebooks_are_named_and_the_others_finish(project: Path) -> None:
    table = '[{0}]\nnotebook = "tiny.ipynb"\ntitle = "fails"\nfull = {{ fail = "{1}" }}\nsmoke = {{}}\n'
    failing = {"wrong": "ValueError", "refused": "SettingsError", "dead": "exit"}
    with (project / "notebooks" / "experiments.toml").open("a") as file:
        file.writelines(table.format(name, error) for name, error in failing.items())
    edit(project / "notebooks" / "experiments.toml", "value = 3.0", "value = 6.0")
    with pytest.raises(NotebookError) as caught:
        reproduce.run(root=project)
    assert isinstance(caught.value, reproduce.NotebooksFailedError)
    assert caught.value.exit_code == 1
    lines = {line.partition(":")[0]: line for line in caught.value.failures}
    assert set(lines) == set(failing)
    assert "wrong: ValueError: nothing doing" in lines["wrong"]
    assert "refused: SettingsError: nothing doing" in lines["refused"]
    assert "dead: DeadKernelError" in lines["dead"]
    executed = Path(lines["wrong"].partition("(see ")[2].removesuffix(")"))
    assert ".cache" in executed.parts
    assert "ValueError" in executed.read_text()
    assert sorted(path.name for path in (project / "results").iterdir()) == ["pair", "single"]
    assert json.loads((project / "results" / "single" / "metrics.json").read_text())["third_m"] == 2.0
    with pytest.raises(reproduce.NotebooksFailedError) as caught:
        reproduce.run(["refused"], root=project)
    assert caught.value.exit_code == 2


def marked(mark: str) -> list[psutil.Process]:
    """Processes below the one that was started with the mark."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("STEELNB_TEST_MARK") == mark:
                found.append(process)
        except (psutil.Error, OSError):
            continue
    return found


def wait_until(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (reached := condition()) and time.monotonic() < end:
        time.sleep(0.05)
    return bool(reached)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_interruption_leaves_nothing_and_the_next_call_resumes(tmp_path: Path, number: signal.Signals) -> None:
    root, mark = make_project(tmp_path / "project"), f"{os.getpid()}-{number}"
    gate, asleep = root / "notebooks" / "gate-orbit", root / "notebooks" / "asleep-orbit"
    stored = root / ".cache" / "reproduce" / "parts" / "full" / "pair" / "vertical" / "record.json"
    gate.touch()
    process = subprocess.Popen(
        [sys.executable, "-m", "steelnb.cli", "reproduce", "pair"],
        cwd=root,
        env={**os.environ, "STEELNB_TEST_MARK": mark},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert wait_until(lambda: asleep.exists() and stored.exists(), 60)
        assert len(marked(mark)) >= 3, "expected the call, a worker and a kernel"
        process.send_signal(number)
        _, errors = process.communicate(timeout=15)
        assert wait_until(lambda: not marked(mark), 5 if number == signal.SIGKILL else 0), marked(mark)
    finally:
        for stray in marked(mark):
            stray.kill()
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert [line for line in errors.splitlines() if "error" in line] == [errors.splitlines()[-1]]
        assert not list((root / ".cache" / "reproduce" / "scratch").iterdir())
    assert not (root / "results").exists()
    if number == signal.SIGINT:
        gate.unlink()
        report = reproduce.run(["pair"], root=root)
        assert report.ran == ["pair/orbit"]
        assert len(json.loads((root / "results" / "pair" / "metrics.json").read_text())) == 6
        assert not list((root / ".cache" / "reproduce" / "scratch").iterdir())


def test_what_was_edited_while_it_ran_runs_again(project: Path) -> None:
    edited: list[reproduce.Status] = []

    def on_progress(status: reproduce.Status) -> None:
        if not edited:
            edit(project / "notebooks" / "tiny.ipynb", "progress.step()", "progress.step()  # edited")
        edited.append(status)

    assert reproduce.run(["single"], root=project, force=True, on_progress=on_progress).ran == ["single"]
    assert "runs it again" in edited[-1].event
    assert reproduce.run(["single"], root=project).ran == ["single"]
    assert reproduce.run(["single"], root=project).ran == []


def test_two_calls_at_once_are_refused(project: Path) -> None:
    import fcntl

    with (project / ".cache" / "reproduce" / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="another run"):
            reproduce.run(["single"], root=project, force=True)


def test_check_compares_a_second_run_with_the_last_commit(project: Path) -> None:
    metrics = project / "results" / "single" / "metrics.json"
    now = metrics.read_text()
    edit(metrics, '"third_m": 1.0', '"third_m": 1.00001')
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
    subprocess.run([*git, "init", "-q"], cwd=project, check=True)
    subprocess.run([*git, "add", "results"], cwd=project, check=True)
    subprocess.run([*git, "commit", "-q", "-m", "results"], cwd=project, check=True)
    metrics.write_text(now)  # the tree is right, the commit is not
    before = contents(project / "results")
    lying = reproduce.check(["single"], root=project, rerun=False)
    assert [each.name for each in lying.differences] == ["single.third_m"]
    assert not (project / ".cache" / "reproduce" / "check").exists()
    report = reproduce.check(["single"], root=project)
    assert [(each.name, each.committed, each.now) for each in report.differences] == [
        ("single.third_m", "1.00001", "1.0")
    ]
    assert (report.metrics, report.experiments) == (3, 1)
    assert contents(project / "results") == before
    assert contents(report.folder / "single") == contents(metrics.parent), "two runs should give the same bytes"


def test_check_without_git_takes_the_tree_and_wants_results(project: Path) -> None:
    with pytest.raises(FileMissingError, match=r"results-smoke/pair/metrics\.json"):
        reproduce.check(budget="smoke", root=project)
    name = "results/single/metrics.json"
    assert committed_text(project, name) == (project / name).read_text()


def result(metrics: dict, table: str) -> dict[str, str]:
    return {"metrics.json": json.dumps(metrics), "table.csv": table}


def test_compare_finds_every_kind_of_difference() -> None:
    before = result({"a_m": 1.0, "zero": 0.0, "gone": 1, "loose_m": 1.0}, "name,x_m\nfirst,2.0\nsecond,\n")
    close = result({"a_m": 1 + 9e-7, "zero": 9e-13, "gone": 1, "loose_m": 1.0}, "name,x_m\nfirst,2.000001\nsecond,\n")
    far = result({"a_m": 1 + 2e-6, "zero": 2e-12, "new": 1, "loose_m": 2.0}, "name,x_m,y\nFirst,2.00001,\nsecond,0,\n")
    settings = CheckSettings(exceptions={"e.loose*": "why"})
    assert compare("e", before, before, settings) == []
    assert compare("e", before, close, settings) == []
    found = compare("e", before, far, settings)
    assert {(each.name, each.where) for each in found if not each.reason} == {
        ("e.a_m", ""),
        ("e.zero", ""),
        ("e.gone", ""),
        ("e.new", ""),
        ("e.name", "row 1"),
        ("e.x_m", "row 1"),
        ("e.x_m", "row 2"),
        ("e.y", "row 1"),
        ("e.y", "row 2"),
    }
    assert [(each.name, each.reason) for each in found if each.reason] == [("e.loose_m", "why")]
    shorter = result(json.loads(before["metrics.json"]), "name,x_m\nfirst,2.0\n")
    assert [each.where for each in compare("e", before, shorter, settings)] == ["rows"]


def write(folder: Path | str, metrics: dict, figures: tuple[str, ...] = ()) -> None:
    table = pd.DataFrame({"x": [1.0, np.nan]})
    write_results(folder, table=table, metrics=metrics, figures={name: Figure() for name in figures}, provenance={})


def test_write_results_writes_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write("", {"x": 1.0})
    assert not list(tmp_path.iterdir())
    write("out", {"b": np.float32(0.5), "a": np.int64(2)}, ("fig_1", "2"))
    assert (tmp_path / "out" / "metrics.json").read_text() == '{\n  "a": 2,\n  "b": 0.5\n}\n'
    assert (tmp_path / "out" / "table.csv").read_text() == 'x\n1\n""\n'
    (tmp_path / "out" / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    for value in (np.nan, np.inf, "1", True, None):
        with pytest.raises(ValueError, match=r"metrics: x = .*finite number"):
            write("out", {"x": value})
    with pytest.raises(ValueError, match="Out of range"):
        write_results("out", table=pd.DataFrame(), metrics={"x": 2}, figures={}, provenance={"settings": {"x": np.nan}})
    assert contents(tmp_path) == before
    write("out", {"x": 1}, ("3",))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "fig_3.png",
        "metrics.json",
        "notes.txt",
        "provenance.json",
        "table.csv",
    ]
    (tmp_path / "file").touch()
    for folder in ("file", "file/below"):
        with pytest.raises(OutputError, match="file"):
            write(folder, {"x": 1})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "out"]


def test_merge_joins_different_columns(tmp_path: Path) -> None:
    for name, table in {"a": 'x,note\n0.1000,"one,\ntwo"\n', "b": "x,z\n2,3\n"}.items():
        write(tmp_path / name, {"m": 1})
        (tmp_path / name / "table.csv").write_text(table)
    merge({name: tmp_path / name for name in "ba"}, tmp_path / "all", {})
    assert (tmp_path / "all" / "table.csv").read_text() == 'x,z,note\n2,3,\n0.1000,,"one,\ntwo"\n'


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("a=1", "a", 1),
        ("a = 1.5", "a", 1.5),
        ("a=True", "a", True),
        ("a=true", "a", True),
        ("a=orbit", "a", "orbit"),
        ("a='2'", "a", "2"),
        ("a=x=y", "a", "x=y"),
        ("a=random-walk+yaw-random-walk:0.001", "a", "random-walk+yaw-random-walk:0.001"),
        ("a=['x', 2]", "a", ["x", 2]),
        ("a=[true]", "a", [True]),
        ("a={ b = 1 }", "a", {"b": 1}),
        ("a=2024-01-01", "a", "2024-01-01"),
        ("a={1, 2}", "a", "{1, 2}"),
        ("a=", "a", ""),
        ("tof.rate_hz=10", "tof.rate_hz", 10),
    ],
)
def test_parse_parameter(text: str, name: str, value: object) -> None:
    parsed = parse_parameter(text)
    assert parsed == (name, value)
    assert type(parsed[1]) is type(value)


@pytest.mark.parametrize("text", ["a", "=1", ""])
def test_parse_parameter_refuses(text: str) -> None:
    with pytest.raises(SettingsError, match="NAME=VALUE"):
        parse_parameter(text)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[pair]", "[pair", "not a TOML file"),
        ('title = "Two parts"\n', "", "title"),
        ("smoke = {}", "smoke = {}\nspeed = 1", "speed = 1"),
        ('["vertical", "orbit"]', '["orbit", "orbit"]', "distinct"),
        ('["vertical", "orbit"]', '["vertical", "spiral"]', "'spiral'"),
        ("value = 3.0", "valeu = 3.0", "did you mean 'value'"),
        ("[check]", "[check]\nfoo = 1", "foo"),
        ("tiny.ipynb", "none.ipynb", "none.ipynb"),
    ],
)
def test_bad_experiments_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    root = make_project(tmp_path / "project", EXPERIMENTS.replace(old, new))
    with pytest.raises(SteelnbError, match=words):
        reproduce.run(root=root)
    assert not (root / ".cache").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"parameters"', '"parametres"', "0 cells are tagged"),
        ("value = 1.0", "value = 1.0 * 2", "plain literals"),
        ("results_dir = ", "results = ", "expected results_dir"),
        ('"cells"', '"sells"', "not a notebook"),
    ],
)
def test_bad_notebooks_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    root = make_project(tmp_path / "project")
    edit(root / "notebooks" / "tiny.ipynb", old, new)
    with pytest.raises(NotebookError, match=words):
        reproduce.run(root=root)


def test_root_is_found_upwards(finished: Path) -> None:
    assert find_root(finished / "results" / "pair") == finished


def test_estimate_of_the_time_left() -> None:
    assert estimate([(None, 0.0, 0.0), (None, 3.0, 0.0)], 2) == (0.0, None)
    fraction, left_s = estimate([(None, 10.0, 0.5), (None, 0.0, 0.0)], 1)
    assert (fraction, left_s) == (pytest.approx(10 / 40), pytest.approx(30))
    fraction, left_s = estimate([(20.0, 20.0, 1.0), (30.0, 0.0, 0.0), (10.0, 0.0, 0.0)], 2)
    assert (fraction, left_s) == (pytest.approx(20 / 60), pytest.approx(30)), "the longest part bounds the time"
    assert estimate([(5.0, 8.0, 1.0)], 2) == (1.0, 0.0)
    assert estimate([], 2) == (0.0, None)


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
    assert shown == ["0.0625", "0.0625", "0.2500", "0.2500", "0.5000", "0.5000", "0.7500", "0.7500"]
    assert file.read_text() == "1.0000"
    shutil.rmtree(tmp_path)
    progress.update(1.0)


def test_progress_is_a_bar_where_nobody_asks_for_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STEELNB_PROGRESS_FILE", raising=False)
    progress = Progress(2, "flights")
    progress.step()
    progress.step()
    assert "flights: 100%" in capsys.readouterr().err


def test_an_experiment_apart_runs_only_when_it_is_named(project: Path) -> None:
    names = [experiment.id for experiment in Project(project).select()]
    edit(project / "notebooks" / "experiments.toml", "[single]", "[single]\napart = true")
    selected = Project(project)
    assert [experiment.id for experiment in selected.select()] == names
    assert [experiment.id for experiment in selected.select(apart=False)] == [n for n in names if n != "single"]
    assert [experiment.id for experiment in selected.select(["single"], apart=False)] == ["single"]
