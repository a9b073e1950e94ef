"""Studies of short flights on clusters of processes: numbers, resuming, failures, kills, and who may connect."""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from steelnb import cli, experiment
from steelnb.errors import InputError
from steelnb.metrics import position_error_m
from steelnb.settings import ExperimentSettings
from steelnb.study import cluster, row
from steelnb.study.plan import CASE, read_plan
from steelnb.study.table import CURVES, ROWS, RUNS, TIMING, locked, read_rows, read_study, write_tables
from workflow.check_study import check_sample

STUDY = """
[a]
seeds = [1, 2]
trajectories = ["zigzag"]
noises = ["random-walk"]
sensors = ["report-4cm"]
methods = ["icp", "average"]
duration_s = 3.0
"""
WIDER = STUDY.replace("[1, 2]", '"1-6"').replace('["random-walk"]', '["random-walk", "constant-drift"]')
FAILING = STUDY.replace("[1, 2]", "[1]") + 'overrides = [{}, { "flight.standoff_m" = -0.05 }]\n'


@pytest.fixture(scope="module")
def client():
    with cluster.connected(2, None, 2) as found:
        found.wait_for_workers(2)
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
    return (folder / RUNS).read_bytes(), (folder / TIMING).read_bytes()


def test_nobody_else_can_talk_to_a_cluster_of_this_machine(client):
    from distributed import Client
    from distributed.security import Security

    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    listening = [c.laddr for p in processes for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN]
    assert {address.ip for address in listening} == {"127.0.0.1"}
    host, port = client.scheduler.address.removeprefix("tls://").split(":")
    workers = [worker.removeprefix("tls://") for worker in client.scheduler_info(n_workers=-1)["workers"]]
    assert int(port) in {address.port for address in listening}
    assert len(workers) == 2
    for address in (f"{host}:{port}", *workers):
        for protocol, security in (("tcp", None), ("tls", Security.temporary())):
            with pytest.raises(OSError, match=r"TLS|Connection reset|Timed out"):
                Client(f"{protocol}://{address}", security=security, timeout=2.0, set_as_default=False)
    with Client(client.scheduler.address, security=client.security, timeout=30.0, set_as_default=False) as holder:
        assert holder.submit(os.getpid, pure=False).result(timeout=20) != os.getpid()  # with its certificate one can


def test_a_study_is_plain_runs_resumed_and_widened(shared, study, tmp_path):
    out, seen = tmp_path / "out", []
    assert cluster.run_study(read_plan(study), out, machine="this one", on_row=seen.append) == []
    frame = read_study(out)
    assert sorted(each["key"] for each in seen) == sorted(frame["key"])
    assert frame[list(CASE)].values.tolist() == [
        ["report-4cm", 3.0, "", "zigzag", seed, "random-walk", "", method]
        for seed in (1, 2)
        for method in ("average", "icp")
    ]
    plain = experiment.run(
        ExperimentSettings.preset("zigzag", "random-walk", sensor="report-4cm", seed=2, duration_s=3.0, method="icp")
    )
    assert {name: frame.iloc[3][name] for name in plain.metrics} == plain.metrics
    assert frame.groupby("seed")["flight_seconds"].nunique().tolist() == [1, 1]  # a flight is simulated once
    assert set(frame["machine"]) == {"this one"}
    first = tables(out)

    cluster.run_study(read_plan(study), out, on_row=pytest.fail)
    assert tables(out) == first  # not even the times
    study.write_text(WIDER)
    assert cluster.forecast(read_plan(study), out)[0] == 4
    again = []
    cluster.run_study(read_plan(study), out, on_row=again.append)
    assert len(again) == 20
    assert read_study(out).set_index("key")["seconds"][frame["key"]].tolist() == frame["seconds"].tolist()
    study.write_text(STUDY)
    cluster.run_study(read_plan(study), out, on_row=pytest.fail)
    assert tables(out) == first


