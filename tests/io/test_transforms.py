"""Frames of recordings: mounts through chains and on /tf, gimbals, several sensors, worlds, and clouds in the world."""

import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.io import read_flight, write_tum
from steelnb.io.frames import T_OPTICAL_SENSOR
from steelnb.io.messages import ODOMETRY, POSE_STAMPED, TRANSFORM
from steelnb.io.transforms import Tree
from tests.io.samples import POINTS, STAMPS, Bagged, T_of, poses

MOUNT, DRONE = T_of((0.3, 0, 0.1), (0.1, -0.2, 1.5)), poses(5)


@pytest.fixture
def bag(tmp_path):
    return Bagged(tmp_path / "a.bag")


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


@pytest.mark.parametrize("kind", [ODOMETRY, TRANSFORM])
def test_of_several_objects_on_a_topic_the_drone_is_chosen_as_on_tf(bag, kind):
    still, other = Trajectory(STAMPS, np.tile(MOUNT, (5, 1, 1))), poses(5, seed=3)
    bag.clouds().odometry("/vicon", still, "wand", kind, "world").odometry("/vicon", DRONE, "drone", kind, "world")
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    assert "/vicon has poses of several frames; those of drone in world" in flight.facts["notes"]
    both = Bagged(bag.path.with_stem("b")).clouds().odometry("/vicon", other, "gripper", kind, "world")
    both.odometry("/vicon", DRONE, "drone", kind, "world").write()
    with pytest.raises(InputError, match=r"several frames may be the drone.s: world>drone, world>gripper"):
        read_flight(both.path)
    chosen = read_flight(both.path, poses="world>gripper")
    np.testing.assert_allclose(chosen.prior.T_world_drone, other.T_world_drone, atol=1e-9)


@pytest.mark.parametrize("names", [("", ""), ("map", "base_link"), ("odom", "imu_link")])
def test_first_poses_with_other_names_are_of_the_same_drone(bag, names):
    first = bag.clouds().odometry().rows[-5][3]
    first.header.frame_id, first.child_frame_id = names
    np.testing.assert_allclose(read_flight(bag.write()).prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)


def test_a_pair_that_no_topic_has_is_refused_and_no_other_topic_is_taken(bag):
    path = bag.clouds().odometry().odometry("/goal", poses(5, seed=3), frame="map").moving("odom", "base_link").write()
    with pytest.raises(InputError, match="no poses of 'bse_link' in 'odom' on tf"):
        read_flight(path, poses="odom>bse_link")
    goal = read_flight(path, poses="map>base_link")
    np.testing.assert_allclose(goal.prior.T_world_drone, poses(5, seed=3).T_world_drone, atol=1e-9)


@pytest.mark.parametrize("mark", ["/", "_"])
def test_scans_of_one_drone_are_not_given_the_poses_of_another(bag, mark):
    path = bag.clouds(frame=f"uav2{mark}tof").odometry(child=f"uav1{mark}base_link", frame=f"uav1{mark}odom").write()
    with pytest.raises(InputError, match="of two drones by their names; expected those of one, or --mount"):
        read_flight(path)
    np.testing.assert_array_equal(read_flight(path, T_drone_sensor=MOUNT).T_drone_sensor, MOUNT)


@pytest.mark.parametrize("child", ["cam0_link", "uav2_base_link", "x500_base_link"])
def test_sensors_that_are_counted_are_those_of_one_drone(bag, child):
    flight = read_flight(
        bag.clouds(frame="cam1_link" if child == "cam0_link" else "uav2_tof").odometry(child=child).write()
    )
    assert "identity assumed" in flight.facts["mount"]


@pytest.mark.parametrize(
    ("turn", "note"),
    [
        (np.linalg.inv(T_OPTICAL_SENSOR), "lies on its side, unless poses are those of a camera with optical axes"),
        (np.diag([1.0, -1, -1, 1]), "hangs upside down, unless its axes have z down"), (np.eye(4), ""),
    ],
)  # fmt: skip
def test_poses_of_other_axes_than_the_drones_are_noted(bag, turn, note):
    yawed = np.array([T_of((k, 0, 1), (0.1, 0, 0.7 * k)) for k in range(5)])
    flight = read_flight(bag.clouds().odometry(trajectory=Trajectory(STAMPS, yawed @ turn)).write())
    assert note in flight.facts.get("notes", "")
    assert bool(note) == ("notes" in flight.facts)


