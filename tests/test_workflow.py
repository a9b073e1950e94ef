"""The workflow on real notebooks through papermill, in a tiny project of their own."""

import fcntl
import json
import os
import platform
import random
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

from steelnb.errors import InputError
from steelnb.results import find_root
from workflow import task_notebooks
from workflow.__main__ import main, make_plans
from workflow.check import CheckSettings, differences, read_committed, read_results
from workflow.experiments import read_experiments
from workflow.merge import merge

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

[check]
exceptions = { "single.loose*" = "depends on the weather" }
"""
PARAMETERS = """
trajectory = "zigzag"
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
from steelnb.errors import InputError
from steelnb import results
assert sys.executable == os.environ.get("STEELNB_TEST_PYTHON", sys.executable)
assert os.environ["NUMBA_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == "1"
assert "MPLBACKEND" not in os.environ or "inline" in os.environ["MPLBACKEND"]
progress = results.Progress(1, "tiny")
progress.update(0.5)
if pathlib.Path(f"gate-{trajectory}").exists():
    pathlib.Path(f"asleep-{trajectory}").write_text(str(os.getpid()))
    ctypes.PyDLL(None).sleep(120)
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
results.write_results(
    results_dir,
    table=pandas.DataFrame({"trajectory": trajectory, "noise": noise, "third_m": [value / 3, 1e-12 / 3]}),
    metrics={"third_m": value / 3, "rate_hz": overrides.get("tof.rate_hz", 5.0), "count": count},
    figures={"fig_1_1": figure},
    timing=pandas.DataFrame({"stage": ["all"], "seconds": [0.1]}),
    provenance={"settings": {"value": value}, "seeds": [1]},
)
progress.step()
"""
FILES = ["fig_1_1.png", "metrics.json", "provenance.json", "table.csv", "timing.csv"]


def make_project(root: Path, experiments: str = EXPERIMENTS) -> Path:
    """A project with one tiny notebook."""
    cells = [nbformat.v4.new_code_cell(source.strip()) for source in (PARAMETERS, GATE, RESULT)]
    cells[0].metadata["tags"] = ["parameters"]
    (root / "notebooks").mkdir(parents=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), root / "notebooks" / "tiny.ipynb")
    (root / "notebooks" / "runs.toml").write_text(experiments, encoding="utf-8")
    (root / "environment.lock").write_text("numpy==2\n")
    return root


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a project but the cache and the working copy of git."""
    names = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(name): (folder / name).read_bytes() for name in names if name.parts[0] not in (".cache", ".git")}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def started(text: str) -> set[str]:
    return set(re.findall(r"\] (\S+): started", text))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose experiments have been run; not to be changed."""
    root = make_project(tmp_path_factory.mktemp("finished") / "project")
    # As in a shell where no environment is activated and another Python comes first.
    seen = {"PATH": os.defpath, "MPLBACKEND": "pdf", "STEELNB_TEST_PYTHON": sys.executable}
    done = call(root, "reproduce", **seen)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if "] running " not in line]  # every half minute
    assert started(done.stderr) == {"pair/loops", "pair/zigzag", "single"}
    assert len([line for line in lines if re.fullmatch(r"\[[123]/3\] \S+: done in \d+ s", line)]) == 3
    assert len(lines) == 6, "nothing but events"
    assert sorted(done.stdout.splitlines()) == ["results/pair/ written", "results/single/ written"]
    return root


def call(root: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "workflow", *arguments]
    env = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(command, cwd=root, env=env, capture_output=True, text=True, check=False)


@pytest.fixture
def project(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished project at another place, which is the current folder."""
    root = Path(shutil.copytree(finished, tmp_path / "copy"))
    monkeypatch.chdir(root)
    return root


