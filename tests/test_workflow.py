"""The workflow on real notebooks through papermill, in a tiny project of their own."""

import contextlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import numpy as np
import psutil
import pytest

from steelnb.notebook.results import find_root
from workflow.__main__ import main
from workflow.experiments import make_parts
from workflow.run_notebooks import latest_parts, stopped

ROOT = Path(__file__).parents[1]
EXPERIMENTS = """
[pair]
notebook = "tiny.ipynb"
title = "Two parts"
figures = "1.1"
matrix = { trajectory = ["zigzag", "loops"] }
full = { value = 2 }
smoke = { value = 0.5 }

[single]
notebook = "tiny.ipynb"
title = "One part"
full = { value = 3.0 }
smoke = {}
"""
PARAMETERS = """
trajectory = "zigzag"
noise = ["random-walk", "constant-drift:0.0002"]
value = 1.0
count = 1
overrides = {}
fail = ""
results_dir = ""  # empty: show only
"""
# The gate may contain a sleep that holds the interpreter's lock, as a long call of compiled code does.
GATE = """
import ctypes, os, pathlib, sys, time
from steelnb.core.errors import InputError
from steelnb.notebook import results
from steelnb.notebook.progress import Progress
assert sys.executable == os.environ.get("STEELNB_TEST_PYTHON", sys.executable)
assert os.environ["NUMBA_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == "1"
assert "inline" in os.environ["MPLBACKEND"]
progress = Progress(1, "tiny")
progress.update(0.5)
gate = pathlib.Path(f"gate-{trajectory}")
if gate.exists():
    pathlib.Path(f"asleep-{trajectory}").touch()
    exec(gate.read_text())
if fail == "exit":
    os._exit(3)
if fail == "nothing":
    results_dir = ""
elif fail:
    raise {"ValueError": ValueError, "InputError": InputError}[fail]("nothing\\ndoing")
"""
RESULT = """
import pandas
from matplotlib.figure import Figure
figure = Figure()
figure.subplots().plot([0, value])
table = {"trajectory": trajectory, "noise": noise, "third_m": [value / 3, 1e-12 / 3]}
results.write_results(
    results_dir,
    table=pandas.DataFrame(table | ({"only": 1.5} if trajectory == "loops" else {})),
    metrics={"third_m": value / 3, "rate_hz": overrides.get("tof.rate_hz", 5.0), "count": count},
    figures={"fig_1_1": figure},
    timing=pandas.DataFrame({"stage": ["all"], "seconds": [0.1]}),
    provenance={"settings": {"value": value}, "seeds": [1]},
)
progress.step()
"""