def test_quaternions_that_begin_with_w_are_noted(bag):
    yaw, turned = np.linspace(0, 3, 5), np.tile(np.eye(4), (5, 1, 1))
    for T, angle in zip(turned, yaw, strict=True):  # x, y, z, w of a reader are w, x, y, z of the writer
        T[:3, :3] = Rotation.from_quat([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]).as_matrix()
    flight = read_flight(bag.clouds().odometry(trajectory=Trajectory(STAMPS, turned)).write())
    assert "upside down, unless quaternions are w, x, y, z" in flight.facts["notes"]


@pytest.mark.parametrize("aside_m", [0.0, 0.3])
def test_two_static_ways_to_the_sensor_that_disagree_are_noted(bag, aside_m):
    other = MOUNT.copy()
    other[0, 3] += aside_m
    bag.clouds().moving("odom", "base_link").tf("base_link", "tof", MOUNT).tf("base_link", "rig", np.eye(4))
    flight = read_flight(bag.tf("rig", "tof", other).odometry().write())
    notes = (
        "tf_static has two ways from base_link to tof, 0.3 m and 0.0° apart; the shorter is used, not base_link → rig"
    )
    assert (notes in flight.facts.get("notes", "")) == bool(aside_m)


def test_two_programs_that_send_one_transform_are_noted(bag):
    bag.clouds().moving("odom", "base_link").tf("base_link", "tof", MOUNT)
    slow = Trajectory(np.arange(40) * 0.02, np.tile(np.eye(4), (40, 1, 1)))
    slow.T_world_drone[:, 0, 3] = slow.stamp_s + 1.5 * (np.arange(40) % 2)
    flight = read_flight(bag.odometry(trajectory=slow).write())
    assert "/odom jumps 1.5 m to and fro: two programs may send it" in flight.facts["notes"]


@pytest.mark.parametrize(("world", "named"), [("odom", None), ("camera_init", None), ("uav1/odom", "/tf")])
def test_poses_are_those_of_a_chain_of_moving_transforms(bag, world, named):
    ground, up = DRONE.T_world_drone.copy(), np.tile(np.eye(4), (5, 1, 1))
    ground[:, 2, 3], up[:, 2, 3] = 0, DRONE.position[:, 2]
    bag.moving(world, "base_footprint", Trajectory(STAMPS, ground))
    bag.moving("base_footprint", "base_link", Trajectory(STAMPS, np.linalg.inv(ground) @ DRONE.T_world_drone))
    flight = read_flight(bag.clouds().tf("base_link", "tof", MOUNT).write(), poses=named)
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert flight.facts["frames"] == f"{world} → base_footprint → base_link → tof"


