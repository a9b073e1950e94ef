"""`write_flight`: round trips through our reader and that of rosbags, and failures."""

import numpy as np
import pytest

from steelnb.core.errors import InputError, OutputError
from steelnb.io import read_flight, read_truth, write_flight
from tests.io.samples import made_up, poses


@pytest.mark.parametrize(("name", "begin_s"), [("a.bag", 0.0), ("a.bag", 1_700_000_000.123456), ("a.mcap", 0.0)])
def test_a_flight_reads_back_the_same(tmp_path, name, begin_s):
    flight, truth = made_up(begin_s=begin_s), poses(6, begin_s=begin_s, seed=3)
    shares = []
    write_flight(tmp_path / name, flight, truth, shares.append)
    assert {path.name for path in tmp_path.iterdir()} == {"a.truth.tum", name}
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    read = read_flight(tmp_path / name)
    np.testing.assert_array_equal(read.prior.stamp_s, flight.prior.stamp_s)
    np.testing.assert_allclose(read.prior.T_world_drone, flight.prior.T_world_drone, atol=1e-12)
    np.testing.assert_allclose(read.T_drone_sensor, flight.T_drone_sensor, atol=1e-12)
    np.testing.assert_array_equal(read.imu.specific_force, flight.imu.specific_force)
    np.testing.assert_array_equal(read.imu.angular_rate, flight.imu.angular_rate)
    for ours, theirs in zip(read.scans, flight.scans, strict=True):
        np.testing.assert_array_equal(ours.points, theirs.points)
    np.testing.assert_allclose(read_truth(tmp_path / name).T_world_drone, truth.T_world_drone, atol=1e-12)


def test_rosbags_reads_every_message(tmp_path):
    from rosbags.highlevel import AnyReader

    write_flight(tmp_path / "a.bag", made_up())
    with AnyReader([tmp_path / "a.bag"]) as reader:
        assert {topic: info.msgcount for topic, info in reader.topics.items()} == {
            "/tf_static": 1, "/tf": 6, "/odom": 6, "/imu": 50, "/tof/points": 6,
        }  # fmt: skip


def test_a_failure_leaves_no_file(tmp_path):
    def full(share: float) -> None:
        if share > 0.5:
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match=r"No space left on device"):
        write_flight(tmp_path / "a.mcap", made_up(), on_progress=full)
    assert list(tmp_path.iterdir()) == []


def test_existing_files_are_kept_unless_overwrite_is_set(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_text("kept")
    with pytest.raises(OutputError, match=r"a.mcap: exists already; .* or --force .in Python, overwrite=True"):
        write_flight(path, made_up())
    assert path.read_text() == "kept"
    write_flight(path, made_up(), overwrite=True)
    assert len(read_flight(path)) == 6
    (tmp_path / "b.truth.tum").write_text("another recording's")
    with pytest.raises(OutputError, match=r"b.truth.tum: exists already"):
        write_flight(tmp_path / "b.bag", made_up())
    with pytest.raises(InputError, match=r"ending '.txt'; expected .bag or .mcap"):
        write_flight(tmp_path / "a.txt", made_up())


@pytest.mark.parametrize("begin_s", [-1.0, 3e9])
def test_stamps_that_ros_does_not_have_are_refused(tmp_path, begin_s):
    with pytest.raises(InputError, match=r"stamp .* s: expected 0 to 2147483648 s"):
        write_flight(tmp_path / "a.bag", made_up(begin_s=begin_s))
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_too_long_is_one_line(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_flight(tmp_path / f"{'x' * 300}.bag")
    with pytest.raises(OutputError, match="cannot be written"):
        write_flight(tmp_path / f"{'x' * 300}.bag", made_up())
