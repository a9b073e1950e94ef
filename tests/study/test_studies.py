"""Studies of short flights on a local cluster: the table, resuming, widening, failures, faults, and the check."""

import contextlib
import errno
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from steelnb import cli, experiment, studies
from steelnb.config import ExperimentSettings
from steelnb.errors import FileMissingError, OutputError, SettingsError
from steelnb.metrics import position_error_m
from steelnb.study import cluster, store
from steelnb.study.cost import Costs, scan_bytes, worker_bytes
from steelnb.study.plan import CASE, make_runs, read_blocks
from steelnb.study.row import CURVE_SAMPLES, Fault, curves, failed, numbers, run_on, told

STUDY = """
[a]
seeds = [1, 2]
trajectories = ["vertical"]
noises = ["random-walk"]
sensors = ["report"]
methods = ["icp", "average"]
duration_s = 3.0
"""
WIDER = STUDY.replace("[1, 2]", "[1, 2, 3]").replace('["random-walk"]', '["random-walk", "constant-drift"]')
FAILING = STUDY.replace("[1, 2]", "[1]") + 'overrides = [{}, { "flight.standoff_m" = -0.05 }]\n'


@pytest.fixture(scope="module")
def client():
    with cluster.connected(2, None, 2) as found:
        yield found


@pytest.fixture
def shared(client, monkeypatch):
    """All studies of a test on one cluster, which takes seconds to start."""
    monkeypatch.setattr(cluster, "connected", lambda *_: contextlib.nullcontext(client))


@pytest.fixture
def study(tmp_path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def tables(folder: Path) -> tuple[bytes, bytes]:
    return (folder / store.RUNS).read_bytes(), (folder / store.TIMING).read_bytes()


def test_a_cluster_of_ones_own_is_heard_on_this_machine_alone(client):
    import psutil

    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    listening = [c.laddr.ip for p in processes for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN]
    assert len(listening) >= 3
    assert set(listening) == {"127.0.0.1"}
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    assert [worker["nthreads"] for worker in workers] == [1, 1]


def test_a_study_is_plain_runs_resumed_and_widened(shared, study, tmp_path):
    out, seen = tmp_path / "out", []
    report = studies.run(study, out, on_progress=seen.append)
    assert (report.runs, report.kept, report.failed, report.notes) == (4, 0, [], [])
    assert [status.done for status in seen] == sorted(status.done for status in seen)
    frame = store.read_study(out)
    assert frame[list(CASE)].values.tolist() == [
        ["report", 3.0, "", "vertical", seed, "random-walk", "", method]
        for seed in (1, 2)
        for method in ("average", "icp")
    ]
    plain = experiment.run(
        ExperimentSettings.preset("vertical", "random-walk", sensor="report", seed=2, duration_s=3.0, method="icp")
    )
    row = frame.iloc[3]
    assert {name: row[name] for name in plain.metrics} == plain.metrics
    assert (frame[["seconds", "flight_seconds", "frame_median_ms", "frame_p95_ms"]] > 0).all(axis=None)
    first = tables(out)

    assert studies.run(study, out).kept == 4
    assert tables(out) == first  # not even the times: nothing ran

    study.write_text(WIDER)
    assert studies.forecast(study, out).kept == 4
    wider = studies.run(study, out)
    assert (wider.runs, wider.kept) == (12, 4)
    times = store.read_study(out).set_index("key")["seconds"]
    assert times[frame["key"]].tolist() == frame["seconds"].tolist()
    assert tables(out) != first

    study.write_text(STUDY)
    assert studies.run(study, out).kept == 4
    assert tables(out) == first
    assert studies.forecast(study, out).runs == 4


def test_a_run_that_raises_is_recorded_and_tried_again(shared, study, tmp_path, monkeypatch, capfd):
    study.write_text(FAILING)
    out = tmp_path / "out"
    assert cli.main(["study", str(study), "--out", str(out)]) == 1
    shown = capfd.readouterr()
    assert "2 runs failed" in shown.out
    frame = store.read_study(out)
    assert frame["status"].tolist() == ["ok", "ok", "failed", "failed"]
    assert set(frame["variant"][2:]) == {"flight.standoff_m=-0.05"}
    for error in frame["error"][2:]:
        assert error.startswith("Traceback")
        assert "CollisionError" in error.splitlines()[-1]
        assert "steelnb/experiment.py" in error
        assert str(Path(studies.__file__).parent) not in error  # no place of this machine
    report = studies.run(study, out)
    assert report.kept == 2
    assert len(report.failed) == 2
    assert all("CollisionError" in line for line in report.failed)


def test_a_full_disk_stops_a_study_which_then_goes_on(shared, study, tmp_path, monkeypatch, capfd):
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    studies.run(study, undisturbed)
    whole, count = Path.write_bytes, 0

    def nearly_full(path: Path, content) -> int:
        nonlocal count
        count += 1
        if count > 1:
            whole(path, bytes(content)[:50])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return whole(path, content)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", nearly_full)
        assert cli.main(["study", str(study), "--out", str(out)]) == 2
    shown = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("[")]
    assert len(shown) == 1
    assert "No space left on device" in shown[0]
    kept = studies.forecast(study, out).kept
    assert 1 <= kept < 4
    assert studies.run(study, out).kept == kept
    assert tables(out)[0] == tables(undisturbed)[0]


