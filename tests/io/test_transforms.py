"""Frames: chains of transforms of any length, moving or not, and the axes of scans."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Flight, Trajectory
from steelnb.io import read_flight

from .samples import POINTS, STAMPS, Bagged, T_of, poses

T_LINK_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""A camera's optical frame in its link's, as in every ROS driver."""


@pytest.fixture
def bag(tmp_path: Path) -> Bagged:
    return Bagged(tmp_path / "a.mcap")


def in_world(flight: Flight) -> list[Array]:
    """The points of the scans in the world of the poses."""
    T = flight.prior.T_world_drone @ flight.T_drone_sensor
    return [transform_points(each, scan.points) for each, scan in zip(T, flight.scans, strict=True)]


@settings(max_examples=25, deadline=None)
@given(data=st.data(), count=st.integers(1, 5), seed=st.integers(0, 1000), suffix=st.sampled_from([".bag", ".mcap"]))
def test_a_chain_of_any_length_and_direction_is_followed(tmp_path_factory, data, count, seed, suffix) -> None:  # type: ignore[no-untyped-def]
    bag, rng = Bagged(tmp_path_factory.mktemp("t") / f"a{suffix}"), np.random.default_rng(seed)
    path = poses(len(STAMPS), seed=seed)
    T, frames = path.T_world_drone, ["base_link", *(f"link_{k}" for k in range(count))]
    for parent, child in itertools.pairwise(frames):
        kind = data.draw(st.sampled_from(["static", "moving", "repeated"]))
        step = poses(len(STAMPS), seed=int(rng.integers(10**6)))
        if kind != "moving":
            step = Trajectory(step.stamp_s, np.tile(step.T_world_drone[:1], (len(step), 1, 1)))
        T = T @ step.T_world_drone
        is_down = data.draw(st.booleans())
        if not is_down:  # it may be sent as the inverse
            step = Trajectory(step.stamp_s, np.linalg.inv(step.T_world_drone))
        pair = (parent, child) if is_down else (child, parent)
        topic = data.draw(st.sampled_from(["/tf", "/tf"])) if kind != "static" else "/tf_static"
        bag.tf(*pair, step.T_world_drone[0]) if topic == "/tf_static" else bag.moving(*pair, step)
    flight = read_flight(bag.clouds(frame=frames[-1]).odometry("/odom", path).write())
    for found, each in zip(in_world(flight), T, strict=True):
        np.testing.assert_allclose(found, transform_points(each, POINTS), atol=1e-9)


@pytest.mark.parametrize("by_tf", [True, False])
def test_a_turn_of_the_world_turns_the_points(tmp_path: Path, by_tf: bool) -> None:
    T_turn, path, found = T_of((3, -2, 1), (0, 0, 0.8)), poses(len(STAMPS)), []
    for name, T in (("a", path.T_world_drone), ("b", T_turn @ path.T_world_drone)):
        bag = Bagged(tmp_path / f"{name}.mcap").clouds().tf("base_link", "tof", T_of((0.1, 0, 0), (0, 0.2, 0)))
        path = Trajectory(path.stamp_s, T)
        bag.moving("odom", "base_link", path) if by_tf else bag.odometry("/odom", path)
        found.append(in_world(read_flight(bag.write())))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, transform_points(T_turn, one), atol=1e-9)


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_clouds_in_the_world_are_brought_back_by_the_poses(bag: Bagged, frame: str) -> None:
    T_odom_map = T_of((1, 2, 3), (0, 0, 0.5)) if frame == "map" else np.eye(4)
    bag.clouds(frame=frame).odometry("/odom", poses(len(STAMPS)))
    if frame == "map":
        bag.tf("odom", "map", T_odom_map)
    flight = read_flight(bag.write())
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))
    for found in in_world(flight):
        np.testing.assert_allclose(found, transform_points(T_odom_map, POINTS), atol=1e-9)
    assert "brought back" in flight.facts["mount"]


def test_each_scan_has_its_own_frame(bag: Bagged) -> None:
    T = {"front": T_of((0.2, 0, 0)), "rear": T_of((-0.2, 0, 0), (0, 0, np.pi))}
    for k, name in enumerate(T):
        bag.clouds(stamps=STAMPS[k::2], frame=name).tf("base_link", name, T[name])
    path = poses(len(STAMPS))
    flight = read_flight(bag.odometry("/odom", path).write())
    for k, found in enumerate(in_world(flight)):
        each = path.T_world_drone[k] @ T[["front", "rear"][k % 2]]
        np.testing.assert_allclose(found, transform_points(each, POINTS), atol=1e-9)
    with pytest.raises(InputError, match="--mount"):
        read_flight(bag.path, mount=(0, 0, 0, 0, 0, 0))