def test_fresh_run_merges_parts(finished: Path) -> None:
    pair, single = finished / "results" / "pair", finished / "results" / "single"
    numbers = {"count": 1, "rate_hz": 5.0, "third_m": 2 / 3}
    wanted = {f"{part}.{name}": value for part in ("loops", "zigzag") for name, value in numbers.items()}
    assert json.loads((pair / "metrics.json").read_text()) == wanted
    assert (pair / "table.csv").read_text().splitlines() == [
        "trajectory,noise,third_m",
        "zigzag,random-walk,0.666666667",
        "zigzag,constant-drift:0.0002,3.33333333e-13",
        "loops,random-walk,0.666666667",
        "loops,constant-drift:0.0002,3.33333333e-13",
    ]
    assert sorted(path.name for path in pair.glob("*.png")) == ["fig_1_1_loops.png", "fig_1_1_zigzag.png"]
    assert sorted(path.name for path in single.iterdir()) == FILES
    assert json.loads((single / "metrics.json").read_text())["third_m"] == 1.0
    provenance = json.loads((pair / "provenance.json").read_text())
    assert {"experiment": "pair", "notebook": "tiny.ipynb", "budget": "full"}.items() <= provenance.items()
    assert provenance["parts"]["loops"]["settings"]["value"] == 2.0
    assert provenance["parts"]["loops"]["versions"]["numpy"] == np.__version__
    assert len(provenance["parts"]["zigzag"]["environment_lock_sha256"]) == 64
    for text in (str(finished), platform.node(), sys.prefix):
        assert text not in (pair / "provenance.json").read_text()
    assert "cores" in (single / "timing.csv").read_text()
    assert not list(finished.rglob(".steelnb-*"))
    assert not list(finished.rglob("scratch*"))
    assert not (finished / "notebooks" / "tiny.ipynb").read_text().count("output_type"), "the notebook was written to"


def test_a_second_call_runs_nothing_and_imports_nothing_heavy(project: Path) -> None:
    before = contents(project)
    command = "import sys, workflow.__main__ as w; code = w.main(['reproduce']); print(code, *sys.modules)"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    shown = subprocess.run([sys.executable, "-c", command], env=env, capture_output=True, text=True, check=True)
    line, modules = shown.stdout.splitlines()
    assert (line, shown.stderr) == ("everything is up to date", "")
    assert not {"numba", "open3d", "papermill", "pandas", "matplotlib"} & set(modules.split())
    assert contents(project) == before


def test_deleted_and_spoilt_results_are_restored_without_a_run(project: Path, capsys: pytest.CaptureFixture) -> None:
    before = contents(project)
    edit(project / "results" / "single" / "timing.csv", "0.1", "0.2")  # measured times: no reason to do anything
    assert main(["reproduce"]) == 0
    assert capsys.readouterr().out == "everything is up to date\n"
    shutil.rmtree(project / "results" / "pair")
    (project / "results" / "single" / "fig_1_1.png").unlink()
    (project / "results" / "single" / "fig_old.png").touch()
    edit(project / "results" / "single" / "metrics.json", "5.0", "6.0")
    assert main(["reproduce"]) == 0
    shown = capsys.readouterr()
    assert (sorted(shown.out.split()[::2]), shown.err) == (["results/pair/", "results/single/"], "")
    assert contents(project) == before