def test_a_row_that_died_with_its_worker_is_waited_for(shared, study, tmp_path, monkeypatch):
    from distributed import Future

    whole, late = Future.result, []

    def result(future, timeout=None):
        if future.key not in late:
            late.append(future.key)
            raise TimeoutError
        return whole(future, timeout)

    monkeypatch.setattr(Future, "result", result)
    report = studies.run(study, tmp_path / "out")
    assert (report.runs, report.failed) == (4, [])
    assert len(late) == 4
    assert store.read_study(tmp_path / "out")["status"].tolist() == ["ok"] * 4


def test_a_worker_with_other_code_gives_no_numbers():
    settings = ExperimentSettings.preset(sensor="report", duration_s=1.0)
    found = cluster.fly_task(settings, "the digest of other code")
    assert isinstance(found, Fault)
    assert run_on(found, settings) == failed(found.text)
    assert "another version" in found.text


def test_a_fault_is_told_the_same_on_every_machine(monkeypatch):
    def estimate(*_):
        raise ZeroDivisionError("no scans")

    settings = ExperimentSettings.preset(sensor="report", duration_s=1.0, method="icp")
    flown = cluster.fly_task(settings, cluster.code_digest())
    monkeypatch.setattr(experiment, "estimate", estimate)
    row = run_on(flown, settings)
    assert row["status"] == "failed"
    assert row["error"].splitlines()[-1] == "ZeroDivisionError: no scans"
    assert str(Path(__file__).parent) not in row["error"]
    assert told(ValueError("alone")) == "ValueError: alone"


def test_numbers_and_curves_are_those_of_the_run():
    settings = ExperimentSettings.preset(
        "vertical", "random-walk", sensor="report", seed=4, duration_s=30.0, method="icp",
        overrides={"tof.blind_s": [[10.0, 15.0]]},
    )  # fmt: skip
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth)
    found = numbers(flight, result)
    assert found["lost_share"] == pytest.approx(25 / 149, abs=0.01)
    error = position_error_m(result.corrected, truth.trajectory)
    growth = np.diff(error)
    lost = result.matches[1:] == 0
    total = 0.2 * (found["growth_lost_m_s"] * lost.sum() + found["growth_paired_m_s"] * (~lost).sum())
    assert total == pytest.approx(growth.sum())
    assert found["bend_deg"] > 0
    assert 0 < found["turned_mean_deg"] < 5
    thin = curves(result)
    assert len(thin["curve_time_s"]) == CURVE_SAMPLES
    assert {name: len(values) for name, values in thin.items()} == dict.fromkeys(store.CURVES, CURVE_SAMPLES)
    assert thin["curve_time_s"][[0, -1]] == pytest.approx(result.corrected.stamp_s[[0, -1]])
    assert thin["curve_error_m"][-1] == pytest.approx(found["error_final_m"])
    assert thin["curve_raw_m"][-1] == pytest.approx(found["raw_error_final_m"])
    index = np.searchsorted(result.corrected.stamp_s, thin["curve_time_s"] - 1e-3)
    np.testing.assert_array_equal(thin["curve_matches"], result.matches[index])