def test_a_run_that_raises_is_recorded_and_tried_again(shared, study, tmp_path, capfd):
    study.write_text(FAILING)
    out = tmp_path / "out"
    assert cli.main(["study", str(study), "--output", str(out)]) == 1
    shown = capfd.readouterr()
    assert "2 runs failed" in shown.out
    assert shown.err.count("CollisionError") == 2
    frame = read_study(out)
    assert frame["status"].tolist() == ["ok", "ok", "failed", "failed"]
    assert set(frame["variant"][2:]) == {"flight.standoff_m=-0.05"}
    for error in frame["error"][2:]:
        assert error.startswith("Traceback")
        assert "CollisionError" in error.splitlines()[-1]
        assert '"steelnb/experiment.py"' in error  # no folder of this machine
    tried = []
    assert len(cluster.run_study(read_plan(study), out, on_row=tried.append)) == len(tried) == 2


def test_a_run_whose_workers_die_fails_and_the_next_call_tries_again(study, tmp_path, monkeypatch):
    import dask
    import distributed  # noqa: F401 its settings first

    runs, out = read_plan(study), tmp_path / "out"
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), monkeypatch.context() as patched:
        patched.setattr(cluster, "run_on", _die_of_average)
        failed = cluster.run_study(runs, out, workers=1)
    # Dask blames every run that waits on a worker for its death, so others may fail too.
    assert {each["key"] for each in failed} >= {run.key for run in runs if run.case["method"] == "average"}
    assert all(each["error"].startswith("KilledWorker: ") for each in failed)
    assert read_study(out)["status"].value_counts()["failed"] == len(failed)
    assert cluster.run_study(runs, out, workers=1) == []
    assert read_study(out)["status"].tolist() == ["ok"] * len(runs)


def _die_of_average(flown, settings):
    if settings.odometry.method == "average":
        os.kill(os.getpid(), signal.SIGKILL)
    return row.run_on(flown, settings)


def test_a_worker_with_other_software_gives_no_numbers(shared, study, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "software_digest", lambda: "the digest of other code")
    failed = cluster.run_study(read_plan(study)[:1], tmp_path / "out")
    assert "another version of steelnb" in failed[0]["error"]


def test_numbers_and_curves_are_those_of_the_run():
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk", sensor="report-4cm", seed=4, duration_s=30.0, method="icp",
        overrides={"tof.blind_s": [[10.0, 15.0]]},
    )  # fmt: skip
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth)
    found = row.numbers(flight, result)
    assert found["lost_share"] == pytest.approx(25 / 149, abs=0.01)
    error = position_error_m(result.corrected, truth.trajectory)
    lost = result.matches[1:] == 0
    total = 0.2 * (found["growth_lost_m_s"] * lost.sum() + found["growth_paired_m_s"] * (~lost).sum())
    assert total == pytest.approx(np.diff(error).sum())
    assert found["slip_m"] == pytest.approx(max(error[5:] - error[:-5]))
    assert found["wrong_share"] == pytest.approx(np.mean(error[result.matches > 0] > 0.25))
    assert found["bend_deg"] > 0
    assert 0 < found["turned_mean_deg"] < 5
    thin = row.curves(result)
    assert {name: len(values) for name, values in thin.items()} == dict.fromkeys(CURVES, row.CURVE_SAMPLES)
    assert thin["curve_time_s"][[0, -1]] == pytest.approx(result.corrected.stamp_s[[0, -1]])
    assert thin["curve_error_m"][-1] == pytest.approx(found["error_final_m"])
    assert thin["curve_raw_m"][-1] == pytest.approx(found["raw_error_final_m"])
    index = np.searchsorted(result.corrected.stamp_s, thin["curve_time_s"] - 1e-3)
    np.testing.assert_array_equal(thin["curve_matches"], result.matches[index])