def test_key_follows_what_a_part_depends_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook, experiments = project / "notebooks" / "tiny.ipynb", project / "notebooks" / "runs.toml"
    (project / "data.csv").write_text("1\n")
    edit(experiments, 'title = "One part"', 'title = "One part"\ninputs = ["data.csv"]')

    def keys() -> list[str]:
        return [plan.parts[0].key() for plan in make_plans(project, ["pair", "single"], "full")]

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
    monkeypatch.setattr("workflow.experiments.digest_sources", lambda excluded: "other code")
    seen.append(keys())
    assert len({key for pair in seen for key in pair}) == 8
    (project / "data.csv").write_text("2\n")
    assert keys()[0] == seen[-1][0]
    assert keys()[1] != seen[-1][1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-p", "trajectry=loops"], ["pair", "'trajectry'", "did you mean 'trajectory'", "count"]),
        (["-p", "tof.rate_hz=0"], ["rate_hz = 0", "greater than 0"]),
        (["-p", "value"], ["NAME=VALUE"]),
        (["singel"], ["'singel', did you mean 'single'?", "known: pair, single"]),
        (["--budget", "huge"], ["budget = 'huge'", "full, smoke"]),
        (["--jobs", "0"], ["--jobs", "1"]),
        (["--output", "environment.lock/below"], ["environment.lock", "cannot be written"]),
        (["--output", "results", "-p", "value=1"], ["outside"]),
        (["--output", "notebooks/../results/x", "--budget", "smoke"], ["outside"]),
    ],
)
def test_bad_calls_are_refused_before_anything_is_written(
    project: Path, capsys: pytest.CaptureFixture, arguments: list[str], words: list[str]
) -> None:
    before = contents(project)
    if "--output" not in arguments:
        arguments = [*arguments, "--output", "out"]
    assert main(["reproduce", *arguments]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert all(word in line for word in words), line
    assert contents(project) == before


def test_parameters_of_ones_own_want_a_folder_and_leave_the_results_alone(
    project: Path, capsys: pytest.CaptureFixture
) -> None:
    before = contents(project / "results")
    assert main(["reproduce", "-p", "value=1"]) == 2
    assert "OUT=folder" in capsys.readouterr().err
    given = ["reproduce", "pair", "-p", "trajectory=loops tof.rate_hz=10 value=9", "--output", "mine"]
    assert main(given) == 0
    assert started(capsys.readouterr().err) == {"pair"}, "the matrix axis that the user fixed should be gone"
    metrics = json.loads((project / "mine" / "pair" / "metrics.json").read_text())
    assert metrics == {"count": 1, "rate_hz": 10, "third_m": 3.0}
    assert "loops,random-walk,3" in (project / "mine" / "pair" / "table.csv").read_text().splitlines()
    assert main(given) == main(["reproduce"]) == 0
    assert capsys.readouterr().out == "everything is up to date\n" * 2
    assert contents(project / "results") == before


def test_failing_notebooks_are_named_and_the_others_finish(project: Path, capsys: pytest.CaptureFixture) -> None:
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
    assert "wrong: ValueError: nothing doing" in lines["wrong"]
    assert "refused: InputError: nothing doing" in lines["refused"]
    assert "dead: DeadKernelError" in lines["dead"]
    assert "empty: NoResults: metrics.json, table.csv, provenance.json missing" in lines["empty"]
    executed = Path(lines["wrong"].partition("(see ")[2].removesuffix(")"))
    assert "ValueError" in executed.read_text()
    assert sorted(path.name for path in (project / "results").iterdir()) == ["pair", "single"]
    assert json.loads((project / "results" / "single" / "metrics.json").read_text())["third_m"] == 2.0
    assert main(["reproduce", "refused"]) == 2


def test_what_is_edited_while_it_runs_is_not_kept(project: Path, capsys: pytest.CaptureFixture) -> None:
    before, notebook = contents(project / "results"), project / "notebooks" / "tiny.ipynb"
    source = nbformat.read(notebook, 4)
    source.cells[2].source += "\nfile = pathlib.Path('tiny.ipynb')\nfile.write_text(file.read_text() + ' ')"
    source.cells[2].source += "\nfile.write_text(file.read_text().replace('progress.step()', 'progress.step() #'))"
    nbformat.write(source, notebook)
    assert main(["reproduce", "single"]) == 1
    assert "single: notebook or code was edited while it ran" in capsys.readouterr().err
    assert contents(project / "results") == before


def test_two_calls_at_once_are_refused(project: Path, capsys: pytest.CaptureFixture) -> None:
    with (project / ".cache" / "workflow" / "full" / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main(["reproduce", "single", "--force"]) == 2
    assert "another run" in capsys.readouterr().err


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


def interrupt(root: Path, number: signal.Signals, when, mark: str) -> tuple[int, str]:
    """Start a run, send it a signal once ``when()`` holds; exit code and errors. No process may stay."""
    command = [sys.executable, "-m", "workflow", "reproduce"]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "STEELNB_TEST_MARK": mark}
    process = subprocess.Popen(command, cwd=root, env=env, stdout=-1, stderr=-1, text=True, start_new_session=True)
    try:
        assert wait_until(lambda: when() or process.poll() is not None, 120)
        if process.poll() is None:
            process.send_signal(number)
        _, errors = process.communicate(timeout=60)
        assert wait_until(lambda: not marked(mark), 20), marked(mark)
    finally:
        for stray in marked(mark):
            stray.kill()
    return process.returncode, errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_and_the_next_one_resumes(
    tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    root, mark = make_project(tmp_path / "project"), f"{os.getpid()}-{number}"
    monkeypatch.chdir(root)
    gate, asleep = root / "notebooks" / "gate-loops", root / "notebooks" / "asleep-loops"
    journal = root / ".cache" / "workflow" / "full" / "pytask.lock.journal"
    gate.touch()

    def ready() -> bool:
        kept = journal.exists() and "pair/zigzag" in journal.read_text()
        return kept and asleep.exists() and len(marked(mark)) >= 3

    code, errors = interrupt(root, number, ready, mark)
    assert code == (-9 if number == signal.SIGKILL else 130)
    if number != signal.SIGKILL:
        assert errors.splitlines()[-1].startswith("interrupted; nothing is half-written")
        assert "Traceback" not in errors
    assert not (root / "results" / "pair").exists()
    gate.unlink()
    assert main(["reproduce", "pair"]) == 0
    assert started(capsys.readouterr().err) == {"pair/loops"}
    assert len(json.loads((root / "results" / "pair" / "metrics.json").read_text())) == 6


def test_what_a_killed_run_removes_late_is_not_of_the_next_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Path] = []

    def build(tasks, events, *_):
        for earlier in seen:  # as its workers do, which may end after the next run has begun
            shutil.rmtree(earlier, ignore_errors=True)
        assert events.scratch.is_dir()
        seen.append(events.scratch)
        return events.report

    monkeypatch.setattr(task_notebooks, "_build", build)
    for _ in range(2):
        task_notebooks.run([], tmp_path / "cache")
    assert len(seen) == 2


def test_runs_killed_at_any_moment_end_with_the_same_bytes(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, chance = make_project(tmp_path / "project"), random.Random(7)
    whole = {name: data for name, data in contents(finished).items() if name.startswith("results")}
    for attempt, number in enumerate((signal.SIGKILL, signal.SIGTERM)):
        end_s = time.monotonic() + chance.uniform(0.5, 9.0)
        interrupt(root, number, lambda end_s=end_s: time.monotonic() > end_s, f"{os.getpid()}-any-{attempt}")
        for name, data in contents(root).items():
            if name.startswith("results") and not name.endswith("timing.csv") and ".steelnb-" not in name:
                assert whole[name] == data, name
    monkeypatch.chdir(root)
    assert main(["reproduce"]) == 0
    now = contents(root)
    assert {name: now[name] for name in whole if "timing" not in name} == {
        name: data for name, data in whole.items() if "timing" not in name
    }
    assert not [name for name in now if ".steelnb-" in name]


def test_check_compares_a_second_run_with_the_last_commit(project: Path, capsys: pytest.CaptureFixture) -> None:
    metrics = project / "results" / "single" / "metrics.json"
    now = metrics.read_text()
    edit(metrics, '"third_m": 1.0', '"third_m": 1.00001')
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
    for command in (["init", "-q"], ["add", "results"], ["commit", "-q", "-m", "results"]):
        subprocess.run([*git, *command], cwd=project, check=True)
    metrics.write_text(now)  # the tree is right, the commit is not
    before = contents(project / "results")
    for arguments in (["check", "single", "--no-rerun"], ["check", "single"]):
        assert main(arguments) == 1
        shown = capsys.readouterr()
        assert shown.out.splitlines() == [
            "exception: single.loose*: depends on the weather",
            "DIFFERS: single.third_m: committed 1.00001, now 1.0",
            "1 differences",
        ]
        assert started(shown.err) == (set() if "--no-rerun" in arguments else {"single"})
    assert contents(project / "results") == before
    again = project / ".cache" / "workflow" / "check" / "results" / "single"
    assert contents(again) == contents(metrics.parent), "two runs should give the same bytes"
    edit(metrics, '"third_m": 1.0', '"third_m": 1.000010000001')
    assert main(["check", "single", "--no-rerun"]) == 0
    assert "9 metrics and cells of tables agree" in capsys.readouterr().out


def test_check_without_git_takes_the_tree_and_wants_results(project: Path) -> None:
    with pytest.raises(InputError, match=r"results-smoke/pair/metrics\.json"):
        read_committed(project, "results-smoke", ["pair"])
    committed = read_committed(project, "results", ["pair", "single"])
    assert committed == read_results(project / "results", ["pair", "single"])
    assert (committed["single.third_m"], committed["single.noise row 2"]) == ("1.0", "constant-drift:0.0002")


def test_every_kind_of_difference_is_found(tmp_path: Path) -> None:
    def values(metrics: dict, table: str) -> dict[str, str]:
        (tmp_path / "e").mkdir(exist_ok=True)
        (tmp_path / "e" / "metrics.json").write_text(json.dumps(metrics))
        (tmp_path / "e" / "table.csv").write_text(table)
        return read_results(tmp_path, ["e"])

    before = values({"a_m": 1.0, "zero": 0.0, "gone": 1, "loose_m": 1.0}, "name,x_m\nfirst,2.0\nsecond,\n")
    close = values({"a_m": 1 + 9e-7, "zero": 9e-13, "gone": 1, "loose_m": 1.0}, "name,x_m\nfirst,2.000001\nsecond,\n")
    far = values({"a_m": 1 + 2e-6, "zero": 2e-12, "new": 1, "loose_m": 2.0}, "name,x_m,y\nFirst,2.00001,\nsecond,0,\n")
    settings = CheckSettings(exceptions={"e.loose*": "why"})
    assert list(differences(before, before, settings)) == list(differences(before, close, settings)) == []
    found = {line.partition(":")[0]: reason for line, reason in differences(before, far, settings)}
    wanted = ["a_m", "zero", "gone", "new", "name row 1", "x_m row 1", "x_m row 2", "y row 1", "y row 2"]
    assert found == {f"e.{name}": "" for name in wanted} | {"e.loose_m": "why"}


def test_merge_joins_different_columns_and_keeps_the_text_of_cells(tmp_path: Path) -> None:
    for name, table in {"a": 'x,note\n0.1000,"one,\ntwo"\n', "b": "x,z\n2,3\n", "c": "only\n"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "table.csv").write_text(table)
        for file in ("metrics.json", "provenance.json"):
            (tmp_path / name / file).write_text("{}")
    merge({name: tmp_path / name for name in "bac"}, tmp_path / "all", {})
    assert (tmp_path / "all" / "table.csv").read_text() == 'x,z,note,only\n2,3,,\n0.1000,,"one,\ntwo",\n'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[pair]", "[pair", "not a TOML file"),
        ('title = "Two parts"\n', "", "title"),
        ("smoke = {}", "smoke = {}\nspeed = 1", "speed = 1"),
        ('["zigzag", "loops"]', '["loops", "loops"]', "distinct"),
        ('["zigzag", "loops"]', '["zigzag", "spiral"]', "'spiral'"),
        ("value = 3.0", "valeu = 3.0", "did you mean 'value'"),
        ("tiny.ipynb", "none.ipynb", "none.ipynb"),
    ],
)
def test_bad_experiments_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, old: str, new: str, words: str
) -> None:
    monkeypatch.chdir(make_project(tmp_path / "project", EXPERIMENTS.replace(old, new)))
    assert main(["reproduce"]) == 2
    assert words in capsys.readouterr().err
    assert not Path(".cache").exists()


def test_an_experiment_apart_runs_only_when_it_is_named(project: Path) -> None:
    def names(ids: list[str], budget: str) -> list[str]:
        return [plan.experiment.id for plan in make_plans(project, ids, budget)]

    edit(project / "notebooks" / "runs.toml", "[single]", "[single]\napart = true")
    assert names([], "full") == ["pair"]
    assert names(["single"], "full") == ["single"]
    assert names([], "smoke") == ["pair", "single"]


def test_no_run_of_everything_rewrites_measured_times_in_tracked_files() -> None:
    shown = subprocess.run(["git", "ls-files", "results/*timing*"], cwd=ROOT, capture_output=True, text=True)
    if shown.returncode:
        pytest.skip("no repository")
    experiments = read_experiments(ROOT)
    apart = {name for name, each in experiments.items() if each.apart}
    inputs = {path for each in experiments.values() for path in each.inputs if "timing" in path}
    assert set(shown.stdout.split()) == inputs
    assert {path.split("/")[1] for path in inputs} <= apart | {"study"}  # `make study` adds what is missing


def test_root_is_found_upwards(finished: Path) -> None:
    assert find_root(finished / "results" / "pair") == finished
