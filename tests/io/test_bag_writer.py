"""Flights written read back the same, here and by the readers of others; nothing half-written stays; memory is flat."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from steelnb.io.bag_topics import CLOUD, ODOMETRY

from steelnb.errors import InputError, OutputError
from steelnb.io import read_flight, read_truth, write_flight
from steelnb.types import Scan, Trajectory
from tests.io.samples import KINDS, made_up, poses

ROOT = Path(__file__).parents[2]
TRUTH = poses(30, 0.05, seed=3)


@pytest.mark.parametrize("begin_s", [0.0, 1_700_000_000.123456])
@pytest.mark.parametrize("name", [*KINDS, "folder"])
def test_a_flight_reads_back_the_same(tmp_path, name, begin_s):
    flight, shares = made_up(begin_s=begin_s), []
    write_flight(tmp_path / name, flight, TRUTH, shares.append)
    read = read_flight(tmp_path / name)
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    np.testing.assert_array_equal(read.prior.stamp_s, flight.prior.stamp_s)
    for scan, written in zip(read.scans, flight.scans, strict=True):
        assert scan.stamp_s == written.stamp_s
        np.testing.assert_array_equal(scan.points, written.points)  # organised, NaN and all
    np.testing.assert_allclose(read.prior.T_world_drone, flight.prior.T_world_drone, atol=1e-15)
    np.testing.assert_allclose(read.T_drone_sensor, flight.T_drone_sensor, atol=1e-15)
    np.testing.assert_array_equal(read.imu.stamp_s, flight.imu.stamp_s)
    np.testing.assert_array_equal(read.imu.specific_force, flight.imu.specific_force)
    np.testing.assert_array_equal(read.imu.angular_rate, flight.imu.angular_rate)
    np.testing.assert_allclose(read_truth(tmp_path / name).T_world_drone, TRUTH.T_world_drone, atol=1e-9)
    assert read.skipped == {}
    assert {file.name for file in tmp_path.iterdir()} == {name, f"{Path(name).stem}.truth.tum"}


@pytest.mark.parametrize("name", KINDS)
def test_the_truth_is_not_in_the_bag(tmp_path, name):
    flight = made_up()
    write_flight(tmp_path / name, flight, TRUTH)
    (tmp_path / "a.truth.tum").unlink()
    assert read_truth(tmp_path / name) is None
    data = (tmp_path / name).read_bytes()
    assert not any(np.float64(x).tobytes() in data for x in TRUTH.position[:, 0])
    assert np.float64(flight.prior.position[3, 0]).tobytes() in data


@pytest.mark.parametrize("name", ["a.mcap", "a"])
def test_the_mcap_reader_reads_every_message(tmp_path, name):
    from mcap.reader import make_reader

    flight = made_up()
    write_flight(tmp_path / name, flight)
    with (tmp_path / ("a.mcap" if name == "a.mcap" else "a/a.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        seen = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages()]
    k = len(flight)
    counts = {"/tf_static": 1, "/tf": k, "/odom": k, "/imu": len(flight.imu.stamp_s), "/tof/points": k}
    assert {topic: sum(t == topic for t, _ in seen) for topic in counts} == counts
    assert [time for _, time in seen] == sorted(time for _, time in seen)
    assert {schema.name for schema in summary.schemas.values()} >= {CLOUD, ODOMETRY}


def test_rosbags_own_reader_finds_the_frames_of_the_mount(tmp_path):
    from rosbags.highlevel import AnyReader

    flight = made_up()
    write_flight(tmp_path / "a.bag", flight)
    with AnyReader([tmp_path / "a.bag"]) as reader:
        first = {}
        for connection, _, raw in reader.messages():
            first.setdefault(connection.topic, reader.deserialize(raw, connection.msgtype))
    (mount,) = first["/tf_static"].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "tof")
    assert [mount.transform.translation.x, mount.transform.translation.y] == flight.T_drone_sensor[:2, 3].tolist()
    assert first["/tof/points"].header.frame_id == "tof"
    assert first["/odom"].pose.pose.position.z == flight.prior.position[0, 2]


def test_scans_without_points_stay_in_step(tmp_path):
    flight = made_up()
    flight.scans[2] = Scan(flight.scans[2].stamp_s, np.zeros((0, 3)))
    write_flight(tmp_path / "a.bag", flight)
    scans = list(read_flight(tmp_path / "a.bag").scans)
    assert [len(scan.points) for scan in scans] == [5, 5, 0, 5, 5, 5]
    assert scans[2].fault == "empty cloud"


class Breaks(list):
    def __iter__(self):
        yield self[0]
        raise InputError("scan 1 is gone")


@pytest.mark.parametrize("name", [*KINDS, "folder"])
def test_an_error_between_leaves_nothing(tmp_path, name):
    with pytest.raises(InputError, match="scan 1"):
        write_flight(tmp_path / "deep" / name, replace(made_up(), scans=Breaks(made_up().scans)), TRUTH)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [*KINDS, "folder"])
def test_a_disk_that_fills_up_leaves_nothing(tmp_path, name):
    """In a process whose files may not pass a size, which the kernel refuses as it refuses a full disk."""
    code = (
        "import resource, sys; sys.dont_write_bytecode = True; from steelnb.errors import OutputError\n"
        "from steelnb.io import write_flight; from tests.io.samples import made_up\n"
        "flight = made_up(6, 100, 100)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "try: write_flight(sys.argv[1], flight)\n"
        "except OutputError as fault: print(fault)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / name], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "cannot be written" in done.stdout
    assert len(done.stdout.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_target_that_cannot_be_is_named(tmp_path):
    with pytest.raises(InputError, match=r"'.ply'; expected .bag, .mcap, .db3 or a folder name for ROS 2"):
        write_flight(tmp_path / "a.ply", made_up())
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        write_flight(tmp_path / "file" / "a.bag", made_up())
    with pytest.raises(OutputError, match="exists already"):
        write_flight(tmp_path / "file", made_up())
    write_flight(tmp_path / "a.bag", made_up(), TRUTH)
    with pytest.raises(OutputError, match=r"a.truth.tum: would be taken"):
        write_flight(tmp_path / "a.mcap", made_up())
    early = Trajectory(made_up().prior.stamp_s - 1.0, made_up().prior.T_world_drone)
    with pytest.raises(InputError, match=r"stamp -1.0 s"):
        write_flight(tmp_path / "b.bag", replace(made_up(), prior=early))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.bag", "a.truth.tum", "file"]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from Linux's /proc")
@pytest.mark.parametrize("name", KINDS)
def test_memory_does_not_grow_with_the_flight(tmp_path, name):
    """Peak memory of a process that writes and reads 50 and 400 scans of 0.3 MB: 15 and 120 MB."""
    code = (
        "import sys; from pathlib import Path; from dataclasses import replace\n"
        "import numpy as np; from steelnb.types import Scan\n"
        "from steelnb.io import read_flight, write_flight; from tests.io.samples import made_up, poses\n"
        "class Scans:\n"
        "    def __iter__(self):\n"
        "        return (Scan(t, np.full((160, 160, 3), t + 1.0)) for t in prior.stamp_s)\n"
        "prior, path = poses(int(sys.argv[1])), Path(sys.argv[2])\n"
        "write_flight(path, replace(made_up(2), scans=Scans(), prior=prior))\n"
        "assert sum(scan.points[0, 0, 0] > 0 for scan in read_flight(path).scans) == len(prior)\n"
        "print(int(Path('/proc/self/status').read_text().partition('VmHWM:')[2].split()[0]) / 1024)\n"
    )
    peaks = []
    for count in (50, 400):
        command = [sys.executable, "-c", code, str(count), tmp_path / f"{count}-{name}"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == 0, done.stderr
        peaks.append(float(done.stdout))
    assert peaks[1] - peaks[0] < 20
