"""Tables of short runs: their contents, resuming, failures, and a Dask cluster."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import psutil
import pytest

from steelnb import cli, experiment
from steelnb.core.cache import PACKAGE
from steelnb.core.errors import InputError, OutputError
from steelnb.metrics import diagnose, position_error_m
from steelnb.notebook import runs, study
from steelnb.notebook.cases import RUN_COLUMNS, Grid, Run, grid, read_grids
from steelnb.notebook.runs import run_all
from steelnb.notebook.study import (
    CURVE_SAMPLES,
    CURVES,
    TIMES,
    read_runs,
    run_study,
    study_curves,
    thinned_curves,
    write_runs,
)
from steelnb.notebook.tables import tower_name
from steelnb.settings import ExperimentSettings
from steelnb.settings.presets import members_file

ROOT = Path(__file__).parents[2]
AXES = {
    "seeds": [1, 2], "trajectories": ["zigzag"], "noises": ["random-walk"], "sensors": ["report-4cm"],
    "methods": ["icp", "average"], "duration_s": 3.0,
}  # fmt: skip


def written(folder: Path, *grids: dict) -> Path:
    lines = []
    for k, axes in enumerate(grids):
        lines += [f"[g{k}]", *(f"{name} = " + json.dumps(each).replace('": ', '" = ') for name, each in axes.items())]
    (folder / "study.toml").write_text("\n".join([*lines, ""]))
    return folder / "study.toml"


def numbers(table: pd.DataFrame) -> pd.DataFrame:
    return table.drop(columns=list(TIMES))


@pytest.fixture
def made(monkeypatch):
    """The runs that were computed, not read from the cache."""
    found = []
    make_row = study.make_row
    monkeypatch.setattr(study, "make_row", lambda s, flights: (found.append(s), make_row(s, flights))[1])
    return found


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> pd.DataFrame:
    return run_study(grid(**AXES), folder=tmp_path_factory.mktemp("kept"))


def test_rows_equal_plain_runs_and_cached_rows_are_the_same_bits(plain, tmp_path, made, monkeypatch):
    flown, simulate = [], experiment.simulate
    monkeypatch.setattr(experiment, "simulate", lambda s, *more: (flown.append(s.seed), simulate(s, *more))[1])
    first = run_study(grid(**AXES), folder=tmp_path)
    assert flown == [1, 2], "a flight is simulated once"
    pd.testing.assert_frame_equal(run_study(grid(**AXES), folder=tmp_path), first, check_exact=True)
    assert flown == [1, 2], "no flight is simulated for rows that are kept"
    assert len(made) == 4
    pd.testing.assert_frame_equal(numbers(first), numbers(plain), check_exact=True)
    assert first["method"].tolist() == ["average", "icp"] * 2
    given = {"sensor": "report-4cm", "seed": 2, "duration_s": 3.0, "method": "icp"}
    result = experiment.run(ExperimentSettings.preset("zigzag", "random-walk", **given))
    assert {name: first.iloc[3][name] for name in result.metrics} == result.metrics
    wider = run_study(grid(**{**AXES, "seeds": "1-3"}), folder=tmp_path)
    assert [settings.seed for settings in made[4:]] == [3, 3]
    pd.testing.assert_frame_equal(wider.iloc[:4], first, check_exact=True)


def test_changed_sources_compute_rows_again_and_a_worker_with_other_sources_is_refused(tmp_path, made, monkeypatch):
    some = grid(**{**AXES, "seeds": [1], "methods": ["icp"]})
    run_study(some, folder=tmp_path)
    for module in ("core.cache", "notebook.runs"):
        monkeypatch.setattr(f"steelnb.{module}.SOURCES", "other code")
    run_study(some, folder=tmp_path)
    assert len(made) == 2
    with pytest.raises(InputError, match="a worker has another version of steelnb"):
        runs._in_one_world([some[0].settings], runs.result_of, True, "code of the process that started it", None)


def test_a_run_that_raises_is_reported_and_tried_again(tmp_path, made, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, {**AXES, "seeds": [1], "variants": {"": {}, "too near": {"flight.standoff_m": -0.05}}})
    for count in (4, 2):
        del made[:]
        assert cli.main(["study", str(path), "-o", "out", "-j", "1"]) == 1
        shown = capsys.readouterr()
        assert "4 runs, 2 of them failed" in shown.out
        assert shown.err.count("CollisionError") == 2
        assert len(made) == count
    table = read_runs(tmp_path / "out").set_index("variant")
    assert table["status"].to_dict() == {"": "ok", "too near": "failed"}
    assert table.loc["too near", "error"].str.contains("Traceback").all()
    assert not table["error"].str.contains(str(PACKAGE.parent)).any(), "a table is published"
    assert table.loc["too near", "ate_rmse_m"].isna().all()
    assert len(study_curves(table.reset_index())) == 2 * len(table["curve_time_s"].iloc[0])


def test_a_dask_cluster_gives_the_same_table(plain, tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,
        Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        table = run_study(grid(**AXES), folder=tmp_path)
    pd.testing.assert_frame_equal(numbers(table), numbers(plain), check_exact=True)


@pytest.mark.slow
def test_a_killed_study_loses_only_the_current_runs(plain, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, stored = written(tmp_path, {**AXES, "seeds": "1-4"}), []
    command = [sys.executable, "-m", "steelnb", "study", str(path), "-o", "out", "-j", "2"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while len(stored) < 2:
        assert process.poll() is None
        time.sleep(0.1)
        stored = [*tmp_path.glob(f"{study.KEPT}/**/output.pkl")]
    processes = [*psutil.Process(process.pid).children(recursive=True), process]
    for each in processes:
        each.kill()
    process.wait()
    stored = [*tmp_path.glob(f"{study.KEPT}/**/output.pkl")]
    table = run_study(read_grids(path))
    assert len(made) == len(table) - len(stored) == 8 - len(stored)
    assert (table["status"] == "ok").all()
    pd.testing.assert_frame_equal(numbers(table.iloc[:4]), numbers(plain), check_exact=True)


def test_tables_survive_writing_and_reading(plain, tmp_path):
    write_runs(tmp_path / "out", plain)
    pd.testing.assert_frame_equal(read_runs(tmp_path / "out")[plain.columns], plain, check_exact=True)
    assert not {*TIMES} & {*pd.read_parquet(tmp_path / "out" / study.RUNS)}
    content = (tmp_path / "out" / study.RUNS).read_bytes()
    write_runs(tmp_path / "out", plain.assign(frame_p95_ms=0.0))
    assert (tmp_path / "out" / study.RUNS).read_bytes() == content
    with pytest.raises(OutputError, match="cannot be written"):
        write_runs(tmp_path / "out" / study.RUNS, plain)
    (tmp_path / "out" / study.RUNS).write_bytes(content[: len(content) // 2])
    for folder, words in ((tmp_path / "out", "not the table of a study"), (tmp_path, "does not exist")):
        with pytest.raises(InputError, match=words):
            read_runs(folder)


def test_runs_of_another_study_are_not_replaced_and_bad_folders_are_refused_first(
    plain, tmp_path, made, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_runs("out", plain)
    before = Path("out", study.RUNS).read_bytes()
    Path("file").write_text("x")
    path = str(written(tmp_path, {**AXES, "seeds": [2], "methods": ["icp"]}))
    for folder, words in (
        ("out", "out: 3 of its 4 runs are not in this study; expected another folder, or --force"),
        ("file", "file: cannot be written: Not a directory"),
    ):
        assert cli.main(["study", path, "-o", folder]) == 2
        assert words in capsys.readouterr().err
    assert not made
    assert Path("out", study.RUNS).read_bytes() == before
    study.check_runs("out", grid(**{**AXES, "seeds": "1-3"}))  # continued or extended
    study.check_runs("new", grid(**AXES))
    assert cli.main(["study", path, "-o", "out", "-j", "1", "--force"]) == 0
    assert len(read_runs("out")) == len(made) == 1


def test_the_committed_table_has_the_columns_and_runs_of_the_study(plain):
    committed = read_runs(ROOT / "results" / "study")
    gaps = {"ate_outside_gaps_rmse_m", "error_after_gaps_max_m"}  # of runs with blind intervals
    assert {*committed} == {*plain} | gaps
    texts = plain.assign(seed=plain["seed"].astype(str))  # since "report" is among the seeds of the study
    assert (
        committed[list(RUN_COLUMNS)].dtypes.astype(str).tolist() == texts[list(RUN_COLUMNS)].dtypes.astype(str).tolist()
    )
    of_now = read_grids(ROOT / "notebooks" / "study.toml")
    study.check_runs(ROOT / "results" / "study", of_now)  # what `make study` does first
    cases = [run.case for run in of_now]
    known = {tuple({**case, "seed": str(case["seed"])}.values()) for case in cases}
    assert {*committed[list(RUN_COLUMNS)].itertuples(index=False, name=None)} <= known
    assert not set(range(11, 21)) & {case["seed"] for case in cases}, "seeds of the development"


def test_numbers_and_curves_describe_the_run():
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk", sensor="report-4cm", seed=4, duration_s=30.0, method="icp",
        overrides={"tof.blind_s": [[10.0, 15.0]]},
    )  # fmt: skip
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth)
    found = {**result.metrics, **diagnose(flight, result, truth, settings.odometry.preprocess)}
    assert found["lost_share"] == pytest.approx(25 / 149, abs=0.01)
    error = position_error_m(result.corrected, truth.trajectory)
    lost = result.matches[1:] == 0
    total = 0.2 * (found["growth_lost_m_s"] * lost.sum() + found["growth_paired_m_s"] * (~lost).sum())
    assert total == pytest.approx(np.diff(error).sum())
    assert found["slip_m"] == pytest.approx(max(error[5:] - error[:-5]))
    assert found["wrong_share"] == pytest.approx(np.mean(error[result.matches > 0] > 0.25))
    assert found["bend_deg"] > 0
    assert 0 < found["turned_mean_deg"] < 5
    thin = thinned_curves(result)
    assert {name: len(values) for name, values in thin.items()} == dict.fromkeys(CURVES, CURVE_SAMPLES)
    assert thin["curve_time_s"][[0, -1]] == pytest.approx(result.corrected.stamp_s[[0, -1]])
    assert thin["curve_error_m"][-1] == pytest.approx(found["error_final_m"])
    assert thin["curve_raw_m"][-1] == pytest.approx(found["raw_error_final_m"])
    index = np.searchsorted(result.corrected.stamp_s, thin["curve_time_s"] - 1e-3)
    np.testing.assert_array_equal(thin["curve_matches"], result.matches[index])
    long = study_curves(pd.DataFrame([{**Run(settings).case, **thin}]))
    assert [*long] == [*RUN_COLUMNS, "time_s", "raw_m", "error_m", "matches"]
    assert long["error_m"].tolist() == thin["curve_error_m"].tolist()


def test_a_grid_has_every_combination_and_both_ends_of_a_range(tmp_path):
    axes = {**AXES, "seeds": "3-5", "noises": ["random-walk", "constant-drift"]}
    some = grid(**axes, variants={"": {}, "near": {"preprocess.crop_m": 1.4}})
    cases = pd.DataFrame([run.case for run in some])
    assert len(cases.drop_duplicates()) == len(some) == 3 * 2 * 2 * 2
    assert set(cases["seed"]) == {3, 4, 5}
    assert set(cases["variant"]) == {"", "near"}
    assert {run.settings.odometry.preprocess.crop_m for run in some if run.variant == "near"} == {1.4}
    assert len({experiment.world(run.settings) for run in some}) == 3
    planned = [run.settings for run in grid(**{**axes, "trajectories": ["planned"]})]
    assert len({experiment.world(settings) for settings in planned}) == len(planned)  # steered by what is estimated
    assert len(read_grids(written(tmp_path, AXES, {**AXES, "seeds": "2-3"}))) == 6, "duplicates run once"


def test_what_is_given_twice_runs_once(tmp_path, made):
    axes = {"trajectories": ["loops"] * 2, "noises": ["none"] * 2, "sensors": ["starling2"] * 2, "duration_s": 1.0}
    runs = grid(seeds=[2, 2, "1-2"], methods=["none", "none"], **axes)
    assert [run.case["seed"] for run in runs] == [2, 1]
    table = run_study([*runs, *runs], folder=tmp_path / "rows")
    assert len(table) == len(made) == 2
    write_runs(tmp_path, pd.concat([table, table]))  # as tables of earlier versions may be
    assert len(read_runs(tmp_path)) == 2
    one, two, three = run_all([runs[0].settings, runs[1].settings, runs[0].settings])
    assert one is three
    assert [each.settings.seed for each in (one, two)] == [2, 1]


def test_flights_whose_imus_differ_are_not_shared():
    imus = {"": {}, "biased": {"imu.accelerometer_bias": 0.1}}
    flown = grid(
        **{**AXES, "duration_s": 3.5, "seeds": [1], "sensors": ["starling2-honest"], "methods": ["best"]}, variants=imus
    )
    assert len({experiment.world(run.settings) for run in flown}) == 2


def test_a_table_may_mix_the_seed_report_and_numbers(tmp_path):
    still = {"": {"flight.still_s": 0.0}}
    axes = {**AXES, "methods": ["icp"], "sensors": ["report"], "trajectories": ["vertical"], "variants": still}
    table = run_study([run.settings for run in grid(**{**axes, "seeds": [7, "report"]})], folder=tmp_path)
    assert table["seed"].tolist() == ["7", "report"]
    write_runs(tmp_path / "out", table)
    assert read_runs(tmp_path / "out")["seed"].tolist() == ["7", "report"]
    assert Grid(**{**axes, "seeds": ["report", "3-4", 9]}).seeds == ["report", 3, 4, 9]


BAD = (
    ('seeds = "many"', ["seeds = 'many'"]),
    ('seeds = "1-1000000000"', ["seeds = '1-1000000000'", "at most 100,000"]),
    ("seeds = ['report', '9-8']", ["'9-8'", "101-130"]),
    ("methods = []", ["methods = []"]),
    ('method = ["icp"]', ["method = ['icp']: unknown setting, did you mean 'methods'"]),
    ('methods = ["icp", "icq"]', ["[g0]", "'icq'", "'icp-3dof'"]),
    ('variants = { "much" = { "hough.dxm" = 1.0 } }', ["hough.dxm"]),
    ("[empty", ["not the settings of a study"]),
)


@pytest.mark.parametrize(("line", "words"), BAD, ids=[line for line, _ in BAD])
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, line, words):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, {name: each for name, each in AXES.items() if not name.startswith(line.split(" =")[0])})
    path.write_text(path.read_text() + line)
    assert cli.main(["study", str(path), "-o", "out"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert all(word in told for word in words), told
    assert [*tmp_path.iterdir()] == [path]


def test_a_study_without_runs_or_jobs_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_grids(tmp_path / "study.toml")
    with pytest.raises(InputError, match="no table"):
        read_grids(written(tmp_path))
    for some, jobs in (([], 1), (grid(**AXES), 0)):
        with pytest.raises(InputError, match="expected at least one of each"):
            run_study(some, jobs, tmp_path)


def test_rows_name_the_list_of_members_that_they_were_flown_on(tmp_path):
    assert tower_name(ExperimentSettings.preset("zigzag")) == ""
    first = tower_name(ExperimentSettings.preset("vertical"))
    assert re.fullmatch(r"report-tower [0-9a-f]{8}", first)
    own = tmp_path / "mine.csv"
    own.write_bytes(members_file("report-tower").read_bytes() + b"leg,0,0,0,0,0,1,,,,0.1\n")
    changed = ExperimentSettings.preset("vertical", overrides={"tower.members": str(own)})
    assert re.fullmatch(r"mine [0-9a-f]{8}", tower_name(changed)), "no path of this machine in a published table"
    assert tower_name(changed).split()[-1] != first.split()[-1]


def test_seeds_may_be_a_range_or_a_tuple():
    for seeds in (range(1, 3), (1, 2), [1, 2]):
        assert [run.settings.seed for run in grid(**{**AXES, "seeds": seeds, "methods": ["none"]})][:2] == [1, 2]


def test_a_study_whose_runs_have_all_failed_has_no_curves():
    failed = pd.DataFrame([{"trajectory": "zigzag", "noise": "random-walk", "status": "CollisionError"}])
    assert study_curves(failed).empty
