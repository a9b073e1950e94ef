"""Which runs a study has, and the keys that say whether one is there already."""

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import steelnb
from steelnb.config import METHODS, SENSORS, TRAJECTORIES, ExperimentSettings
from steelnb.errors import FileMissingError, SettingsError
from steelnb.study.plan import (
    APART,
    ROOTS,
    Block,
    by_flight,
    code_digest,
    digest_modules,
    environment_digest,
    make_run,
    make_runs,
    modules_behind,
    read_blocks,
    statements,
)

ROOT = Path(__file__).parents[2]
NOISES = ("random-walk", "constant-drift", "random-walk:0.004", "random-walk+yaw-random-walk")
AXES = {
    "seeds": [1, 2],
    "trajectories": ["vertical", "orbit"],
    "noises": ["random-walk", "constant-drift"],
    "sensors": ["report"],
    "methods": ["average", "icp"],
    "duration_s": 5.0,
}


def some(values, size=3):
    return st.lists(st.sampled_from(values), min_size=1, max_size=size, unique_by=str)


blocks = st.builds(
    Block,
    seeds=some(range(5)),
    trajectories=some(TRAJECTORIES),
    noises=some(NOISES),
    sensors=some(SENSORS),
    methods=some(METHODS),
    duration_s=st.sampled_from([5.0, 200.0]),
    overrides=some([{}, {"hough.dx_m": 0.05}, {"hough.min_votes": 20}]),
)


def keys(*given_blocks: Block) -> set[str]:
    return {run.key for run in make_runs({str(k): block for k, block in enumerate(given_blocks)}, "lock")}


@given(blocks)
@settings(max_examples=15, deadline=None)
def test_a_run_for_each_combination_with_a_key_of_its_own(block):
    runs = make_runs({"a": block}, "lock")
    axes = (block.seeds, block.trajectories, block.noises, block.sensors, block.methods, block.overrides)
    expected = 1
    for axis in axes:
        expected *= len(axis)
    assert len(runs) == expected
    assert len({run.key for run in runs}) == expected
    assert len({tuple(run.case.values()) for run in runs}) == expected
    flights = by_flight(runs)
    assert len(flights) == len(block.seeds) * len(block.trajectories) * len(block.sensors)
    for flight in flights:
        assert len({(s.flight, s.tof, s.tower, s.seed) for s in (run.settings for run in flight)}) == 1
    assert [run for flight in flights for run in flight] == runs  # runs of a flight follow each other


@given(blocks, blocks)
@settings(max_examples=15, deadline=None)
def test_a_wider_study_has_the_keys_of_the_narrower_one(first, second):
    assert keys(first, second) == keys(first) | keys(second) == keys(second, first)
    assert keys(first, first) == keys(first)


@given(blocks)
@settings(max_examples=10, deadline=None)
def test_a_key_follows_every_setting_the_code_and_the_lock(block):
    values, variant = next(iter(block.settings()))
    base = make_run(values, variant, "code", "lock")
    assert make_run(values, variant, "code", "lock") == base
    other = [
        make_run(values, variant, "other code", "lock"),
        make_run(values, variant, "code", "other lock"),
        make_run(values, variant, "code", None),
        make_run(values.but(seed=values.seed + 1), variant, "code", "lock"),
        make_run(values.override({"tof.range_max_m": 3.3}), variant, "code", "lock"),
        make_run(values.override({"tower.height_m": 15.5}), variant, "code", "lock"),
    ]
    assert len({base.key, *(run.key for run in other)}) == 1 + len(other)
    assert len({base.flight, *(run.flight for run in other)}) == 1 + len(other)
    after = make_run(values.override({"fusion.gap_max_m": 0.123}), variant, "code", "lock")
    assert after.key != base.key
    assert after.flight == base.flight  # what comes after the flight changes the run alone


def test_a_key_is_the_same_in_another_process():
    code = (
        "from steelnb.study.plan import *\n"
        "from steelnb.config import ExperimentSettings as E\n"
        "print(make_run(E.preset(seed=3), '', code_digest(), 'lock').key)"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env={"PYTHONHASHSEED": "7"}, capture_output=True, text=True, check=True
        ).stdout.strip(),
        make_run(ExperimentSettings.preset(seed=3), "", code_digest(), "lock").key,
    }
    assert len(found) == 1


def make_package(folder: Path) -> Path:
    files = {
        "__init__.py": "version = 1",
        "top.py": "from pack import middle\nfrom pack.room import name\nimport numpy",
        "middle.py": "def late():\n    from pack.deep import value\n    return value",
        "deep.py": "from pack import middle  # a circle\nvalue = 1",
        "aside.py": "import pack.top",
        "room/__init__.py": "from pack.room.inner import name",
        "room/inner.py": "name = 2",
        "room/unused.py": "from pack.aside import x",
    }
    for name, text in files.items():
        path = folder / "pack" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_modules_behind_are_those_imported_directly_or_not(tmp_path):
    folder = make_package(tmp_path)
    assert set(modules_behind(folder, ["pack.top"])) == {
        "pack.top", "pack.middle", "pack.deep", "pack.room", "pack.room.inner"
    }  # fmt: skip
    before = digest_modules(folder, ["pack.top"])
    for name, counts in (("deep", True), ("room/inner", True), ("top", True), ("aside", False), ("room/unused", False)):
        path = folder / "pack" / f"{name}.py"
        text = path.read_text()
        path.write_text(text + "\nx = 3")
        assert (digest_modules(folder, ["pack.top"]) != before) == counts, name
        path.write_text(text)
    assert digest_modules(folder, ["pack.top"]) == before