def test_a_forecast_goes_by_known_runs_else_by_a_rule(study, tmp_path, capsys):
    runs = read_plan(study)
    rule_s = 4 * 3.0 * cluster.FRAME_S * runs[0].settings.tof.rate_hz
    assert cluster.forecast(runs, tmp_path / "out") == (0, pytest.approx(rule_s))
    known = [
        {**run.case, "key": run.key, "status": "ok", "error": "", "seconds": seconds}
        for run, seconds in zip(runs, (6.0, 3.0, 9.0, 3.0), strict=True)
    ]
    with locked(tmp_path / "out"):
        write_tables(tmp_path / "out", runs, {each["key"]: each for each in known})
    study.write_text(STUDY.replace("[1, 2]", "[1, 2, 3]"))
    assert cluster.forecast(read_plan(study), tmp_path / "out") == (4, pytest.approx(7.5 + 3.0))
    before = tables(tmp_path / "out")
    assert cli.main(["study", str(study), "--dry-run", "--output", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["6 runs on 3 flights, 4 of them done", "2 to run: 0 core minutes"]
    assert tables(tmp_path / "out") == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], ["workers = 0", "at least 1"]),
        (["--workers", "two"], ["--workers"]),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], ["workers = 2", "leave out"]),
        (["--scheduler", "tcp://127.0.0.1:1"], ["tcp://127.0.0.1:1: no answer", "tcp://HOST:8786"]),
        (["--scheduler", "bogus://here"], ["bogus://here: no answer"]),
        (["--output", "{study}"], ["study.toml", "cannot be written"]),
        (["--output", "{study}/below"], ["study.toml/below", "cannot be written"]),
    ],
)
def test_bad_options_are_one_line(study, tmp_path, capfd, monkeypatch, options, words):
    monkeypatch.setattr(cluster, "ANSWER_S", 1.0)
    given = [option.format(study=study) for option in options]
    if "--output" not in given:
        given += ["--output", str(tmp_path / "out")]
    assert cli.main(["study", str(study), *given]) == 2
    shown = capfd.readouterr().err
    assert shown.count("\n") == 1
    assert all(word in shown for word in words), shown
    assert not (tmp_path / "out" / RUNS).exists()


def test_check_runs_a_sample_again_and_compares(shared, study, tmp_path):
    runs, out = read_plan(study), tmp_path / "out"
    with pytest.raises(InputError, match="no such file"):
        check_sample(runs, out)
    cluster.run_study(runs, out)
    assert check_sample(runs, out, count=2) == []
    rows = {each["key"]: each for each in read_rows(out / RUNS)}
    first = next(iter(rows.values()))
    first["ate_rmse_m"] *= 1 + 1e-5
    first["curve_error_m"][1] += 1e-3
    del rows[runs[-1].key]
    write_tables(out, [run for run in runs if run.key in rows], rows)
    found = check_sample(runs, out, count=3)
    assert [each.split(": ")[1].split()[0] for each in found] == ["not", "ate_rmse_m", "curve_error_m"]


@pytest.mark.slow
def test_a_study_killed_at_random_moments_ends_with_the_same_bytes(shared, study, tmp_path):
    study.write_text(WIDER)
    cluster.run_study(read_plan(study), tmp_path / "whole")
    out, stored = tmp_path / "killed", 0
    command = [sys.executable, "-m", "steelnb.cli", "study", str(study), "--output", str(out), "--workers", "2"]
    for _ in range(3):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 120
        while not (out / ROWS).is_file() or (out / ROWS).read_text().count("\n") <= stored:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 0.3))
        children = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        process.kill()
        process.communicate()
        assert not psutil.wait_procs(children, timeout=120)[1]  # no worker goes on alone
        stored = (out / ROWS).read_text().count("\n") if not (out / RUNS).exists() else 24
        if stored == 24:
            break
    assert stored
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (out / RUNS).read_bytes() == (tmp_path / "whole" / RUNS).read_bytes()
    assert sorted(path.name for path in out.rglob("*")) == ["lock", "parts", "rows.jsonl", RUNS, TIMING]


@pytest.mark.slow
def test_a_study_goes_on_after_the_scheduler_was_killed(study, tmp_path, monkeypatch):
    # For a busy machine; a client takes as long to see that its scheduler is gone.
    monkeypatch.setattr(cluster, "ANSWER_S", 45.0)
    study.write_text(WIDER)
    runs, out = read_plan(study), tmp_path / "out"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def start(module: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--host", "127.0.0.1", "--no-dashboard"]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    address, started = f"tcp://127.0.0.1:{port}", []
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            started.append(start("dask_scheduler", "--port", str(port)))
            stack.callback(started[-1].kill)
            worker = start("dask_worker", address, "--nthreads", "1", "--local-directory", str(tmp_path))
            stack.callback(worker.terminate)
            if len(started) == 1:
                with pytest.raises(InputError, match="the scheduler went away"):
                    cluster.run_study(runs, out, scheduler=address, on_row=lambda _: started[0].kill())
                stored = (out / ROWS).read_text().count("\n")
                assert 1 <= stored < len(runs)
                worker.terminate()
                worker.wait()
        again = []
        assert cluster.run_study(runs, out, scheduler=address, on_row=again.append) == []
    assert len(again) == len(runs) - stored