def test_the_drone_is_what_the_sensor_hangs_on_or_what_moves(bag):
    other = poses(5, seed=3)
    bag.clouds().moving("odom", "gripper", other).moving("odom", "drone").tf("odom", "marker", MOUNT, 0, "/tf")
    path = bag.tf("drone", "tof", MOUNT).write()
    np.testing.assert_allclose(read_flight(path).prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    unknown = Bagged(path.with_stem("b")).clouds(frame="lidar")
    unknown.moving("odom", "gripper", other).moving("odom", "drone").write()
    with pytest.raises(InputError, match=r"several frames may be the drone.s: odom>drone, odom>gripper; .*poses"):
        read_flight(unknown.path)
    chosen = read_flight(unknown.path, poses="odom > gripper")
    np.testing.assert_allclose(chosen.prior.T_world_drone, other.T_world_drone, atol=1e-9)
    with pytest.raises(InputError, match=r"no poses of 'nothing' in 'odom' on tf; .*drone, gripper, odom"):
        read_flight(unknown.path, poses="odom>nothing")


INVERSE = Trajectory(STAMPS, np.linalg.inv(DRONE.T_world_drone))


@pytest.mark.parametrize(("drone", "world"), [("os_sensor", "odom_lidar"), ("uav1/fcu", "uav1/local_origin")])
def test_an_odometry_that_is_sent_inverted_is_that_of_the_drone(bag, drone, world):
    flight = read_flight(bag.moving(drone, world, INVERSE).tf(drone, "tof", MOUNT).clouds().write())
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert f"{drone} → {world} on tf is an odometry sent inverted" in flight.facts["notes"]


def test_of_several_inverted_odometries_one_is_to_be_named(bag):
    bag.clouds(frame="fcu").moving("fcu", "gps_origin", INVERSE).moving("fcu", "local_origin", INVERSE)
    with pytest.raises(InputError, match="may be the drone's: gps_origin>fcu, local_origin>fcu; expected one"):
        read_flight(bag.write())
    usual = Bagged(bag.path.with_stem("b")).clouds().moving("odom", "base_link").tf("base_link", "tof", MOUNT)
    flight = read_flight(usual.moving("base_link", "odom_lidar", INVERSE).moving("tof", "map_1").write())
    assert flight.facts["poses"] == "tf odom → base_link"
    assert "notes" not in flight.facts


@pytest.mark.parametrize("sensor", ["tof", "a frame that nothing relates"])
def test_thousands_of_frames_take_no_time(sensor):
    """Names of tracks, whose number multiplies with itself if each looks through all: that took ten seconds."""
    tree, still = Tree(), Trajectory(STAMPS[:1], MOUNT[None])
    for number in range(3000):
        tree.add("map", f"track_{number}", still)
    tree.add("map", "odom", still)
    tree.add("odom", "base_link", DRONE)
    tree.add("base_link", "tof", still, is_static=True)
    begin_s = time.process_time()
    assert tree.drone(sensor) == ("odom", "base_link")
    assert time.process_time() - begin_s < 1.0


def test_a_drone_that_stands_still_has_poses(bag):
    still = Trajectory(STAMPS, np.tile(MOUNT, (5, 1, 1)))
    flight = read_flight(bag.clouds().moving("odom", "base_link", still).write())
    np.testing.assert_allclose(flight.prior.T_world_drone, still.T_world_drone, atol=1e-12)


def test_of_two_drones_the_one_whose_scans_are_read_counts(bag):
    bag.clouds("/uav2/points").moving("odom", "base_link", poses(5, seed=3), "/uav1/tf")
    bag.moving("odom", "base_link", DRONE, "/uav2/tf")
    np.testing.assert_allclose(read_flight(bag.write()).prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)


def test_scans_on_a_gimbal_are_given_in_its_first_pose(bag):
    gimbal = poses(5, seed=5)
    flight = read_flight(bag.clouds().odometry().moving("base_link", "tof", gimbal).write())
    assert_world_points(flight, DRONE.T_world_drone @ gimbal.T_world_drone)
    np.testing.assert_allclose(flight.T_drone_sensor, gimbal.T_world_drone[0], atol=1e-12)
    assert "tf base_link → tof moves" in flight.facts["mount"]
    late = Trajectory(gimbal.stamp_s[2:], gimbal.T_world_drone[2:])
    part = Bagged(bag.path.with_stem("late")).clouds().odometry().moving("base_link", "tof", late)
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
        bag.moving(world, "body")
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
    bag.clouds().moving("odom", "base_link").moving("odom", "marker", poses(5, seed=3)).tf("base_link", "tof", MOUNT)
    with pytest.raises(InputError, match=r"poses are of marker, but tof moves without it.*--poses 'odom>base_link'"):
        read_flight(bag.odometry(child="marker").write())


@pytest.mark.parametrize(
    ("body", "poses_from"), [("x500", "PoseStamped"), ("uav1/quadrotor", "a file"), ("drone", "an empty child")]
)
def test_a_drone_of_any_name_is_what_carries_the_sensor(bag, tmp_path, body, poses_from):
    bag.clouds().tf(body, "plate", MOUNT).tf("plate", "tof", MOUNT)
    if poses_from == "a file":
        write_tum(tmp_path / "p.tum", DRONE)
    else:
        bag.odometry(child="", kind=POSE_STAMPED if poses_from == "PoseStamped" else ODOMETRY)
    flight = read_flight(bag.write(), poses=str(tmp_path / "p.tum") if poses_from == "a file" else None)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT @ MOUNT, atol=1e-12)
    assert flight.facts["mount"] == f"tf_static {body} → tof"


