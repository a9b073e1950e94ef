"""Flights from bags of all formats: choice of topics, dropped scans, and errors."""

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.io import read_flight, write_tum
from steelnb.io.messages import CLOUD, ODOMETRY, POSE_COVARIANCE, POSE_STAMPED, TRANSFORM
from tests.io.samples import KINDS, POINTS, STAMPS, Bagged, T_of, poses

MOUNT, SHIFT = T_of((0.1, 0.2, 0.3), (0.1, -0.2, 0.3)), T_of((1, 2, 3))


@pytest.fixture
def bag(request, tmp_path):
    return Bagged(tmp_path / getattr(request, "param", "a.mcap"))


of_all_kinds = pytest.mark.parametrize("bag", KINDS, indirect=True)


@of_all_kinds
@pytest.mark.parametrize("kind", [ODOMETRY, POSE_STAMPED, POSE_COVARIANCE, TRANSFORM])
def test_scans_and_poses_are_found_by_type(bag, kind):
    flight = read_flight(bag.clouds().odometry(kind=kind).write())
    np.testing.assert_array_equal(flight.prior.stamp_s, STAMPS)
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5).T_world_drone, atol=1e-12)
    for scan, stamp_s in zip(flight.scans, STAMPS, strict=True):
        assert scan.stamp_s == stamp_s
        np.testing.assert_array_equal(scan.points, POINTS)
    assert flight.facts["scans"] == "/points (PointCloud2)"
    assert flight.skipped == {}


def test_scans_are_indexed_by_number_slice_and_mask(bag):
    bag.odometry()
    for k, stamp in enumerate(STAMPS):
        bag.clouds(stamps=[stamp], points=POINTS + k)
    scans = read_flight(bag.write()).scans
    assert scans[3].points[0, 0, 0] == 4.0
    assert [scan.points[0, 0, 0] for scan in scans[1:4]] == [2.0, 3.0, 4.0]
    assert len(scans[np.array([True, False, True, False, False])]) == 2


def test_big_endian_messages_are_read(bag):
    flight = read_flight(bag.clouds().odometry().write(little_endian=False))
    np.testing.assert_array_equal(flight.scans[4].points, POINTS)


def test_several_candidate_topics_are_listed_and_one_can_be_chosen(bag):
    path = bag.clouds().clouds("/other").odometry().odometry("/gps", poses(5, seed=2)).write()
    for options, words in (
        ({}, r"several topics of clouds.*/other \(PointCloud2\), /points"),
        ({"scans": "/other"}, r"several topics of poses.*/gps \(Odometry\), /odom"),
        ({"scans": "/nothing"}, "no topic '/nothing'"),
        ({"scans": ""}, "no topic ''; expected one topic of clouds"),
        ({"scans": "/other", "poses": ""}, "no topic ''; expected one topic of poses"),
        ({"scans": "/odom"}, "/odom is Odometry; expected one topic of clouds .* among /other .* /points"),
        (
            {"poses": "/points", "scans": "/other"},
            r"/points is PointCloud2; expected one topic of poses, .*Odometry",
        ),
    ):
        with pytest.raises(InputError, match=words):
            read_flight(path, **options)
    flight = read_flight(path, scans="/other", poses="/gps")
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5, seed=2).T_world_drone, atol=1e-12)


def test_poses_are_read_from_a_given_file(bag, tmp_path):
    write_tum(tmp_path / "poses.tum", poses(5, seed=7))
    flight = read_flight(bag.clouds().write(), poses=str(tmp_path / "poses.tum"))
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5, seed=7).T_world_drone, atol=1e-12)


@pytest.mark.parametrize(("period_s", "covered"), [(0.4, True), (1.9, True), (2.1, False)])
def test_poses_are_interpolated_up_to_a_maximum_gap(bag, period_s, covered):
    slow = poses(5, step_s=period_s)
    bag.clouds(stamps=np.array([0.0, period_s / 2])).odometry(trajectory=slow)
    flight = read_flight(bag.write())
    assert len(flight) == 1 + covered
    assert flight.skipped == ({} if covered else {"scan without a pose near": 1})
    if covered:
        np.testing.assert_allclose(flight.prior.position[1], slow.position[:2].mean(axis=0))


