"""Frames of recordings: mounts through chains and on /tf, gimbals, several sensors, worlds, and clouds in the world."""

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io import read_flight, write_tum
from tests.io.samples import POINTS, STAMPS, Bagged, T_of, poses

MOUNT, DRONE = T_of((0.3, 0, 0.1), (0.1, -0.2, 1.5)), poses(5)
KINDS = "a.bag", "a.mcap"


@pytest.fixture
def bag(tmp_path):
    return Bagged(tmp_path / "a.bag")


def moving(bag, parent, child, trajectory=DRONE, topic="/tf"):
    for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
        bag.tf(parent, child, T, stamp, topic)
    return bag


def world_points(flight):
    """Points of each scan in the world, as every estimator computes them."""
    drone = flight.prior.T_world_drone @ flight.T_drone_sensor
    return [scan.points @ T[:3, :3].T + T[:3, 3] for scan, T in zip(flight.scans, drone, strict=True)]


def assert_world_points(flight, T_world_sensor, points=POINTS):
    for found, T in zip(world_points(flight), T_world_sensor, strict=True):
        np.testing.assert_allclose(found, points @ T[:3, :3].T + T[:3, 3], atol=1e-9)


@pytest.mark.parametrize("frame", ["tof", "/tof"])
def test_a_static_mount_repeated_on_tf_is_the_mount(bag, frame):
    bag.clouds(frame=frame).odometry()
    for stamp in STAMPS:
        bag.tf("base_link", "tof", MOUNT, stamp, "/tf")
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert flight.facts["frames"] == "odom → base_link → tof"
    np.testing.assert_array_equal(flight.scans[2].points, POINTS)


def test_a_static_mount_without_stamps_repeats_nothing_and_one_that_changes_is_noted(bag):
    bag.clouds().odometry()
    for _ in STAMPS:
        bag.tf("base_link", "tof", MOUNT, 0.0, "/tf")
    bag.tf("map", "odom", MOUNT).tf("map", "odom", MOUNT @ MOUNT)
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert not flight.skipped
    assert "fixed transform map → odom changes; the last one is used" in flight.facts["notes"]


@pytest.mark.parametrize(("world", "named"), [("odom", None), ("camera_init", None), ("uav1/odom", "/tf")])
def test_poses_are_those_of_a_chain_of_moving_transforms(bag, world, named):
    ground, up = DRONE.T_world_drone.copy(), np.tile(np.eye(4), (5, 1, 1))
    ground[:, 2, 3], up[:, 2, 3] = 0, DRONE.position[:, 2]
    moving(bag, world, "base_footprint", type(DRONE)(STAMPS, ground))
    moving(bag, "base_footprint", "base_link", type(DRONE)(STAMPS, np.linalg.inv(ground) @ DRONE.T_world_drone))
    flight = read_flight(bag.clouds().tf("base_link", "tof", MOUNT).write(), poses=named)
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert flight.facts["frames"] == f"{world} → base_footprint → base_link → tof"