def test_a_mount_on_another_frame_than_that_of_the_poses_is_named(bag):
    bag.clouds().tf("base_link", "tof", MOUNT).odometry(child="imu_link")
    flight = read_flight(bag.write())
    assert "base_link → tof is known, but nothing relates imu_link to base_link" in flight.facts["notes"]


@pytest.mark.parametrize(
    ("frame", "child"), [("world", "world"), ("base_link", ""), ("tof", ""), ("base_link", "base_link")]
)
def test_poses_that_do_not_name_the_drone_or_the_world_are_those_of_the_drone_in_the_world(bag, frame, child):
    bag.clouds().tf("base_link", "tof", MOUNT).odometry(frame=frame, child=child)
    if frame == "world":
        bag.moving("world", "base_link")
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    assert flight.facts["mount"] == "tf_static base_link → tof"
    assert ("a frame of the drone itself" in flight.facts.get("notes", "")) == (frame != "world")


def test_a_drone_without_its_namespace_is_the_one_beside_the_sensor_which_is_noted(bag):
    bag.clouds(frame="uav2/tof").tf("uav1/base_link", "uav1/tof", np.eye(4)).tf("uav2/base_link", "uav2/tof", MOUNT)
    flight = read_flight(bag.odometry().write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert "poses of base_link are taken for those of uav2/base_link, which carries uav2/tof" in flight.facts["notes"]


def test_of_two_drones_the_sensor_is_that_of_the_poses(bag):
    bag.clouds().odometry(child="b/base_link").tf("a/base_link", "a/tof", np.eye(4)).tf("b/base_link", "b/tof", MOUNT)
    np.testing.assert_allclose(read_flight(bag.write()).T_drone_sensor, MOUNT, atol=1e-12)


@pytest.mark.parametrize("jitter", [1e-9, 1e-7])
def test_a_mount_on_tf_in_single_precision_is_still(bag, jitter):
    bag.clouds().odometry()
    for k, stamp in enumerate(STAMPS[2:]):
        T = MOUNT.copy()
        T[0, 3] += jitter * (k % 2)
        bag.tf("base_link", "tof", T, stamp, "/tf")
    flight = read_flight(bag.write())
    assert len(flight) == len(STAMPS)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-6)