def test_a_frame_that_nothing_relates_needs_a_mount(bag: Bagged) -> None:
    bag.clouds().odometry().write()
    with pytest.raises(InputError, match="--mount"):
        read_flight(bag.path)
    found = read_flight(bag.path, mount=(0.1, 0.2, 0.3, 0, 0, 90)).T_drone_sensor
    np.testing.assert_allclose(found, T_of((0.1, 0.2, 0.3), (0, 0, np.pi / 2)), atol=1e-12)
    np.testing.assert_array_equal(read_flight(bag.path, T_drone_sensor=found).T_drone_sensor, found)


def test_the_frame_of_the_poses_itself_is_the_sensors(bag: Bagged) -> None:
    flight = read_flight(bag.clouds(frame="base_link").odometry().write())
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))


def test_a_scan_at_whose_time_a_moving_mount_is_unknown_is_counted(bag: Bagged) -> None:
    gimbal = Trajectory(STAMPS[:3], poses(3, seed=3).T_world_drone)
    flight = read_flight(bag.clouds().odometry().moving("base_link", "tof", gimbal).write())
    assert len(flight.scans) == 3
    assert sum(flight.skipped.values()) == 2


def test_of_several_moving_frames_one_is_named(bag: Bagged) -> None:
    path, T_map_odom = poses(len(STAMPS)), poses(len(STAMPS), seed=4)
    bag.clouds().tf("base_link", "tof", np.eye(4)).moving("odom", "base_link", path).moving("map", "odom", T_map_odom)
    bag.write()
    with pytest.raises(InputError, match=r"--poses.*map>base_link"):
        read_flight(bag.path)
    found = read_flight(bag.path, poses="odom>base_link").prior.T_world_drone
    np.testing.assert_allclose(found, path.T_world_drone, atol=1e-9)
    found = read_flight(bag.path, poses="map>base_link").prior.T_world_drone
    np.testing.assert_allclose(found, T_map_odom.T_world_drone @ path.T_world_drone, atol=1e-9)


def test_of_several_objects_on_a_topic_the_one_that_carries_the_sensor_is_the_drone(bag: Bagged) -> None:
    path = poses(len(STAMPS))
    bag.clouds().tf("base_link", "tof", np.eye(4)).odometry("/odom", path)
    bag.odometry("/odom", poses(len(STAMPS), seed=9), child="marker").write()
    np.testing.assert_allclose(read_flight(bag.path).prior.T_world_drone, path.T_world_drone, atol=1e-12)
    with pytest.raises(InputError, match="--mount"):
        read_flight(bag.path, poses="odom>marker")


@pytest.mark.parametrize(
    ("frame", "T_base_frame", "optical", "is_optical"),
    [
        ("tof_optical_frame", T_LINK_OPTICAL, None, True),
        ("tof_optical", T_LINK_OPTICAL, None, True),
        ("tof", np.eye(4), None, False),
        ("optical_flow_link", np.eye(4), None, False),
        ("camera_link", np.eye(4), True, True),
        ("camera_optical_frame", T_LINK_OPTICAL, False, False),
    ],
)
def test_the_name_of_a_frame_tells_its_axes_unless_the_user_does(
    bag: Bagged, frame: str, T_base_frame: Array, optical: bool | None, is_optical: bool
) -> None:
    ahead = POINTS.reshape(-1, 3)  # x ahead
    points = ahead @ T_LINK_OPTICAL[:3, :3] if is_optical else ahead
    flight = read_flight(
        bag.clouds(frame=frame, points=points).odometry().tf("base_link", frame, T_base_frame).write(), optical=optical
    )
    np.testing.assert_allclose(flight.scans[0].points, ahead, atol=1e-9)
    np.testing.assert_allclose(flight.T_drone_sensor, np.eye(4), atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "T", "optical"),
    [("c_optical_frame", T_LINK_OPTICAL, None), ("c", T_LINK_OPTICAL, None), ("c_link", np.eye(4), False)],
)
def test_depth_images_have_optical_axes_by_their_message(
    bag: Bagged, frame: str, T: Array, optical: bool | None
) -> None:
    bag.images("/depth/image", np.full((2, 3), 1.0, np.float32), "32FC1", frame).camera(size=(2, 3))
    flight = read_flight(bag.odometry().tf("base_link", frame, T).write(), optical=optical)
    np.testing.assert_allclose(flight.T_drone_sensor, np.eye(4), atol=1e-9)
    np.testing.assert_array_equal(flight.scans[0].points[..., 0], 1.0)


def test_poses_without_a_frame_are_those_of_what_carries_the_sensor(bag: Bagged) -> None:
    T = T_of((0, 0, 0.5))
    flight = read_flight(bag.clouds().odometry(child="").tf("base_link", "arm", T).tf("arm", "tof", T).write())
    np.testing.assert_allclose(flight.T_drone_sensor, T @ T)