def test_the_drone_is_what_the_sensor_hangs_on_or_what_moves(bag):
    other = poses(5, seed=3)
    moving(moving(bag.clouds(), "odom", "gripper", other), "odom", "drone").tf("odom", "marker", MOUNT, 0, "/tf")
    path = bag.tf("drone", "tof", MOUNT).write()
    np.testing.assert_allclose(read_flight(path).prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    unknown = Bagged(path.with_stem("b")).clouds(frame="lidar")
    moving(moving(unknown, "odom", "gripper", other), "odom", "drone").write()
    with pytest.raises(InputError, match=r"several frames may be the drone.s: odom>drone, odom>gripper; .*poses"):
        read_flight(unknown.path)
    chosen = read_flight(unknown.path, poses="odom > gripper")
    np.testing.assert_allclose(chosen.prior.T_world_drone, other.T_world_drone, atol=1e-9)
    with pytest.raises(InputError, match=r"no poses of 'nothing' in 'odom' on tf; .*drone, gripper, odom"):
        read_flight(unknown.path, poses="odom>nothing")


def test_a_drone_that_stands_still_has_poses(bag):
    still = type(DRONE)(STAMPS, np.tile(MOUNT, (5, 1, 1)))
    flight = read_flight(moving(bag.clouds(), "odom", "base_link", still).write())
    np.testing.assert_allclose(flight.prior.T_world_drone, still.T_world_drone, atol=1e-12)


def test_of_two_drones_the_one_whose_scans_are_read_counts(bag):
    moving(bag.clouds("/uav2/points"), "odom", "base_link", poses(5, seed=3), "/uav1/tf")
    moving(bag, "odom", "base_link", DRONE, "/uav2/tf")
    np.testing.assert_allclose(read_flight(bag.write()).prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)


def test_scans_on_a_gimbal_are_given_in_its_first_pose(bag):
    gimbal = poses(5, seed=5)
    flight = read_flight(moving(bag.clouds().odometry(), "base_link", "tof", gimbal).write())
    assert_world_points(flight, DRONE.T_world_drone @ gimbal.T_world_drone)
    np.testing.assert_allclose(flight.T_drone_sensor, gimbal.T_world_drone[0], atol=1e-12)
    assert "tf base_link → tof moves" in flight.facts["mount"]
    late = type(gimbal)(gimbal.stamp_s[2:], gimbal.T_world_drone[2:])
    part = moving(Bagged(bag.path.with_stem("late")).clouds().odometry(), "base_link", "tof", late)
    assert read_flight(part.write()).skipped == {"scan without a transform to the drone": 2}


@pytest.mark.parametrize("names", [("front", "rear"), ("front_optical_frame", "rear")])
def test_each_scan_is_read_by_its_own_frame(bag, names):
    mounts = MOUNT, T_of((-0.2, 0, 0), (0, 0, np.pi))
    for name, T in zip(names, mounts, strict=True):
        bag.tf("base_link", name, T)
    for k, stamp in enumerate(STAMPS):
        bag.clouds(stamps=[stamp], frame=names[k % 2])
    flight = read_flight(bag.odometry().write())
    assert_world_points(flight, DRONE.T_world_drone @ [mounts[k % 2] for k in range(5)])
    assert "all are given in that of" in flight.facts["notes"]
    with pytest.raises(InputError, match="one mount does not hold for all"):
        read_flight(bag.path, T_drone_sensor=MOUNT)


def test_scans_of_a_second_frame_that_nothing_relates_are_left_out(bag):
    bag.clouds(stamps=STAMPS[:4]).clouds(stamps=STAMPS[4:], frame="rear").odometry().tf("base_link", "tof", MOUNT)
    flight = read_flight(bag.write())
    assert len(flight) == 4
    assert flight.skipped == {"scan without a transform to the drone": 1}
    assert "scans in 'rear' are left out" in flight.facts["notes"]


@pytest.mark.parametrize("frame", ["camera_init", "map"])
@pytest.mark.parametrize("source", ["topic", "tf", "file"])
def test_clouds_in_the_world_are_brought_back_to_the_drone(bag, tmp_path, frame, source):
    bag.clouds(frame=frame)
    world = "camera_init" if frame == "camera_init" or source != "file" else "map"
    T_map_init = T_of((5, 6, 7), (0, 0, 1)) if frame != world else np.eye(4)
    if frame != world:
        bag.tf("map", "camera_init", T_map_init)
    if source == "topic":
        bag.odometry(frame=world, child="body")
    elif source == "tf":
        moving(bag, world, "body")
    write_tum(tmp_path / "poses.tum", DRONE)
    flight = read_flight(bag.write(), poses=str(tmp_path / "poses.tum") if source == "file" else None)
    T = np.linalg.inv(T_map_init) if source == "topic" else np.eye(4)
    assert_world_points(flight, np.tile(T, (5, 1, 1)))
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))
    assert flight.facts["mount"].startswith(f"points are in {frame}, brought back to")


def test_clouds_in_a_world_that_nothing_relates_to_the_poses_are_refused(bag):
    path = bag.clouds(frame="map").odometry(frame="camera_init", child="body").write()
    with pytest.raises(InputError, match=r"scans are in 'map', a frame of the world, which nothing relates to 'body'"):
        read_flight(path)
    assert read_flight(path, T_drone_sensor=MOUNT).facts["mount"] == "as given"


def test_poses_of_something_else_than_the_sensors_drone_are_refused(bag):
    moving(moving(bag.clouds(), "odom", "base_link"), "odom", "marker", poses(5, seed=3)).tf("base_link", "tof", MOUNT)
    with pytest.raises(InputError, match=r"poses are of marker, but tof moves without it.*--poses 'odom>base_link'"):
        read_flight(bag.odometry(child="marker").write())