@pytest.mark.parametrize("sensors", [2, 3])
def test_scans_of_several_sensors_at_one_time_are_one_scan(bag, sensors):
    mounts = [T_of((0.1 * k, 0, 0), (0.4 * k, 0, 0)) for k in range(sensors)]
    for stamp in STAMPS:
        for k, mount in enumerate(mounts):
            bag.clouds(stamps=[stamp], frame=f"l{k}")
            if stamp == STAMPS[0]:
                bag.tf("base_link", f"l{k}", mount)
    flight = read_flight(bag.odometry().write())
    assert len(flight) == len(STAMPS)
    assert flight.skipped == {}
    assert f"{sensors * len(STAMPS)} messages are {len(STAMPS)} scans" in flight.facts["notes"]
    drone = np.concatenate([POINTS.reshape(-1, 3) @ mount[:3, :3].T + mount[:3, 3] for mount in mounts])
    for T, found in zip(DRONE.T_world_drone, world_points(flight), strict=True):
        np.testing.assert_allclose(found, drone @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(flight.scans[4].points, list(flight.scans)[4].points)


@pytest.mark.parametrize(
    ("frame", "body"),
    [
        ("NED", "base_link_frd"), ("map_ned_frame", "drone_1/odom_local_ned"), ("odom_frd", "base_link"),
        ("world_ned", "base_link"),
    ],
)  # fmt: skip
def test_words_of_frames_tell_axes(bag, frame, body):
    flip = np.diag([1.0, -1, -1, 1])
    flight = read_flight(bag.clouds(frame="").odometry(frame=frame, child=body).write())
    right = flip if body != "base_link" else np.eye(4)
    np.testing.assert_allclose(flight.prior.T_world_drone, flip @ DRONE.T_world_drone @ right, atol=1e-9)
    assert f"z points down in {frame}" in flight.facts["notes"]


TURNED = POINTS[..., [2, 0, 1]] * [1, -1, -1]


@pytest.mark.parametrize(
    ("frame", "points"),
    [
        ("optical_frame", TURNED), ("camera_optical_link", TURNED), ("tof_optical_frame_0", TURNED),
        ("TofOpticalFrame", TURNED), ("optical_flow_link", POINTS), ("lidar_optical_mount", POINTS),
        ("optical_base", POINTS), ("nonoptical", POINTS),
    ],
)  # fmt: skip
def test_optical_is_one_of_the_last_words_of_a_name(bag, frame, points):
    flight = read_flight(bag.clouds(frame=frame).odometry().tf("base_link", frame, MOUNT).write())
    np.testing.assert_allclose(flight.scans[0].points, points)
    turn = T_OPTICAL_SENSOR if points is TURNED else np.eye(4)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT @ turn, atol=1e-12)


@pytest.mark.parametrize("frame", ["camera_link", "iris/depth_camera"])
def test_a_depth_camera_that_would_look_straight_up_looks_ahead(bag, frame):
    pixels = np.full((2, 3), 2.0, dtype=np.float32)
    bag.images("/depth/image", pixels, "32FC1", frame).odometry().tf("base_link", frame, T_of((0.1, 0, 0)))
    bag.camera(frame=frame)
    flight = read_flight(bag.write())
    ahead = next(iter(flight.scans)).points.reshape(-1, 3) @ flight.T_drone_sensor[:3, :3].T
    np.testing.assert_allclose(ahead[:, 0], 2.0)
    assert f"depth images are in {frame}, which stands upright" in flight.facts["notes"]


@pytest.mark.parametrize(
    ("frame", "rpy", "ahead", "note"),
    [
        ("camera_link", (0, 44, 0), "x", "stands upright"), ("camera_link", (0, 46, 0), "x", "level along y"),
        ("camera_link", (0, 90, 0), "x", "level along y"), ("camera_link", (0, 60, 90), "x", "level along y"),
        ("depth_camera", (0, 60, 0), "x", "level along y"), ("camera_link", (-90, 0, -90), "z", ""),
        ("camera_link", (-120, 0, -90), "z", ""), ("camera_link", (180, 0, 0), "z", "does not stand upright"),
        ("depth_camera", (180, 0, 0), "z", ""), ("depth_camera", (180, 20, 0), "z", ""),
        ("depth_camera", (0, 90, 0), "z", ""),
    ],
)  # fmt: skip
def test_a_depth_camera_looks_along_the_axis_that_leaves_the_image_level(bag, frame, rpy, ahead, note):
    mount = T_of((0.1, 0, 0), np.radians(rpy))
    bag.images("/depth/image", np.full((2, 3), 2.0, np.float32), "32FC1", frame).odometry().camera(frame=frame)
    flight = read_flight(bag.tf("base_link", frame, mount).write())
    turn = np.eye(4) if ahead == "x" else T_OPTICAL_SENSOR
    np.testing.assert_allclose(flight.T_drone_sensor, mount @ turn, atol=1e-12)
    notes = flight.facts.get("notes", "")
    assert note in notes
    assert bool(note) == ("is ahead" in notes)