def test_a_forecast_goes_by_known_runs_else_by_a_rule(study, tmp_path):
    runs = make_runs(read_blocks(study), None)
    rule = Costs(store.Store(tmp_path).rows)
    assert rule.total_s(runs) == pytest.approx(4 * rule.run_s(runs[0]) + 2 * rule.flight_s(runs[0]))
    known = store.Store(tmp_path)
    for run, seconds in zip(runs, (6.0, 3.0, 9.0, 3.0), strict=True):
        known.add(
            [{**run.case, "key": run.key, "status": "ok", "error": "", "seconds": seconds, "flight_seconds": 1.5}]
        )
    costs = Costs(store.Store(tmp_path).rows)
    by_method = {run.settings.odometry.method: costs.run_s(run) for run in runs}
    assert by_method == pytest.approx({"icp": 7.5, "average": 3.0})
    assert costs.total_s(runs) == pytest.approx(2 * 7.5 + 2 * 3.0 + 2 * 1.5)
    assert scan_bytes(runs[0].settings.tof, 200.0) == 64 * 64 * 4 * 1000
    assert worker_bytes(runs) > worker_bytes([])


def test_dry_run_says_what_it_would_take_and_writes_nothing(study, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["study", str(study), "--dry-run", "--out", str(out), "--workers", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "4 runs on 2 flights, 0 of them done"
    assert lines[1].startswith("4 to run: 0 min 0")
    assert lines[1].endswith("on 1 workers, by a rule of thumb")
    assert "GB a worker" in lines[2]
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], ["workers = 0", "at least 1"]),
        (["--workers", "two"], ["--workers"]),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], ["workers = 2", "leave out"]),
        (["--out", "{study}"], ["study.toml", "not a folder"]),
        (["--out", "{study}/below"], ["study.toml/below", "cannot be written"]),
    ],
)
def test_bad_options_are_one_line(study, tmp_path, capfd, options, words):
    given = [option.format(study=study) for option in options]
    if "--out" not in given:
        given += ["--out", str(tmp_path / "out")]
    assert cli.main(["study", str(study), *given]) == 2
    shown = capfd.readouterr()
    assert shown.err.count("\n") == 1
    assert all(word in shown.err for word in words), shown.err
    with pytest.raises((SettingsError, FileMissingError)):
        studies.run(tmp_path / "missing.toml", tmp_path / "out")


@pytest.fixture
def project(tmp_path, study, shared, monkeypatch) -> Path:
    """A project with the study's table in it."""
    root = tmp_path / "project"
    (root / "notebooks").mkdir(parents=True)
    (root / "notebooks" / "experiments.toml").write_text("")
    shutil.copy(study, root / "notebooks" / "study.toml")
    monkeypatch.chdir(root)
    return root


def test_check_runs_a_sample_again_and_compares(project, monkeypatch, capfd):
    assert studies.check(asked=False) is None
    with pytest.raises(FileMissingError, match="nothing to compare with"):
        studies.check(asked=True)
    studies.run()
    monkeypatch.setattr(studies, "SAMPLE", 2)
    assert cli.main(["check", "study"]) == 0
    assert "of a sample of the study agree" in capfd.readouterr().out
    path = project / "results" / "study" / store.RUNS
    good = store.read_table(path)
    runs = studies.read_study_file()
    chosen = studies.sample_of(runs, 2)
    assert [run.key for run in chosen] == [run.key for run in studies.sample_of(runs[::-1], 2)]
    rows = good.to_pylist()
    for row in rows:
        if row["key"] == chosen[0].key:
            row["ate_rmse_m"] *= 1 + 1e-5
            row["curve_error_m"][1] += 1e-3
    changed = store.to_table([row for row in rows if row["key"] in {run.key for run in chosen}])
    store.write_table(changed, path)
    report = studies.check(asked=True)
    assert {d.name for d in report.differences} == {"study.ate_rmse_m", "study.curve_error_m", "study.status"}
    assert sum(d.name == "study.status" for d in report.differences) == 2  # runs that the table does not have
    path.write_bytes(b"no table")
    with pytest.raises(FileMissingError, match="damaged"):
        studies.check(asked=True)


def test_nobody_else_may_write_meanwhile(study, tmp_path):
    with store.holding(tmp_path / "out"), pytest.raises(OutputError, match="in use by another study"):
        studies.run(study, tmp_path / "out")