@pytest.mark.parametrize(
    ("child", "transforms", "T_drone_sensor"),
    [
        ("base_link", [("base_link", "arm", T_of((1, 0, 0))), ("arm", "tof", MOUNT)], T_of((1, 0, 0)) @ MOUNT),
        ("camera", [("base_link", "camera", MOUNT), ("base_link", "tof", SHIFT)], np.linalg.inv(MOUNT) @ SHIFT),
        ("base_link", [("map", "tof", MOUNT)], np.eye(4)),
    ],
)
def test_the_mount_is_read_from_tf_static_unless_given(bag, child, transforms, T_drone_sensor):
    bag.clouds().odometry(child=child)
    for parent, frame, T in transforms:
        bag.tf(parent, frame, T)
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.T_drone_sensor, T_drone_sensor, atol=1e-12)
    unknown, known = "no tf_static from base_link to tof: identity assumed", f"tf_static {child} → tof"
    assert flight.facts["mount"] == (unknown if len(transforms) == 1 else known)
    given = read_flight(bag.path, T_drone_sensor=SHIFT)
    np.testing.assert_array_equal(given.T_drone_sensor, SHIFT)
    assert given.facts["mount"] == "as given"


@of_all_kinds
def test_poses_are_read_from_tf_if_there_is_no_topic(bag):
    bag.clouds().tf("base_link", "tof", MOUNT)
    for stamp, T in zip(STAMPS, poses(5).T_world_drone, strict=True):
        bag.tf("map", "odom", T_of((stamp, 0, 0)), stamp, "/tf").tf("odom", "base_link", T, stamp, "/tf")
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5).T_world_drone, atol=1e-12)
    np.testing.assert_allclose(flight.T_drone_sensor, MOUNT, atol=1e-12)
    assert flight.facts["poses"] == "tf odom → base_link"


@of_all_kinds
@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "<u2", 1000), ("32FC1", "<f4", 1)])
def test_depth_images_are_scans_if_there_are_no_clouds(bag, encoding, kind, unit):
    depth_m = np.array([[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]])
    path = bag.images("/depth/image", (depth_m * unit).astype(kind), encoding).camera().odometry().write()
    points = read_flight(path).scans[0].points
    assert points.shape == (2, 3, 3)
    assert np.isnan(points[0, 2]).all()
    # fx 2, cx 1, fy 4, cy 0.5: the last pixel of the second row is half its depth to the right, an eighth below.
    np.testing.assert_allclose(points[1, 2], [5.0, -2.5, -0.625])


def test_each_depth_image_has_the_camera_info_of_its_time(bag):
    depth = np.full((2, 3), 2.0, np.float32)
    bag.images("/depth/image", depth, "32FC1").odometry()
    flight = read_flight(bag.camera().camera(K=(4.0, 0, 1.0, 0, 4.0, 0.5, 0, 0, 1), stamp_s=STAMPS[2]).write())
    across = [float(np.ptp(scan.points[..., 1])) for scan in flight.scans]
    assert across[:2] == [2.0, 2.0]
    assert across[2:] == [1.0] * len(across[2:])
    assert "CameraInfo changes" in flight.facts["notes"]


def test_each_depth_image_has_the_camera_info_of_its_frame(bag):
    wide, narrow = (2.0, 0, 1.0, 0, 2.0, 0.5, 0, 0, 1), (4.0, 0, 1.0, 0, 4.0, 0.5, 0, 0, 1)
    for stamp in STAMPS:
        for frame, K in (("left_optical", wide), ("right_optical", narrow)):
            bag.images("/depth/image", np.full((2, 3), 2.0, np.float32), "32FC1", frame, [stamp])
            bag.camera(K=K, stamp_s=stamp, frame=frame)
    bag.tf("base_link", "left_optical", np.eye(4)).tf("base_link", "right_optical", np.eye(4))
    flight = read_flight(bag.odometry().write())
    for scan in flight.scans:
        left, right = scan.points.reshape(2, -1, 3)
        assert (np.ptp(left[:, 1]), np.ptp(right[:, 1])) == (2.0, 1.0)
    assert "CameraInfo changes" not in flight.facts["notes"]


RECTIFIED = (4.0, 0, 1.0, 0, 0, 8.0, 0.5, 0, 0, 0, 1, 0)


@pytest.mark.parametrize(
    ("topic", "P", "distortion", "across", "note"),
    [
        ("/depth/image_rect", RECTIFIED, (-0.3, 0.1, 0, 0, 0), 1.0, ""),
        ("/depth/image_rect", (0.0,) * 12, (0.0,) * 5, 2.0, ""),
        ("/depth/image_raw", RECTIFIED, (-0.3, 0.1, 0, 0, 0), 2.0, "distortion (plumb_bob) is left out"),
        ("/depth/image_raw", RECTIFIED, (0.0,) * 5, 2.0, "P of the CameraInfo differs from K, which is used"),
    ],
)
def test_rectified_images_have_the_projection_of_the_camera(bag, topic, P, distortion, across, note):
    bag.images(topic, np.full((2, 3), 2.0, np.float32), "32FC1").odometry()
    flight = read_flight(bag.camera(P=P, distortion=distortion).write())
    assert float(np.ptp(flight.scans[0].points[..., 1])) == across
    notes = flight.facts.get("notes", "")
    assert note in notes if note else not notes