@pytest.mark.parametrize("beside", ["tf", "Odometry"])
def test_a_goal_is_no_trajectory(bag, beside):
    goal = Trajectory(DRONE.stamp_s[2:3], DRONE.T_world_drone[2:3])
    bag.clouds().odometry("/goal_pose", goal, kind=POSE_STAMPED)
    flight = read_flight((bag.moving("odom", "base_link") if beside == "tf" else bag.odometry()).write())
    assert len(flight) == len(STAMPS)
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    assert "poses of /goal_pose are left out: 1 of them" in flight.facts["notes"]


@pytest.mark.parametrize(
    ("topic", "frame", "scale", "why"),
    [
        ("/mavros/setpoint_position/local", "map", 1.0, "left out: of a goal by its name"),
        ("/aruco/pose", "tof", 1.0, "left out: they are in tof, which moves with base_link"),
        ("/wheel/pose", "odom", 0.0, "left out: they stay, and base_link moves by 4 m on tf"),
        ("/wheel/pose", "odom", 0.1, "reach 0.4 m, those of tf 4 m (--poses 'odom>base_link' takes these)"),
        ("/pose", "odom", 1.0, ""),
    ],
)
def test_poses_that_are_not_the_drones_give_way_to_tf(bag, topic, frame, scale, why):
    other, path = np.tile(MOUNT, (5, 1, 1)), np.tile(np.eye(4), (5, 1, 1))
    path[:, 0, 3] = 1.1 * np.arange(5)
    other[:, 0, 3] = scale * path[:, 0, 3]
    bag.clouds().moving("odom", "base_link", Trajectory(STAMPS, path)).tf("base_link", "tof", MOUNT)
    bag.odometry(topic, Trajectory(STAMPS, other), "", POSE_STAMPED, frame)
    flight, named = read_flight(bag.write()), read_flight(bag.path, poses=topic)
    assert (flight.facts["poses"] == topic) == ("left out" not in why)
    assert f"poses of {topic}{' are ' if 'out' in why else ' '}{why}" in flight.facts["notes"] if why else True
    assert ("notes" in flight.facts) == bool(why)
    assert named.facts["poses"] == topic


@pytest.mark.parametrize("mount_on", ["/tf_static", "/tf"])
@pytest.mark.parametrize("beside", [False, True])
def test_a_topic_with_the_name_of_a_goal_is_read_if_nothing_else_has_poses(bag, mount_on, beside):
    bag.clouds().odometry("/goal", poses(5, seed=2), "", POSE_STAMPED, "map")
    bag.tf("base_link", "tof", MOUNT, topic=mount_on)
    flight = read_flight((bag.odometry() if beside else bag).write())
    assert flight.facts["poses"] == ("/odom" if beside else "/goal")
    assert ("poses of /goal are left out: of a goal by its name" in flight.facts.get("notes", "")) == beside


@pytest.mark.parametrize(
    ("topic", "other", "child"),
    [("/odom", "wand", "tof"), ("/odom", "base_link", "base_link"), ("/target/odom", "base_link", "base_link")],
)
def test_a_drone_that_stands_is_not_taken_for_another_that_flies_or_for_a_corrected_map(bag, topic, other, child):
    """What moves on tf is a wand without the sensor, or a correction that jumps once."""
    jump = np.tile(np.eye(4), (5, 1, 1))
    jump[:, 0, 3] = np.linspace(0, 4, 5) if other == "wand" else 4.0 * (np.arange(5) > 2)
    still = Trajectory(STAMPS, np.tile(np.eye(4), (5, 1, 1)))
    bag.clouds(frame=child).odometry(topic, still).moving("map", other, Trajectory(STAMPS, jump))
    if other != "wand":
        bag.tf("base_link", "tof", MOUNT)
    flight = read_flight(bag.write())
    assert flight.facts["poses"] == topic
    assert np.ptp(flight.prior.position, axis=0).max() == 0.0


def test_odometry_of_a_drone_with_a_gimbal_on_tf_is_not_compared_with_it(bag):
    gimbal = Trajectory(STAMPS, np.stack([T_of((k, 0, 0), (0, 0.02 * k, 0)) for k in range(5)]))
    still = Trajectory(STAMPS, np.tile(np.eye(4), (5, 1, 1)))
    flight = read_flight(bag.clouds().odometry(trajectory=still).moving("base_link", "tof", gimbal).write())
    assert flight.facts["poses"] == "/odom"


