"""A study on a cluster of processes whose workers and scheduler are killed meanwhile."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from steelnb import studies
from steelnb.errors import SchedulerError
from steelnb.study.plan import by_flight
from steelnb.study.row import fly, run_on
from steelnb.study.store import Store
from tests.study.processes import Cluster, free_port

STUDY = """
[a]
seeds = "1-2"
trajectories = ["vertical", "orbit"]
noises = ["random-walk", "constant-drift"]
sensors = ["report"]
methods = ["average", "icp", "best"]
duration_s = 3.0
"""


def start(study: Path, out: Path, address: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "steelnb.cli", "study", str(study), "--out", str(out), "--scheduler", address]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )


def wait_for_parts(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while len(list((out / "parts").glob("[0-9]*.parquet"))) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_the_table_is_the_same_after_three_workers_and_the_scheduler_were_killed(tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text(STUDY)
    runs = studies.read_study_file(study)
    assert len(runs) == 24
    plain = Store(tmp_path / "plain")
    for flight in by_flight(runs):
        flown = fly(flight[0].settings)
        plain.add([{**run.case, "key": run.key, **run_on(flown, run.settings)} for run in flight])
    plain.compact(runs)

    out = tmp_path / "killed"
    with Cluster(tmp_path) as cluster:
        process = start(study, out, cluster.address)
        for parts, name in ((1, "worker-0"), (2, "worker-1"), (3, "worker-0")):
            wait_for_parts(out, parts, process)
            cluster.kill(name)
        wait_for_parts(out, 5, process)
        cluster.kill("scheduler")
        _, shown = process.communicate(timeout=60)
        assert process.returncode == 2
        lines = [line for line in shown.splitlines() if not line.startswith("[")]  # of progress
        assert len(lines) == 1
        assert "the scheduler went away" in lines[0]
        stored = len(list((out / "parts").glob("[0-9]*.parquet")))
        assert 5 <= stored < 24

        process = start(study, out, cluster.address)
        printed, shown = process.communicate(timeout=120)
        assert process.returncode == 0, shown
        assert cluster.started["worker-0"] >= 3
        assert cluster.started["worker-1"] >= 2
        assert cluster.started["scheduler"] == 2
    again = int(printed.split("24 runs, ")[1].split()[0])
    assert again <= 24 - stored  # what was stored is not run again
    assert (out / "runs.parquet").read_bytes() == (tmp_path / "plain" / "runs.parquet").read_bytes()


def test_a_scheduler_that_does_not_answer_or_has_no_workers_is_one_line(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("steelnb.study.cluster.ANSWER_S", 1.0)
    study = tmp_path / "study.toml"
    study.write_text(STUDY)
    with pytest.raises(SchedulerError, match="no answer"):
        studies.run(study, tmp_path / "out", scheduler=f"tcp://127.0.0.1:{free_port()}")
    with pytest.raises(SchedulerError, match="no answer"):
        studies.run(study, tmp_path / "out", scheduler="bogus://here")
    assert not [*(tmp_path / "out" / "parts").glob("*.parquet")]
    assert os.listdir(tmp_path / "out") == ["parts"]
    with Cluster(tmp_path, workers=0) as cluster:
        monkeypatch.setattr("steelnb.study.cluster.ANSWER_S", 5.0)
        with pytest.raises(SchedulerError, match="no worker within 5 s"):
            studies.run(study, tmp_path / "out", scheduler=cluster.address)