def make_project(root: Path) -> Path:
    """A project with one tiny notebook."""
    cells = [nbformat.v4.new_code_cell(source.strip()) for source in (PARAMETERS, GATE, RESULT)]
    cells[0].metadata["tags"] = ["parameters"]
    (root / "notebooks").mkdir(parents=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), root / "notebooks" / "tiny.ipynb")
    (root / "notebooks" / "runs.toml").write_text(EXPERIMENTS, encoding="utf-8")
    (root / "environment.lock").write_text("numpy==2\n")
    return root


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a project but measured times, the cache and the working copy of git."""
    names = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    kept = [name for name in names if name.parts[0] not in (".cache", ".git") and name.name != "timing.csv"]
    return {str(name): (folder / name).read_bytes() for name in kept}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def started(text: str) -> set[str]:
    return set(re.findall(r"^(\S+): started", text, re.MULTILINE))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose experiments have been run, in a shell with its own set-up. Tests must not change it."""
    root = make_project(tmp_path_factory.mktemp("finished") / "project")
    seen = {"PATH": os.defpath, "MPLBACKEND": "pdf", "STEELNB_TEST_PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "workflow", "reproduce"]
    done = subprocess.run(command, cwd=root, env={**os.environ, **seen}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert started(done.stderr) == {"pair/loops", "pair/zigzag", "single"}
    return root


@pytest.fixture
def project(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished project in another folder, which is the current one."""
    root = Path(shutil.copytree(finished, tmp_path / "copy"))
    monkeypatch.chdir(root)
    return root


def test_fresh_run_merges_parts(finished: Path) -> None:
    pair, single = finished / "results" / "pair", finished / "results" / "single"
    numbers = {"count": 1, "rate_hz": 5.0, "third_m": 2 / 3}
    wanted = {f"{part}.{name}": value for part in ("loops", "zigzag") for name, value in numbers.items()}
    assert json.loads((pair / "metrics.json").read_text()) == wanted
    assert (pair / "table.csv").read_text().splitlines() == [
        "trajectory,noise,third_m,only",
        "zigzag,random-walk,0.666666667,",
        "zigzag,constant-drift:0.0002,3.33333333e-13,",
        "loops,random-walk,0.666666667,1.5",
        "loops,constant-drift:0.0002,3.33333333e-13,1.5",
    ]
    assert sorted(path.name for path in pair.glob("*.png")) == ["fig_1_1_loops.png", "fig_1_1_zigzag.png"]
    files = ["fig_1_1.png", "metrics.json", "provenance.json", "table.csv", "timing.csv"]
    assert sorted(path.name for path in single.iterdir()) == files
    provenance = json.loads((pair / "provenance.json").read_text())
    assert {"experiment": "pair", "notebook": "tiny.ipynb", "budget": "full"}.items() <= provenance.items()
    assert provenance["parts"]["loops"]["settings"]["value"] == 2.0
    assert provenance["parts"]["loops"]["versions"]["numpy"] == np.__version__
    for text in (str(finished), platform.node(), sys.prefix):
        assert text not in (pair / "provenance.json").read_text()
    assert not [*finished.rglob(".steelnb-*"), *finished.rglob("run-*")]
    assert find_root(pair) == finished


def test_nothing_runs_twice_and_spoilt_results_are_restored(project: Path, capsys: pytest.CaptureFixture) -> None:
    (project / "results" / "README.md").write_text("Before.\n<!-- table -->\nold\n<!-- /table -->\nAfter.\n")
    assert main(["reproduce"]) == 0
    before = contents(project)
    overview = before["results/README.md"].decode()
    assert '<img src="pair/fig_1_1_zigzag.png"' in overview
    assert re.search(r"^Before\.\n.*tiny\.ipynb.*single/metrics\.json.*\nAfter\.$", overview, re.DOTALL)
    shutil.rmtree(project / "results" / "pair")
    (project / "results" / "single" / "fig_1_1.png").unlink()
    (project / "results" / "single" / "fig_old.png").touch()
    edit(project / "results" / "single" / "metrics.json", "5.0", "6.0")
    assert main(["reproduce"]) == 0
    assert capsys.readouterr() == ("everything is up to date\n" * 2, "")
    assert contents(project) == before


def test_a_part_that_is_the_same_at_both_budgets_runs_once(project: Path, capsys: pytest.CaptureFixture) -> None:
    edit(project / "notebooks" / "runs.toml", "smoke = {}", "smoke = { value = 3.0 }")
    assert main(["reproduce", "single", "--budget", "smoke"]) == 0
    assert not started(capsys.readouterr().err)
    smoke, full = (contents(project / name / "single") for name in ("results-smoke", "results"))
    assert smoke.keys() == full.keys()
    assert smoke["table.csv"] == full["table.csv"]
    edit(project / "notebooks" / "runs.toml", "smoke = { value = 3.0 }", "smoke = { value = 4.0 }")
    assert main(["reproduce", "single", "--budget", "smoke"]) == 0
    assert started(capsys.readouterr().err) == {"single"}


def test_tests_and_pages_show_what_is_up_to_date_at_the_full_budget_and_else_a_short_run(project: Path) -> None:
    def shown() -> list[tuple[str, float]]:
        return [(part.label, part.parameters["value"]) for part in latest_parts(project)]

    assert shown() == [("pair/zigzag", 2.0)]
    edit(project / "notebooks" / "runs.toml", "value = 2 }", "value = 5 }")
    assert shown() == [("pair/zigzag", 0.5)]
    assert main(["reproduce", "pair"]) == 0
    assert shown() == [("pair/zigzag", 5.0)]


def test_key_follows_what_a_part_depends_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = project / "notebooks" / "tiny.ipynb"
    (project / "data.csv").write_text("1\n")
    edit(project / "notebooks" / "runs.toml", 'title = "One part"', 'title = "One part"\ninputs = ["data.csv"]')

    def keys() -> list[str]:
        return [part.key() for part in make_parts(project, [], "full")]

    seen = [keys()]
    document = nbformat.read(notebook, 4)
    document.cells[1].outputs = [nbformat.v4.new_output("stream", text="a stored output")]
    nbformat.write(document, notebook)
    assert keys() == seen[0]
    document.cells[1].source += "\n# other"
    nbformat.write(document, notebook)
    seen.append(keys())
    (project / "environment.lock").write_text("numpy==3\n")
    seen.append(keys())
    monkeypatch.setattr("workflow.experiments.digest_rooms", lambda: "other code")
    seen.append(keys())
    assert len({key for some in seen for key in some}) == 12
    (project / "data.csv").write_text("2\n")
    assert [old == new for old, new in zip(seen[-1], keys(), strict=True)] == [True, True, False]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("-p trajectry=loops", ["pair", "trajectry", "did you mean 'trajectory'", "count"]),
        ("-p value", ["NAME=VALUE"]),
        ("singel", ["ONLY = 'singel'", "did you mean 'single'", "'pair', 'single'"]),
        ("--budget huge", ["BUDGET = 'huge'", "'full', 'smoke'"]),
        ("--jobs 0", ["--jobs", "1"]),
        ("--output environment.lock/below", ["environment.lock", "cannot be written"]),
        ("--output results -p value=1", ["outside"]),
        ("--output notebooks/../results/x --budget smoke", ["outside"]),
        (("[pair]", "[pair"), ["not a TOML file"]),
        (('title = "Two parts"\n', ""), ["title"]),
        (("smoke = {}", "smoke = {}\nspeed = 1"), ["speed = 1"]),
        (('["zigzag", "loops"]', '["loops", "loops"]'), ["distinct"]),
        (("tiny.ipynb", "none.ipynb"), ["none.ipynb"]),
    ],
)
def test_bad_calls_and_files_of_experiments_are_refused_before_anything_is_written(
    project: Path, capsys: pytest.CaptureFixture, call: str | tuple[str, str], words: list[str]
) -> None:
    if isinstance(call, tuple):
        edit(project / "notebooks" / "runs.toml", *call)
    before = contents(project)
    assert main(["reproduce", *(call.split() if isinstance(call, str) else [])]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert all(word in line for word in words), line
    assert contents(project) == before


def test_parameters_of_ones_own_leave_the_results_alone(project: Path, capsys: pytest.CaptureFixture) -> None:
    before = contents(project / "results")
    given = ["reproduce", "pair", "-p", "trajectory=loops tof.rate_hz=10 value=9 noise=[a, b]", "--output", "mine"]
    assert main([each.replace("a, b", "none, random-walk") for each in given]) == 0
    assert started(capsys.readouterr().err) == {"pair"}, "the matrix axis that the user fixed should be gone"
    metrics = json.loads((project / "mine" / "pair" / "metrics.json").read_text())
    assert metrics == {"count": 1, "rate_hz": 10, "third_m": 3.0}
    assert "loops,none,3,1.5" in (project / "mine" / "pair" / "table.csv").read_text().splitlines()
    assert main(["reproduce"]) == 0
    assert capsys.readouterr().out == "everything is up to date\n"
    assert contents(project / "results") == before


def test_failing_cells_are_named_and_the_others_finish(project: Path, capsys: pytest.CaptureFixture) -> None:
    table = '[{0}]\nnotebook = "tiny.ipynb"\ntitle = "fails"\nfull = {{ fail = "{1}" }}\nsmoke = {{}}\n'
    failing = {"wrong": "ValueError", "refused": "InputError", "dead": "exit", "empty": "nothing"}
    with (project / "notebooks" / "runs.toml").open("a") as file:
        file.writelines(table.format(name, error) for name, error in failing.items())
    edit(project / "notebooks" / "runs.toml", "value = 3.0", "value = 6.0")
    assert main(["reproduce"]) == 1
    shown = capsys.readouterr().err
    assert started(shown) == {*failing, "single"}, "what an edit does not concern should not be run"
    errors = [line for line in shown.splitlines() if line.startswith("error: ")]
    lines = {line.split(":")[1].strip(): line for line in errors}
    assert set(lines) == set(failing)
    assert "wrong: tiny.ipynb, cell 2: ValueError: nothing doing" in lines["wrong"]
    assert "refused: tiny.ipynb, cell 2: InputError: nothing doing" in lines["refused"]
    assert "dead: tiny.ipynb, cell 2: DeadKernelError" in lines["dead"]
    assert "metrics.json, table.csv, provenance.json missing" in lines["empty"]
    executed = Path(lines["wrong"].partition("(see ")[2].removesuffix(")"))
    assert "ValueError" in executed.read_text()
    assert sorted(path.name for path in (project / "results").iterdir()) == ["pair", "single"]
    assert json.loads((project / "results" / "single" / "metrics.json").read_text())["third_m"] == 2.0
    assert main(["reproduce", "refused"]) == 2


def marked(mark: str) -> list[psutil.Process]:
    """The process that was started with the mark, and its descendants."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if process.environ().get("STEELNB_TEST_MARK") == mark:
                found.append(process)
    return found


def wait_until(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (reached := condition()) and time.monotonic() < end:
        time.sleep(0.05)
    return bool(reached)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=lambda number: number.name)
def test_a_stopped_run_leaves_nothing_and_the_next_one_resumes(
    finished: Path, tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    with stopped(str(tmp_path / "none")):
        assert signal.getsignal(signal.SIGTERM) == signal.getsignal(signal.SIGINT)  # so one of them is enough
    root, mark, killed = make_project(tmp_path / "project"), f"{os.getpid()}-{number}", number == signal.SIGKILL
    monkeypatch.chdir(root)
    gate, asleep = root / "notebooks" / "gate-loops", root / "notebooks" / "asleep-loops"
    # A kernel reacts to SIGKILL only when its interpreter runs.
    gate.write_text("time.sleep(120)" if killed else "ctypes.PyDLL(None).sleep(120)")
    command = [sys.executable, "-m", "workflow", "reproduce", "pair"]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "STEELNB_TEST_MARK": mark}
    run = subprocess.Popen(command, cwd=root, env=env, stderr=-1, text=True, start_new_session=True)
    try:
        assert run.stderr is not None
        assert next(line for line in run.stderr if line.startswith("pair/zigzag: done"))
        assert wait_until(asleep.exists, 60)
        run.send_signal(number)
        errors = run.communicate(timeout=60)[1]
        assert wait_until(lambda: not marked(mark), 5), marked(mark)
    finally:
        for stray in marked(mark):
            stray.kill()
    assert run.returncode == (-9 if killed else 130)
    assert "Traceback" not in errors
    assert not (root / "results" / "pair").exists()
    gate.unlink()
    assert main(["reproduce", "pair"]) == 0
    assert started(capsys.readouterr().err) == {"pair/loops"}
    assert contents(root / "results" / "pair") == contents(finished / "results" / "pair")


def test_check_finds_a_digit_that_differs_from_the_last_commit(project: Path, capsys: pytest.CaptureFixture) -> None:
    results = project / "results" / "single"
    now, git = (results / "metrics.json").read_text(), ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
    edit(results / "metrics.json", '"third_m": 1.0', '"third_m": 1.0000000000000002')
    shutil.rmtree(project / "results" / "pair")
    for command in (["init", "-q"], ["add", "results"], ["commit", "-q", "-m", "results"]):
        subprocess.run([*git, *command], cwd=project, check=True)
    (results / "metrics.json").write_text(now)  # the tree is right, the commit is not
    before = contents(project)
    assert main(["check", "pair"]) == 2, "there is nothing to compare with"
    assert "results/pair/metrics.json" in capsys.readouterr().err
    assert main(["check", "single"]) == 1
    shown = capsys.readouterr()
    assert started(shown.err) == {"single"}
    differing = [line for line in shown.out.splitlines() if re.match(r"[-+] ", line)]
    assert differing == ['-  "third_m": 1.0000000000000002', '+  "third_m": 1.0']
    assert contents(project) == before
    again = project / ".cache" / "check" / "results" / "single"
    assert contents(again) == contents(results), "two runs should give the same bytes"
    subprocess.run([*git, "commit", "-q", "-am", "right"], cwd=project, check=True)
    assert main(["check", "single"]) == 0


def test_an_experiment_apart_runs_only_when_it_is_named(project: Path) -> None:
    def names(ids: list[str], budget: str) -> list[str]:
        return [part.label for part in make_parts(project, ids, budget)]

    edit(project / "notebooks" / "runs.toml", "[single]", "[single]\napart = true")
    assert names([], "full") == ["pair/zigzag", "pair/loops"]
    assert names(["single"], "full") == ["single"]
    assert names([], "smoke") == ["pair/zigzag", "pair/loops", "single"]


def test_make_hands_the_parameters_on_as_they_stand(tmp_path: Path) -> None:
    (tmp_path / "python").write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    (tmp_path / "python").chmod(0o755)
    given = """noise=["random-walk", 'none'] tof.rate_hz=10"""
    command = ["make", "-s", "-o", ".venv/.ready", "reproduce", f"BIN={tmp_path}", f"P={given}", "OUT=mine"]
    shown = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert shown.splitlines() == ["-m", "workflow", "reproduce", "--output", "mine", "-p", given]