def test_the_last_static_transform_that_is_valid_holds_and_one_that_is_not_is_named(bag):
    wrong, none = MOUNT.copy(), MOUNT.copy()
    wrong[0, 3] = np.nan
    bag.clouds().odometry().tf("base_link", "tof", MOUNT).tf("base_link", "tof", wrong, 0.3).tf(
        "base_link", "rig", none
    )
    rotation = bag.rows[-1][3].transforms[0].transform.rotation
    rotation.x = rotation.y = rotation.z = rotation.w = 0.0
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert (
        "transform base_link → rig is left out: 1 poses, none valid; expected finite numbers and unit quaternions, not"
        " x y z 0.3 0 0.1, qx qy qz qw 0 0 0 0"
    ) in flight.facts["notes"]


def test_control_signs_in_names_of_frames_are_not_printed(bag):
    flight = read_flight(bag.clouds(frame="to\nf").odometry(child="\x1bb").tf("\x1bb", "to\nf", MOUNT).write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert flight.facts["frames"] == "odom → �b → to�f"


@pytest.mark.parametrize("latest", [2, 5])
def test_a_path_that_grows_or_keeps_its_latest_poses_has_all(bag, latest):
    bag.clouds()
    for end in range(1, len(STAMPS) + 1):
        shown = slice(max(end - latest, 0), end)
        bag.path_of(Trajectory(STAMPS[shown], DRONE.T_world_drone[shown]), STAMPS[end - 1])
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    assert flight.skipped == {}


@pytest.mark.parametrize("is_same", [False, True])
@pytest.mark.parametrize("is_planned", [False, True])
def test_poses_of_a_path_without_stamps_have_those_of_the_messages_that_end_with_them(bag, is_same, is_planned):
    bag.clouds()
    for end in range(1, len(STAMPS) + 1):
        shown = slice(end - 1, None) if is_planned else slice(None, end)
        bag.path_of(Trajectory(STAMPS[shown], DRONE.T_world_drone[shown]), STAMPS[end - 1])
        message = bag.rows[-1][3]
        for each in message.poses:
            each.header.stamp = (message if is_same else bag.rows[0][3]).header.stamp  # or 0
    if is_planned:
        with pytest.raises(
            InputError, match=r"/path: 5 poses with one stamp, 0.000 s; expected that of each, or anoth"
        ):
            read_flight(bag.write())
        return
    flight = read_flight(bag.write())
    np.testing.assert_array_equal(flight.prior.stamp_s, STAMPS)
    np.testing.assert_allclose(flight.prior.T_world_drone, DRONE.T_world_drone, atol=1e-9)
    assert "poses of /path have no stamps of their own; each has that of the message" in flight.facts["notes"]


def test_a_path_of_another_map_is_not_joined(bag):
    """A SLAM restarts: its new path is elsewhere, and shares no stamp with the old one."""
    bag.clouds()
    for k, stamp in enumerate(STAMPS):
        shown, moved = (slice(0, k + 1), 0.0) if k < 2 else (slice(2, k + 1), 5.0)
        T = DRONE.T_world_drone[shown].copy()
        T[:, 0, 3] += moved
        bag.path_of(Trajectory(STAMPS[shown], T), stamp)
    flight = read_flight(bag.write())
    np.testing.assert_array_equal(flight.prior.stamp_s, STAMPS[2:])
    np.testing.assert_allclose(flight.prior.position[:, 0], DRONE.position[2:, 0] + 5.0)


def test_a_part_of_a_scan_that_cannot_be_read_leaves_the_others(bag):
    for frame in ("l0", "l1"):
        bag.clouds(frame=frame).tf("base_link", frame, np.eye(4))
    broken = next(row[-1] for row in bag.rows if row[0] == "/points" and row[-1].header.frame_id == "l1")
    broken.width, broken.row_step = 10_000_000, 120_000_000
    flight = read_flight(bag.odometry().write())
    assert [len(scan.points.reshape(-1, 3)) for scan in flight.scans] == [20, 40, 40, 40, 40]
    assert all(scan.fault == "" for scan in flight.scans)


@pytest.mark.parametrize("delay_s", [0.0, 0.05])
@pytest.mark.parametrize("parts", ["ab", "aa", "aab", "abab"])
def test_parts_of_a_scan_are_joined_and_repeated_ones_left_out(bag, parts, delay_s):
    """Stamps are 0.2 s apart. ``parts``: the points of the messages of one stamp."""
    points = {"a": POINTS, "b": POINTS + 100}
    for stamp in STAMPS:
        for k, part in enumerate(parts):
            bag.clouds(stamps=[stamp], points=points[part])
            bag.rows[-1] = ("/points", bag.rows[-1][1], stamp + k * delay_s / len(parts), bag.rows[-1][3])
    flight = read_flight(bag.odometry().write())
    different = sorted({*parts})
    np.testing.assert_array_equal(
        [scan.points.reshape(-1, 3) for scan in flight.scans],
        [np.concatenate([points[part].reshape(-1, 3) for part in different])] * 5,
    )
    repeated = 5 * (len(parts) - len(different))
    assert flight.skipped == ({"scan message that repeats another one": repeated} if repeated else {})
    assert ("10 messages are 5 scans" in flight.facts.get("notes", "")) == (len(different) > 1)


@pytest.mark.parametrize("frame", ["camera_depth_optical_frame", "camera_color_optical_frame"])
def test_depth_images_without_tf_look_ahead(bag, frame):
    bag.images("/depth/image", np.full((2, 3), 2.0, np.float32), "32FC1", frame).camera(frame=frame).odometry()
    flight = read_flight(bag.write())
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))
    np.testing.assert_array_equal(flight.scans[0].points[..., 0], 2.0)
    assert "identity assumed" in flight.facts["mount"]


