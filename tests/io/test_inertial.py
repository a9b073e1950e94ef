"""Inertial readings of bags: which IMU, in which units and axes, and which are of no use."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.types import GRAVITY, Trajectory
from steelnb.io import read_flight
from steelnb.io.messages import IMU
from tests.io.samples import Bagged, T_of, made_up

MOUNT = T_of((0.1, 0.2, 0.3), (0.1, -0.2, 0.3))
UPRIGHT = Trajectory(np.round(0.1 * np.arange(20), 9), np.tile(np.eye(4), (20, 1, 1)))
TIME_S = np.arange(200) / 100
UP = (0.0, 0.0, 9.81)


@pytest.fixture
def bag(tmp_path):
    return Bagged(tmp_path / "a.mcap").clouds(stamps=UPRIGHT.stamp_s).odometry(trajectory=UPRIGHT)


@pytest.mark.parametrize(
    ("time_s", "force", "rate", "words"),
    [
        (TIME_S[:10], (0, 0, 16384.0), 0, "16384 at rest, as of raw counts"),
        (TIME_S, (0, 0, 256.0), 0, "256 at rest, as of raw counts"),
        (TIME_S[:10], (0, 0, 0), 0.1, "accelerations of 0"),
        (TIME_S, (0, 0, 0), 0.1, "accelerations of 0"),
        (TIME_S, (0, 0.05, 0), 0.1, "accelerations of 0"),
        (TIME_S, UP, 40.0, "a median rate of 40; expected rad/s"),
        (TIME_S, (0, 0, -9.81), 0, "at rest [0.0, 0.0, -9.8] m/s² in the world; expected z up"),
        (TIME_S, (1, -9, 1), 0, "at rest [1.0, -9.0, 1.0] m/s² in the world; expected z up"),
        (1000 + TIME_S[:9], UP, 0, "stamps from 1000.000 s on, poses from 0.000 s; expected one clock"),
    ],
)
def test_readings_of_no_use_are_left_out_also_if_their_imu_is_named(bag, time_s, force, rate, words):
    path = bag.imu(time_s, force, (0, 0, rate)).write()
    for name in (None, "/imu"):
        flight = read_flight(path, imu=name)
        assert flight.imu is None
        assert "imu" not in flight.facts
        assert f"inertial readings of /imu are left out: {words}" in flight.facts["notes"]


def test_a_small_tilt_and_vibration_are_no_other_axes(bag):
    shaken = np.column_stack([0.5 - 30 * np.cos(20 * np.pi * TIME_S), 0 * TIME_S + 0.5, 0 * TIME_S + 9.7])
    assert len(read_flight(bag.imu(TIME_S, shaken).write()).imu.stamp_s) == 200  # the same at all poses


@pytest.mark.parametrize("message", [b"\0\1\0\0ab", None])
def test_an_imu_without_a_sample_of_use_is_left_out(bag, message):
    bag.imu([0.0], [np.nan] * 3)
    bag.rows[-1] = ("/imu", IMU, 0.0, message or bag.rows[-1][-1])
    assert read_flight(bag.write()).imu is None


def test_samples_that_are_left_out_are_counted(bag):
    flight = read_flight(
        bag.imu([0.1, 0.1, 0.2, 0.25, 0.3], np.outer([9.8, 9.8, np.nan, 1e300, 9.8], [0, 0, 1])).write()
    )
    assert flight.imu.stamp_s.tolist() == [0.1, 0.3]
    assert flight.skipped["inertial sample that is not finite"] == 2
    assert flight.skipped["inertial sample whose stamp does not rise"] == 1


@pytest.mark.parametrize(
    ("pull", "shake", "unit", "note"),
    [
        ((0, 0, 1), 0.05, GRAVITY, "are in g,"),
        ((0, 0, 1000), 5, GRAVITY / 1000, "are in mg,"),
        ((0.4, 0.3, 9.8), 0.6, 1.0, ""),
        ((0, 0, 0), 0.6, 1.0, "those of a drone that hovers 9.8 m/s²"),  # gravity is removed
    ],
)
def test_accelerations_in_multiples_of_gravity_are_read_as_such(tmp_path, pull, shake, unit, note):
    force = np.random.default_rng(1).normal(0, shake, (400, 3)) + pull
    flight = read_flight(Bagged(tmp_path / "a.mcap").clouds().odometry().imu(np.arange(400) / 400, force).write())
    np.testing.assert_allclose(flight.imu.specific_force, unit * force)
    notes = flight.facts.get("notes", "")
    assert note in notes if note else not notes


@pytest.mark.parametrize("turns_a_second", [0.95, 2.05])
def test_the_rates_of_a_fast_turn_stay_as_they_are(tmp_path, turns_a_second):
    stamp_s, rate = np.round(0.2 * np.arange(40), 9), 2 * np.pi * turns_a_second
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(stamp_s, [0, 0, rate])).as_matrix()
    bag = Bagged(tmp_path / "a.mcap").clouds(stamps=stamp_s).odometry(trajectory=Trajectory(stamp_s, T))
    flight = read_flight(bag.imu(np.arange(160) / 20, UP, (0, 0, rate)).write())
    np.testing.assert_array_equal(flight.imu.angular_rate[:, 2], rate)
    assert "notes" not in flight.facts


@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
def test_rates_in_degrees_are_told_by_the_turns_of_the_poses(tmp_path, unit):
    stamp_s, time_s = np.round(0.1 * np.arange(40), 9), np.arange(400) / 100
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(1 - np.cos(stamp_s), [0, 0, 0.3])).as_matrix()
    rate = np.outer(np.sin(time_s), [0, 0, 0.3 * unit]) + np.random.default_rng(1).normal(0, 0.02 * unit, (400, 3))
    bag = Bagged(tmp_path / "a.mcap").clouds(stamps=stamp_s).odometry(trajectory=Trajectory(stamp_s, T))
    flight = read_flight(bag.imu(time_s, UP, rate).write())
    assert (flight.imu is None) == (unit != 1)
    assert ("/imu are left out: a median rate of 1" in flight.facts.get("notes", "")) == (unit != 1)


def test_the_imu_of_another_drone_is_left_out_if_this_one_has_one(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds("/uav2/points").odometry("/uav2/odom")
    for topic in ("/uav1/imu", "/uav2/imu"):
        bag.imu([0.0], UP, topic=topic)
    flight = read_flight(bag.write())
    assert flight.facts["imu"] == "/uav2/imu"
    assert "inertial readings of /uav1/imu are left out (--imu" in flight.facts["notes"]
    assert read_flight(bag.path, imu="/uav1/imu").facts["imu"] == "/uav1/imu"


def test_an_imu_that_does_not_measure_all_gives_way_to_another(bag):
    for topic, force in (("/a", 1.0), ("/b", 2.0), ("/c", 3.0)):
        bag.imu([0.0], [force] * 3, topic=topic)
        bag.rows[-1][-1].angular_velocity_covariance = np.array([-1.0 if topic == "/a" else 0, *[0] * 8])
    flight = read_flight(bag.write())
    assert flight.facts["imu"] == "/b"
    assert flight.imu.specific_force.tolist() == [[2.0] * 3]
    assert "inertial readings of /a, /c are left out (--imu TOPIC names an IMU)" in flight.facts["notes"]
    assert read_flight(bag.path, imu="/c").imu.specific_force.tolist() == [[3.0] * 3]
    with pytest.raises(InputError, match=r"no topic '/d'; expected one topic of an IMU, .* /a \(Imu\), /b \(Imu\), /c"):
        read_flight(bag.path, imu="/d")


def test_two_topics_with_a_half_of_an_imu_each_are_left_out(bag):
    bag.imu([0.0], [9.8] * 3, topic="/accel").imu([0.0], [0.0] * 3, [0.1] * 3, topic="/gyro")
    flight = read_flight(bag.write())
    assert flight.imu is None
    assert "inertial readings of /accel, /gyro are left out" in flight.facts["notes"]


def test_the_next_imu_is_read_if_the_first_is_left_out(bag):
    for topic, z in (("/a", -9.81), ("/b", 9.81), ("/c", 9.81)):
        bag.imu(TIME_S, (0, 0, z), topic=topic)
    flight = read_flight(bag.write())
    assert flight.facts["imu"] == "/b"
    assert flight.imu.specific_force[0, 2] == 9.81
    assert "of /a are left out: at rest [0.0, 0.0, -9.8]" in flight.facts["notes"]
    assert "of /c are left out (--imu" in flight.facts["notes"]


def test_readings_are_rotated_to_the_axes_of_the_drone(tmp_path):
    imu, bag = made_up().imu, Bagged(tmp_path / "a.mcap").clouds().odometry().tf("base_link", "imu", MOUNT)
    read = read_flight(bag.imu(imu.stamp_s, imu.specific_force, imu.angular_rate, frame="imu").write()).imu
    np.testing.assert_allclose(read.specific_force, imu.specific_force @ MOUNT[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(read.angular_rate, imu.angular_rate @ MOUNT[:3, :3].T, atol=1e-12)


def test_an_imu_with_optical_axes_is_turned_without_a_transform(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds().odometry()
    flight = read_flight(bag.imu([0.0], (0, -9.8, 0), (0, 0, 1), frame="camera_imu_optical_frame").write())
    np.testing.assert_allclose(flight.imu.specific_force, [[0, 0, 9.8]])
    np.testing.assert_allclose(flight.imu.angular_rate, [[1, 0, 0]])
    assert "no transform from base_link to camera_imu_optical_frame" in flight.facts["notes"]