def test_the_camera_is_the_nearest_by_name_then_by_frame(tmp_path):
    depth, other = np.full((2, 3), 2.0, np.float32), (8.0, 0, 1.0, 0, 8.0, 0.5, 0, 0, 1)
    own, by_frame = (
        Bagged(tmp_path / f"{k}.mcap").images("/cam/depth/image", depth, "32FC1", frame="d").odometry() for k in "ab"
    )
    own.camera(topic="/cam/depth/camera_info").camera(other, topic="/cam/camera_info")
    by_frame.camera(topic="/a/camera_info", frame="d").camera(other, topic="/b/camera_info", frame="colour")
    for bag in (own, by_frame):
        assert float(np.ptp(read_flight(bag.write()).scans[0].points[..., 1])) == 2.0


def test_scans_with_repeated_stamps_are_dropped_and_swapped_ones_are_sorted(bag):
    for stamp in (0.0, 0.2, 0.2, 0.1, 0.4, 0.8):
        bag.clouds(stamps=[stamp], points=POINTS + stamp)
    flight = read_flight(bag.odometry().write(in_order=False))
    np.testing.assert_array_equal(flight.prior.stamp_s, [0.0, 0.1, 0.2, 0.4, 0.8])
    for scan, stamp in zip(flight.scans, flight.prior.stamp_s, strict=True):
        np.testing.assert_allclose(scan.points, POINTS + stamp, atol=1e-6)
    np.testing.assert_allclose(flight.scans[1].points, POINTS + 0.1, atol=1e-6)
    assert flight.skipped == {"scan message that repeats another one": 1}


def test_scans_far_from_their_place_are_dropped(bag):
    bag.clouds(stamps=[0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.05, 0.7, 0.8]).odometry()
    flight = read_flight(bag.write(in_order=False))
    assert len(flight) == 9
    assert flight.skipped == {"scan whose stamp does not rise": 1}


def test_invalid_scans_have_a_fault_and_keep_their_place(bag):
    bag.odometry()
    for k, stamp in enumerate(STAMPS):
        bag.clouds(stamps=[stamp], points=np.full((4, 5, 3), np.nan) if k == 1 else POINTS + k)
    short = next(message for _, _, stamp, message in bag.rows if stamp == STAMPS[2] and hasattr(message, "data"))
    short.data = short.data[:-8]
    fields = next(message for _, _, stamp, message in bag.rows if stamp == STAMPS[3] and hasattr(message, "data"))
    fields.fields[0].name = "intensity"
    scans = list(read_flight(bag.write()).scans)
    assert [bool(scan.fault) for scan in scans] == [False, True, True, True, False]
    assert scans[1].fault == "no finite point"
    assert scans[3].fault == "unreadable scan: fields intensity, y, z; expected x, y and z of a numeric type"
    np.testing.assert_array_equal(scans[4].points, POINTS + 4)


def test_poses_of_tf_with_z_down_are_turned(bag):
    bag.clouds().tf("base_link_frd", "tof", MOUNT).moving("odom_ned", "base_link_frd")
    flight, flip = read_flight(bag.write()), np.diag([1.0, -1, -1, 1])
    np.testing.assert_allclose(flight.prior.T_world_drone, flip @ poses(5).T_world_drone @ flip, atol=1e-9)
    np.testing.assert_allclose(flight.T_drone_sensor, flip @ MOUNT, atol=1e-9)
    assert "z points down in odom_ned" in flight.facts["notes"]


@pytest.mark.parametrize("by_tf", [True, False])
def test_poses_of_the_world_in_the_drone_are_refused(bag, by_tf):
    bag.clouds().tf("base_link", "tof", MOUNT)
    inverse = Trajectory(STAMPS, np.linalg.inv(poses(5).T_world_drone))
    by_topic = {"child": "odom", "frame": "base_link"}
    path = (bag.moving("base_link", "odom", inverse) if by_tf else bag.odometry(**by_topic)).write()
    with pytest.raises(InputError, match=r"poses of 'odom' in 'base_link': expected .* --poses 'odom>base_link'"):
        read_flight(path)
    if by_tf:
        read = read_flight(path, poses="odom>base_link")
        np.testing.assert_allclose(read.prior.T_world_drone, poses(5).T_world_drone, atol=1e-9)


def test_a_message_of_a_database_without_a_time_is_left_out(tmp_path):
    import sqlite3

    path = Bagged(tmp_path / "a.db3").clouds().odometry().write()
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = 'abc' WHERE id = 3")
    assert len(read_flight(path)) >= 3


