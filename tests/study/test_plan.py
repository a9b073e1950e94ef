"""Runs of a study, and the keys that tell whether one is stored already."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb import keys
from steelnb.errors import InputError
from steelnb.settings import METHODS, SENSORS, ExperimentSettings
from steelnb.study.plan import CODE, LIBRARIES, Block, by_flight, make_run, read_plan, software_digest

ROOT = Path(__file__).parents[2]
NOISES = ("random-walk", "constant-drift", "random-walk:0.004", "random-walk+yaw-random-walk")
AXES = {
    "seeds": [1, 2],
    "trajectories": ["zigzag", "loops"],
    "noises": ["random-walk", "constant-drift"],
    "sensors": ["report-4cm"],
    "methods": ["average", "icp"],
    "duration_s": 5.0,
}


def toml(values: object) -> str:
    if isinstance(values, dict):
        return "{" + ", ".join(f'"{name}" = {toml(value)}' for name, value in values.items()) + "}"
    if isinstance(values, list):
        return "[" + ", ".join(map(toml, values)) + "]"
    return f'"{values}"' if isinstance(values, str) else str(values)


def plan(folder: Path, *blocks: dict):
    text = "".join(
        f"[b{k}]\n" + "".join(f"{name} = {toml(value)}\n" for name, value in block.items())
        for k, block in enumerate(blocks)
    )
    (folder / "study.toml").write_text(text)
    return read_plan(folder / "study.toml")


def some(values, size=2):
    return st.lists(st.sampled_from(values), min_size=1, max_size=size, unique_by=str)


blocks = st.fixed_dictionaries(
    {
        "seeds": some(range(5)),
        "trajectories": some(["zigzag", "loops"]),
        "noises": some(NOISES),
        "sensors": some(SENSORS),
        "methods": some(METHODS),
        "overrides": some([{}, {"preprocess.crop_m": 1.4}, {"tof.range_max_m": 3.0}]),
    }
)


def test_a_planned_flight_is_that_of_its_noise_and_method(tmp_path):
    block = {"seeds": [1], "trajectories": ["planned"], "noises": list(NOISES[:2]), "sensors": ["report-4cm"]}
    runs = plan(tmp_path, {**block, "methods": ["best", "combined"], "overrides": [{}]})
    assert len(by_flight(runs)) == len(runs) == 4


@given(blocks, blocks)
@settings(max_examples=15, deadline=None)
def test_every_combination_is_a_run_of_its_own(tmp_path_factory, block, other):
    folder = tmp_path_factory.mktemp("study")
    runs = plan(folder, block)
    expected = math.prod(map(len, block.values()))
    assert len(runs) == len({run.key for run in runs}) == len({tuple(run.case.values()) for run in runs}) == expected
    flights, tofs = by_flight(runs), len({"tof.range_max_m" in changes for changes in block["overrides"]})
    assert len(flights) == math.prod(len(block[axis]) for axis in ("seeds", "trajectories", "sensors")) * tofs
    for flight in flights:
        assert len({(s.flight, s.tof, s.tower, s.seed) for s in (run.settings for run in flight)}) == 1
    assert [run for flight in flights for run in flight] == runs  # runs of a flight follow each other
    both = {run.key for run in plan(folder, block, other)}
    assert both == {run.key for run in runs} | {run.key for run in plan(folder, other)}


def test_a_key_follows_every_setting_and_a_flight_key_those_of_the_flight():
    values = ExperimentSettings.preset(method="icp", noise="random-walk")
    base = make_run(values)
    assert make_run(values) == base
    for changes in ({"tof.range_max_m": 3.3}, {"tower.height_m": 15.5}, {"flight.standoff_m": 1.9}):
        other = make_run(values.override(changes))
        assert other.key != base.key, changes
        assert other.flight != base.flight, changes
    assert make_run(values.replace(seed=values.seed + 1)).flight != base.flight
    for other in (
        make_run(values.override({"preprocess.crop_m": 1.4})),
        make_run(ExperimentSettings.preset(method="icp", noise="constant-drift")),
        make_run(ExperimentSettings.preset(method="gicp", noise="random-walk")),
    ):
        assert other.key != base.key
        assert other.flight == base.flight
    other = make_run(values, depends_on="other code")
    assert other.key != base.key
    assert other.flight != base.flight


def test_an_edit_of_code_changes_keys_and_one_of_words_or_of_reports_does_not(tmp_path, monkeypatch):
    package = tmp_path / "steelnb"
    shutil.copytree(ROOT / "steelnb", package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(keys, "PACKAGE_FOLDER", package)
    before = software_digest.__wrapped__()
    for name, old, new, counts in (
        ("study/row.py", '"""One run of a study', '"""A run of some study', False),
        ("study/row.py", "CURVE_SAMPLES = 100\n", "CURVE_SAMPLES = 100  # enough for a figure\n\n", False),
        ("study/row.py", "CURVE_SAMPLES = 100\n", "CURVE_SAMPLES = 99\n", True),
        ("study/cluster.py", "ANSWER_S = 10.0", "ANSWER_S = 11.0", False),
        ("study/table.py", '"runs.parquet"', '"table.parquet"', False),
        ("registration/solve.py", "import numpy as np\n", "import numpy as np\n\nEXTRA = 1\n", True),
        ("simulation/tof.py", "import numpy as np\n", "import numpy as np\n\nEXTRA = 1\n", True),
        ("cli.py", "code = 130\n", "code = 131\n", False),
    ):
        text = (package / name).read_text()
        assert old in text, name
        (package / name).write_text(text.replace(old, new, 1))
        assert (software_digest.__wrapped__() != before) == counts, (name, new)
        (package / name).write_text(text)
    assert software_digest.__wrapped__() == before
    versions = keys.code_digest(CODE)
    monkeypatch.setattr("steelnb.study.plan.LIBRARIES", LIBRARIES[1:])
    assert software_digest.__wrapped__() != before
    assert keys.code_digest(CODE) == versions


def test_no_module_that_a_run_loads_is_missing_from_its_key():
    code = (
        "import sys\nfrom steelnb.study import row\nfrom steelnb.settings import ExperimentSettings\n"
        "for method in ('average', 'combined'):\n"
        "    s = ExperimentSettings.preset(duration_s=1.0, sensor='report-4cm', method=method)\n"
        "    print(row.run_on(row.fly(s), s)['error'], file=sys.stderr)\n"
        "print(*(name for name in sys.modules if name.startswith('steelnb.')))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not shown.stderr.strip()
    loaded = set(shown.stdout.split())
    assert "steelnb.registration.normal_equations" in loaded
    assert loaded <= keys.reachable(CODE).keys()


def test_the_study_of_the_project_has_enough_seeds_and_none_that_chose_settings():
    by_case: dict[tuple, set[int]] = {}
    for run in read_plan(ROOT / "notebooks" / "study.toml"):
        case = run.case
        name = case["sensor"], case["duration_s"], case["blind"], case["trajectory"], case["noise"], case["variant"]
        by_case.setdefault((*name, case["method"]), set()).add(case["seed"])
    seeds = {case: len(found) for case, found in by_case.items()}
    ours = {"best", "combined", "faces"}
    few = ours | {"loam"}
    report = {case: count for case, count in seeds.items() if case[0] == "report-4cm" and case[-1] not in few}
    other_worlds = {case: count for case, count in report.items() if case[5].startswith(("tower.", "flight."))}
    the_sweep = {case for case in other_worlds if case[4] == "constant-drift-per-axis" and "," in case[5]}
    assert the_sweep
    assert all(count >= 30 for case, count in report.items() if case not in other_worlds and "per-axis" not in case[4])
    assert all(count >= 10 for case, count in other_worlds.items() if case not in the_sweep)
    assert all(count >= 5 for case, count in seeds.items() if case[-1] in ours and not case[5])
    assert min(seeds.values()) >= 2
    assert {"average", "icp", "icp-3dof", "gicp"} <= {case[-1] for case in report}
    assert {case[-1] for case in by_case if case[0] == "starling2"} >= ours
    assert not set(range(11, 21)) & set().union(*by_case.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[a]\nsees = [1]", ["[a]", "sees"]),
        ("[a]\nseeds = [1]", ["[a]", "trajectories"]),
        ("a = 3", ["[a]: 3", "expected a table"]),
        ("", ["no table"]),
        ("[a", ["not the settings of a study"]),
        ('seeds = "5-3"', ["seeds = '5-3'", "101-130"]),
        ('seeds = "many"', ["seeds = 'many'"]),
        ('seeds = "1-1000000000"', ["seeds = '1-1000000000'", "at most 100,000"]),
        ('seeds = "1-99999999999999999999999"', ["at most 100,000"]),
        ('seeds = "1-100000"', ["800,000 runs", "at most 100,000"]),
        ("seeds = [-1]", ["seeds.0 = -1"]),
        ("seeds = [9223372036854775808]", ["seeds.0 = 9223372036854775808"]),
        ("duration_s = 1e300", ["duration_s = 1e+300", "14400"]),
        ("seeds = []", ["seeds = []"]),
        ('methods = ["icp", "icq"]', ["'icq'", "'icp-3dof'"]),
        ('trajectories = ["up"]', ["trajectories.0 = 'up'"]),
        ('sensors = ["lidar"]', ["sensor = 'lidar'"]),
        ('noises = ["pink"]', ["noise = 'pink'", "random-walk"]),
        ("duration_s = 0", ["duration_s = 0"]),
        ("blind_s = [[1.0]]", ["blind_s.0 = [1.0]"]),
        ('overrides = [{ "hough.dxm" = 1.0 }]', ["hough.dxm"]),
        ('overrides = [{ "hough.dx_m" = -1.0 }]', ["dx_m = -1.0"]),
    ],
)
def test_bad_settings_of_a_study_are_one_line(tmp_path, text, words):
    if text and not text.startswith(("[", "a =")):
        name = text.split(" =")[0]
        text = "\n".join(["[a]", *(f"{key} = {toml(value)}" for key, value in AXES.items() if key != name), text])
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(InputError) as told:
        read_plan(tmp_path / "study.toml")
    assert "\n" not in str(told.value)
    assert all(word in str(told.value) for word in words), told.value


def test_a_range_of_seeds_has_both_ends_and_a_missing_file_is_one_line(tmp_path):
    assert Block(**{**AXES, "seeds": "3-5"}).seeds == [3, 4, 5]
    with pytest.raises(InputError, match=r"study\.toml"):
        read_plan(tmp_path / "study.toml")