def test_transforms_of_another_name_are_left_out(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds(frame="base_link")
    aside = poses(5).T_world_drone.copy()
    aside[:, 0, 3] += 0.5
    bag.moving("odom", "base_link", SimpleNamespace(stamp_s=poses(5).stamp_s, T_world_drone=aside), "/tf_old")
    bag.moving("odom", "base_link").write()
    for given in (None, "/tf"):
        np.testing.assert_allclose(read_flight(bag.path, poses=given).prior.T_world_drone, poses(5).T_world_drone)
    np.testing.assert_allclose(read_flight(bag.path, poses="/tf_old").prior.T_world_drone, aside)


def test_transforms_that_stay_may_have_another_namespace(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds().moving("odom", "base_link")
    flight = read_flight(bag.tf("base_link", "tof", MOUNT, topic="/uav1/tf_static").write())
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        ("down_camera", "are left out: they are in down_camera, which moves with base_link"),
        ("base_link", "are left out: they are in base_link itself, and 5 m from it on tf"),
        ("odom", "are 5 m from those of tf \\(--poses 'odom>base_link' takes these\\)"),
        ("camera", "are 5 m from those of tf \\(--poses 'odom>base_link' takes these\\)"),
    ],
)
def test_poses_of_something_else_give_way_to_tf_or_are_told(tmp_path, frame, says):
    aside = poses(5).T_world_drone.copy()
    aside[:, :3, 3] += (3, 4, 0)
    other = SimpleNamespace(stamp_s=poses(5).stamp_s, T_world_drone=aside)
    bag = (
        Bagged(tmp_path / "a.mcap")
        .clouds()
        .tf("base_link", "tof", MOUNT)
        .tf("base_link", "down_camera", T_of((0, 0, -1)))
    )
    bag.moving("odom", "base_link").odometry("/tag", other, "", POSE_STAMPED, frame)
    flight = read_flight(bag.write())
    assert re.search(f"poses of /tag {says}", flight.facts["notes"])
    expected = poses(5).T_world_drone if "left out" in says else aside
    np.testing.assert_allclose(flight.prior.T_world_drone, expected, atol=1e-9)