@pytest.mark.parametrize(("topic", "kind"), [("/odom", ODOMETRY), ("/points", CLOUD)])
def test_one_damaged_message_costs_only_itself(bag, topic, kind):
    bag.odometry().clouds()
    bag.rows.append((topic, kind, 0.3, b"\0\1\0\0abc"))
    flight = read_flight(bag.write())
    np.testing.assert_array_equal([scan.points for scan in flight.scans], [POINTS] * 5)
    assert flight.skipped == {f"{kind.rpartition('/')[2]} message that cannot be decoded": 1}


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("nothing")
    (tmp_path / "empty.db3").touch()
    (tmp_path / "junk.mcap").write_bytes(b"junk")
    (tmp_path / "folder.bag").mkdir()
    for name, message in {
        "nothing.bag": "does not exist",
        "a.txt": "ending '.txt'; expected .bag, .mcap, .db3 or a folder",
        "empty.db3": "is empty.*expected a sqlite file of ROS 2",
        "junk.mcap": "begins with b'junk'.*expected an MCAP file",
        "folder.bag": "no clouds in it",
    }.items():
        with pytest.raises(InputError, match=rf"{name}: .*{message}"):
            read_flight(tmp_path / name)


def test_a_sensor_far_from_its_drone_is_told(bag):
    notes = read_flight(bag.clouds().odometry().tf("base_link", "tof", T_of((60, 0, -80))).write()).facts["notes"]
    assert "tof is 100 m from base_link; expected the place of a sensor on a drone" in notes


FAR = Trajectory(STAMPS, poses(5).T_world_drone * np.where(np.arange(4) == 3, [[1000.0]] * 3 + [[1.0]], 1.0))
"""Poses in millimetres."""


def images(bag, frame="d"):
    return bag.images("/cam/depth/image", np.ones((2, 3), "<f4"), "32FC1", frame=frame).odometry()


def turned(bag, child):
    """A gimbal that turns, without stamps."""
    for k in range(5):
        bag.tf("base_link", child, T_of((0, 0, 0.1 * k)), 0.0, "/tf")
    return bag.clouds().odometry().tf("gimbal", "tof", MOUNT)


def unstamped(bag):
    """A drone on tf, without stamps."""
    for k in range(5):
        bag.tf("odom", "base_link", T_of((k, 0, 0)), 0.0, "/tf")
    return bag.clouds()


def damaged(bag, kind):
    bag.rows.append(("/scans", f"sensor_msgs/msg/{kind}", 0.3, b"\0\1\0\0abc"))
    return bag.odometry()


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda bag: bag.odometry(), r"no clouds \(PointCloud2 or depth images\).*/odom \(Odometry\)"),
        (lambda bag: bag.images("/grey", np.ones((2, 3), "u1"), "mono8").camera().odometry(), "no clouds"),
        (lambda bag: bag.clouds(), r"no poses.*/points \(PointCloud2\)"),
        (
            lambda bag: bag.clouds().odometry(trajectory=poses(5, begin_s=100.0)),
            "no scan has a pose: scans at 0.000 to 0.800 s, poses at 100.000",
        ),
        (lambda bag: bag.clouds().odometry(trajectory=FAR), "m apart after 0.2 s; expected positions in m"),
        (
            lambda bag: bag.clouds().moving("odom", "base_link", FAR),
            "m apart after 0.2 s; expected positions in m",
        ),
        (lambda bag: turned(bag, "tof"), "base_link → tof move, but all have the stamp 0 s; .*--clock bag"),
        (lambda bag: turned(bag, "gimbal"), "base_link → gimbal move, but all have the stamp 0 s; .*--clock bag"),
        (unstamped, "odom → base_link move, but all have the stamp 0 s; .*--clock bag"),
        (lambda bag: bag.clouds().path_of(poses(0), 0.0), "/path: 0 poses, none valid"),
        (lambda bag: damaged(bag, "PointCloud2"), "not a bag of readable PointCloud2 messages"),
        (lambda bag: damaged(bag, "Image"), "not a bag of readable Image messages"),
        (images, "no CameraInfo of /cam/depth/image"),
        (
            lambda bag: images(bag).camera(topic="/cam/colour/camera_info", frame="colour"),
            "in frame 'd', and the only CameraInfo, /cam/colour/camera_info, in 'colour'",
        ),
        (
            lambda bag: images(bag).camera(K=(2.0, 0, 0, 0, 4.0, 0, 1.0, 0.5, 1), topic="/cam/depth/camera_info"),
            r"CameraInfo with K \[2.0, 0.0, 0.0, .*; expected that of a calibrated camera",
        ),
    ],
)
def test_a_bag_without_what_a_flight_needs_is_refused(bag, build, words):
    with pytest.raises(InputError, match=rf"a\.mcap: .*{words}"):
        read_flight(build(bag).write())