def test_what_is_said_about_code_is_no_part_of_a_key():
    source = 'x = "#1"  # why\n\ndef f(y):\n    """What."""\n    # how\n    return x + y  # é\n\nZ = 2\n"""Of Z."""\n'
    assert statements(source) == 'x = "#1"\ndef f(y):\n    return x + y\nZ = 2'


def test_the_environment_counts_as_far_as_a_run_imports_it(tmp_path):
    lock = (ROOT / "environment.lock").read_text()

    def of(text: str) -> str | None:
        (tmp_path / "lock").write_text(text)
        return environment_digest(tmp_path / "lock")

    assert environment_digest(tmp_path / "none") is None
    before = of(lock)
    assert before == of(lock + "\nsomething-new==1.0 \\\n    --hash=sha256:00\n")
    assert before == of(lock.replace("\njupyterlab==", "\njupyterlab==9"))
    for name in ("numpy", "numba", "scipy", "open3d-cpu", "pybullet", "evo"):
        assert f"\n{name}==" in lock
        assert before != of(lock.replace(f"\n{name}==", f"\n{name}==9")), name


def test_no_module_that_a_run_loads_is_missing_from_its_key():
    code = (
        "import sys\n"
        "from steelnb import experiment\n"
        "from steelnb.config import ExperimentSettings\n"
        "for method in ('average', 'combined'):\n"
        "    experiment.run(ExperimentSettings.preset(duration_s=1.0, sensor='report', method=method))\n"
        "print(*(name for name in sys.modules if name.startswith('steelnb')))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    behind = modules_behind(Path(steelnb.__file__).parents[1], ROOTS)
    assert "steelnb.registration.kernels" in shown.split()
    assert not set(shown.split()) - set(behind) - set(APART)
    assert not {name for name in behind if name.startswith(("steelnb.figures", "steelnb.exports", "steelnb.cli"))}
    assert code_digest() == digest_modules(ROOT, ROOTS)


def test_the_study_of_the_project_holds_what_its_claims_need():
    blocks = read_blocks(ROOT / "notebooks" / "study.toml")
    runs = make_runs(blocks, None)
    by_case: dict[tuple, set[int]] = {}
    for run in runs:
        case = run.case
        by_case.setdefault(tuple(v for k, v in case.items() if k != "seed"), set()).add(case["seed"])
    report = {case: seeds for case, seeds in by_case.items() if case[0] == "report"}
    assert all(len(seeds) >= 30 for seeds in report.values())
    assert all(len(seeds) >= 5 for seeds in by_case.values())
    assert {"average", "icp", "icp-3dof", "gicp"} <= {case[-1] for case in report}
    assert {case[-1] for case in by_case if case[0] == "starling2"} >= {"best", "combined"}
    development = set(range(11, 17))  # seeds that chose settings
    assert not development & set().union(*by_case.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[a]\nsees = [1]", ["[a]", "unknown axis 'sees'", "seeds"]),
        ("[a]\nseeds = [1]", ["[a]", "trajectories"]),
        ("a = 3", ["a = 3", "expected a table"]),
        ("", ["no table"]),
        ("[a", ["not a TOML file"]),
        ('seeds = "5-3"', ["seeds = '5-3'", "101-130"]),
        ('seeds = "many"', ["seeds = 'many'"]),
        ("seeds = [-1]", ["seeds.0 = -1"]),
        ("seeds = []", ["seeds = []"]),
        ('methods = ["icp", "icq"]', ["unknown method 'icq'", "'icp-3dof'"]),
        ('trajectories = ["up"]', ["trajectories.0 = 'up'"]),
        ('sensors = ["lidar"]', ["sensors.0 = 'lidar'"]),
        ('noises = ["pink"]', ["noise = 'pink'", "random-walk"]),
        ("duration_s = 0", ["duration_s = 0"]),
        ("blind_s = [[1.0]]", ["blind_s.0 = [1.0]"]),
        ('overrides = [{ "hough.dxm" = 1.0 }]', ["hough.dxm"]),
        ('overrides = [{ "hough.dx_m" = -1.0 }]', ["dx_m = -1.0"]),
    ],
)
def test_bad_settings_of_a_study_are_one_line(tmp_path, text, words):
    path = tmp_path / "study.toml"
    if text and not text.startswith(("[", "a =")):
        name = text.split(" =")[0]
        usual = [f"{key} = {value}" for key, value in AXES.items() if key != name]
        text = "\n".join(["[a]", *usual, text])
    path.write_text(text)
    with pytest.raises(SettingsError) as told:
        make_runs(read_blocks(path), None)
    assert "\n" not in str(told.value)
    assert all(word in str(told.value) for word in words), told.value


def test_a_study_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(FileMissingError, match=r"study\.toml"):
        read_blocks(tmp_path / "study.toml")
