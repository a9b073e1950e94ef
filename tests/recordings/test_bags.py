"""Bags of others: topics found or asked for, frames resolved, faults refused or counted."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.errors import (
    FileContentError,
    FileMissingError,
    RecordingError,
    SettingsError,
    SteelnbError,
    TopicError,
    UnsupportedFormatError,
)
from steelnb.recordings.bag_files import TRANSFORMS, typestore
from steelnb.recordings.choice import Choice
from steelnb.recordings.formats import open_recording, save_recording
from steelnb.recordings.pinhole import T_OPTICAL_SENSOR
from steelnb.recordings.topics import CAMERA, CLOUD, IMAGE, IMU, ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM
from steelnb.recordings.trajectories import write_tum
from tests.recordings.bag_samples import KINDS, factory, made_up, ns, poses, write_rows

TF = TRANSFORMS[0]
STAMPS = np.round(0.2 * np.arange(5), 9)
POINTS = np.arange(60, dtype=float).reshape(4, 5, 3) + 1


def T_of(xyz=(0, 0, 0), rpy=(0, 0, 0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = xyz, Rotation.from_euler("xyz", rpy).as_matrix()
    return T


def quaternion(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:3, :3]).as_quat()


class Bagged:
    """Rows of a bag in the making."""

    def __init__(self, path: Path) -> None:
        self.path, self.make, self.rows = path, factory(path), []

    def clouds(self, topic="/points", stamps=STAMPS, frame="tof", points=POINTS) -> "Bagged":
        for stamp in stamps:
            message = self.make.cloud(ns(stamp), points)
            message.header.frame_id = frame
            self.rows.append((topic, CLOUD, float(stamp), message))
        return self

    def odometry(self, topic="/odom", trajectory=None, child="base_link", kind=ODOMETRY) -> "Bagged":
        trajectory = trajectory or poses(len(STAMPS))
        for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
            message = self.make.odometry(ns(stamp), T[:3, 3], quaternion(T))
            message.child_frame_id = child
            if kind == POSE:
                message = self.make._make(POSE, message.header, message.pose.pose)
            elif kind == POSE_COVARIANCE:
                message = self.make._make(POSE_COVARIANCE, message.header, message.pose)
            elif kind == TRANSFORM:
                message = self.make.transform(ns(stamp), "odom", child, T[:3, 3], quaternion(T)).transforms[0]
            self.rows.append((topic, kind, float(stamp), message))
        return self

    def tf(self, parent, child, T, stamp=0.0, topic="/tf_static") -> "Bagged":
        self.rows.append((topic, TF, stamp, self.make.transform(ns(stamp), parent, child, T[:3, 3], quaternion(T))))
        return self

    def images(self, topic, pixels, encoding, frame="camera_optical_frame", stamps=STAMPS) -> "Bagged":
        raw = np.ascontiguousarray(pixels)
        for stamp in stamps:
            message = self.make.image(ns(stamp), raw.reshape(raw.shape[0], -1).view(np.uint8))
            message.width, message.encoding, message.header.frame_id = raw.shape[1], encoding, frame
            self.rows.append((topic, IMAGE, float(stamp), message))
        return self

    def camera(self, topic="/depth/camera_info", fx=2.0, distortion=0.0) -> "Bagged":
        roi = self.make._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        K = np.array([fx, 0, 1.0, 0, 4.0, 0.5, 0, 0, 1])
        arrays = (np.full(5, distortion), K, np.eye(3).ravel(), np.zeros(12))
        message = self.make._make(CAMERA, self.make._header(0, "c"), 2, 3, "plumb_bob", *arrays, 0, 0, roi)
        self.rows.append((topic, CAMERA, 0.0, message))
        return self

    def write(self, compression="") -> Path:
        return write_rows(self.path, sorted(self.rows, key=lambda row: row[2]), compression)


@pytest.fixture(params=KINDS)
def bag(request, tmp_path) -> Bagged:
    return Bagged(tmp_path / request.param)


@pytest.fixture
def bag1(tmp_path) -> Bagged:
    return Bagged(tmp_path / "a.bag")


# ---- topics


@pytest.mark.parametrize("kind", [ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM])
def test_scans_and_poses_are_found_by_type(bag, kind):
    recording = open_recording(bag.clouds("/a/b").odometry("/c/d", kind=kind).write())
    assert (recording.facts["scans"], recording.facts["poses"]) == ("/a/b", "/c/d")
    np.testing.assert_allclose(recording.poses.T_world_drone, poses(5).T_world_drone, atol=1e-14)
    scans = list(recording.scans.walk())
    np.testing.assert_array_equal([scan.stamp_s for scan in scans], STAMPS)
    np.testing.assert_array_equal(scans[3].points, POINTS)
    assert len(recording.flight().scans) == 5


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compressed_chunks_of_ros1(bag1, compression):
    assert len(list(open_recording(bag1.clouds().odometry().write(compression)).scans.walk())) == 5


def test_compressed_chunks_of_mcap(tmp_path):
    path = Bagged(tmp_path / "a.mcap").clouds().odometry().write("zstd")
    assert len(list(open_recording(path).scans.walk())) == 5


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_compressed_folders_of_ros2(tmp_path, mode, plugin):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    rows = Bagged(tmp_path / "a.mcap").clouds().odometry().rows
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[plugin])
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        topics = {key: writer.add_connection(*key, typestore=typestore(2)) for key in {row[:2] for row in rows}}
        for topic, kind, stamp, message in rows:
            writer.write(topics[topic, kind], ns(stamp), typestore(2).serialize_cdr(message, kind))
    scans = list(open_recording(tmp_path / "bag").scans.walk())
    np.testing.assert_array_equal([scan.points for scan in scans], [POINTS] * 5)


def test_messages_of_the_other_byte_order(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds().odometry()
    store = typestore(2)
    bag.rows = [
        (topic, kind, stamp, bytes(store.serialize_cdr(message, kind, little_endian=False)))
        for topic, kind, stamp, message in bag.rows
    ]
    recording = open_recording(bag.write())
    np.testing.assert_array_equal(recording.scans.stamp_s, STAMPS)
    np.testing.assert_allclose(recording.poses.position, poses(5).position)
    np.testing.assert_array_equal(next(recording.scans.walk()).points, POINTS)


def test_several_topics_that_fit_are_listed(bag1):
    path = bag1.clouds("/left").clouds("/right").odometry("/vio").odometry("/gps", kind=POSE).write()
    with pytest.raises(TopicError, match=r"2 topics fit for the scans; .* /left \(PointCloud2\), /right"):
        open_recording(path)
    with pytest.raises(TopicError, match=r"2 topics fit for the poses; .* /gps \(PoseStamped\), /vio \(Odometry\)"):
        open_recording(path, Choice(scans="/left"))
    recording = open_recording(path, Choice(scans="/right", poses="/gps"))
    assert recording.facts["scans"] == "/right"
    # the one taken for the truth is not in question for the poses
    recording = open_recording(path, Choice(scans="/right", truth="/gps"))
    assert (recording.facts["poses"], recording.facts["truth"]) == ("/vio", "/gps")
    assert recording.truth is not None


@pytest.mark.parametrize(
    ("choice", "says"),
    [
        (Choice(scans="/none"), r"no topic '/none' for the scans: it has /odom \(Odometry\), /points \(PointCloud2\)"),
        (Choice(poses="/none"), r"no topic '/none' for the poses: it has"),
        (Choice(truth="/none"), r"no topic and no file '/none': it has"),
        (Choice(pictures="/none"), r"no topic '/none' for the pictures: it has"),
        (Choice(scans="/odom"), r"/odom is of type nav_msgs/msg/Odometry, not for the scans; expected one of /points"),
        (Choice(poses="/points"), r"/points is of type sensor_msgs/msg/PointCloud2, not for the poses"),
        (Choice(truth="/points"), r"/points is of type sensor_msgs/msg/PointCloud2, not for the truth"),
        (Choice(pictures="/odom"), r"/odom is of type nav_msgs/msg/Odometry, not for the pictures"),
    ],
)
def test_a_topic_that_is_not_there_or_of_no_use(bag1, choice, says):
    with pytest.raises(TopicError, match=says):
        open_recording(bag1.clouds().odometry().write(), choice)


def test_no_scans_and_no_poses(tmp_path):
    with pytest.raises(RecordingError, match=r"no scans; .* it has /odom \(Odometry\)"):
        open_recording(Bagged(tmp_path / "a.bag").odometry().write())
    with pytest.raises(RecordingError, match=r"no poses; .* it has /points \(PointCloud2\)"):
        open_recording(Bagged(tmp_path / "b.bag").clouds().write())


def test_a_bag_without_messages(bag):
    with pytest.raises(RecordingError, match=r"no scans; .* it holds no messages"):
        open_recording(bag.write())


def test_poses_and_truth_from_files(bag1, tmp_path):
    write_tum(tmp_path / "poses.tum", poses(7, seed=1))
    write_tum(tmp_path / "truth.tum", poses(7, seed=2))
    path = bag1.clouds().odometry().write()
    choice = Choice(poses=str(tmp_path / "poses.tum"), truth=str(tmp_path / "truth.tum"))
    recording = open_recording(path, choice)
    np.testing.assert_allclose(recording.poses.position, poses(7, seed=1).position)
    np.testing.assert_allclose(recording.truth.position, poses(7, seed=2).position)


def test_a_topic_may_be_both_poses_and_truth(bag1):
    path = bag1.clouds().odometry("/truth").write()
    for choice in (Choice(truth="/truth"), Choice(truth="/truth", poses="/truth")):
        recording = open_recording(path, choice)
        np.testing.assert_array_equal(recording.truth.T_world_drone, recording.poses.T_world_drone)
        assert recording.facts["poses"] == "true poses, /truth"


def test_pictures_that_cannot_be_read_are_counted_once(bag1):
    path = bag1.clouds().odometry().images("/camera", np.ones((4, 6, 3), np.uint8), "rgb8")
    images = [message for _, kind, _, message in path.rows if kind == IMAGE]
    images[1].encoding, images[2].step = "yuv", 3
    recording = open_recording(path.write())
    for _ in range(2):
        assert [picture.stamp_s for picture in recording.pictures.walk()] == [0.0, 0.6, 0.8]
    assert sum(recording.skipped.values()) == 2
    assert all(reason.startswith("malformed picture: ") for reason in recording.skipped)


def test_several_cameras_are_said_and_one_may_be_named(bag1):
    pixels = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    path = bag1.clouds().odometry().images("/left", pixels, "bgr8").images("/right", pixels[..., 0], "mono8").write()
    recording = open_recording(path)
    assert recording.pictures is None
    assert recording.facts["pictures"] == "none: 2 topics fit: /left, /right"
    shown = list(open_recording(path, Choice(pictures="/left")).pictures.walk())
    np.testing.assert_array_equal(shown[4].pixels, pixels[..., ::-1])
    shown = list(open_recording(path, Choice(pictures="/right")).pictures.walk())
    np.testing.assert_array_equal(shown[0].pixels, pixels[..., 0])


# ---- frames


def test_extrinsics_follow_tf_from_the_body_to_the_cloud(bag):
    a, b, c = T_of((1, 0, 0), (0.1, 0, 0)), T_of((0, 2, 0), (0, 0.2, 0)), T_of((0, 0, 3), (0, 0, 0.3))
    bag.clouds(frame="tof").odometry(child="body").tf("/body", "plate", a).tf("root", "body", b).tf("plate", "tof", c)
    recording = open_recording(bag.write())
    np.testing.assert_allclose(recording.T_drone_sensor, a @ c, atol=1e-14)
    assert recording.facts["extrinsics"] == "tf body → tof"


def test_poses_that_name_no_body_are_those_of_the_usual_one(bag1):
    T = T_of((1, 2, 3))
    recording = open_recording(bag1.clouds().odometry(kind=POSE).tf("base_link", "tof", T).write())
    np.testing.assert_allclose(recording.T_drone_sensor, T)
    assert recording.facts["extrinsics"] == "tf base_link → tof"
    assert recording.facts["frames"] == "poses of the body, scans in tof"


def test_poses_of_a_frame_that_tf_does_not_know(bag1):
    T = T_of((1, 2, 3))
    recording = open_recording(bag1.clouds().odometry(child="vio").tf("base_link", "tof", T).write())
    np.testing.assert_allclose(recording.T_drone_sensor, T)
    assert recording.facts["extrinsics"] == "tf base_link → tof, since the poses' frame vio is not in tf"


def test_inertial_samples_are_turned_to_the_drones_axes(bag):
    T = T_of((1, 0, 0), (0, 0, np.pi / 2))
    bag.clouds().odometry().tf("base_link", "imu_link", T)
    for stamp, force in ((0.1, (1.0, 2.0, 3.0)), (0.2, (np.inf, 0.0, 0.0)), (0.3, (4.0, 5.0, 6.0))):
        message = bag.make.imu(ns(stamp), np.array(force), np.array([0.1, 0.2, 0.3]))
        message.header.frame_id = "imu_link"
        bag.rows.append(("/imu", IMU, stamp, message))
    recording = open_recording(bag.write())
    np.testing.assert_allclose(recording.imu.stamp_s, [0.1, 0.3])
    np.testing.assert_allclose(recording.imu.specific_force, [(-2, 1, 3), (-5, 4, 6)], atol=1e-14)
    np.testing.assert_allclose(recording.imu.angular_rate, [(-0.2, 0.1, 0.3)] * 2, atol=1e-14)
    assert recording.skipped == {"IMU sample not finite": 1}


def test_extrinsics_against_the_tree(bag1):
    """The sensor is the parent: the transform is inverted."""
    T = T_of((1, 2, 3), (0.1, 0.2, 0.3))
    recording = open_recording(bag1.clouds().odometry().tf("tof", "base_link", T).write())
    np.testing.assert_allclose(recording.T_drone_sensor, np.linalg.inv(T), atol=1e-14)


def test_without_tf_the_settings_or_nothing(bag1, tmp_path):
    path = bag1.clouds().odometry().write()
    recording = open_recording(path)
    np.testing.assert_array_equal(recording.T_drone_sensor, np.eye(4))
    assert recording.facts["extrinsics"] == "none from base_link to tof: taken as the same"
    (tmp_path / "s.toml").write_text("[extrinsics]\ntranslation_m = [1, 2, 3]\nrotation_rpy_deg = [0, 0, 90]\n")
    recording = open_recording(path, Choice(settings=tmp_path / "s.toml"))
    np.testing.assert_allclose(recording.T_drone_sensor, T_of((1, 2, 3), (0, 0, np.pi / 2)), atol=1e-15)
    assert recording.facts["extrinsics"].startswith("settings ")


def test_a_transform_that_moves_is_no_extrinsics(bag1):
    bag1.clouds().odometry()
    for stamp in STAMPS:
        bag1.tf("base_link", "tof", T_of((stamp, 0, 0)), stamp, "/tf")
    recording = open_recording(bag1.write())
    np.testing.assert_array_equal(recording.T_drone_sensor, np.eye(4))
    assert recording.facts["extrinsics"].startswith("none")


def test_a_fixed_transform_that_is_sent_again_is(bag1):
    bag1.clouds().odometry()
    for k, stamp in enumerate(STAMPS):
        bag1.tf("base_link", "tof", T_of((1, 2, 3), (0.1, 0.2, 0.3)), stamp, "/tf")
        rotation = bag1.rows[-1][3].transforms[0].transform.rotation
        if k % 2:  # the same rotation
            rotation.x, rotation.y, rotation.z, rotation.w = -rotation.x, -rotation.y, -rotation.z, -rotation.w
    T = open_recording(bag1.write()).T_drone_sensor
    np.testing.assert_allclose(T, T_of((1, 2, 3), (0.1, 0.2, 0.3)), atol=1e-14)


def test_poses_from_tf_where_no_topic_has_them(bag):
    """map → odom jumps once; odom is preferred since it does not."""
    trajectory = poses(9, 0.1)
    bag.clouds().tf("base_link", "tof", T_of((1, 0, 0)))
    for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
        bag.tf("odom", "base_link", T, stamp, "/tf").tf("map", "odom", T_of((stamp > 0.4, 0, 0)), stamp, "/tf")
    recording = open_recording(bag.write())
    np.testing.assert_allclose(recording.poses.T_world_drone, trajectory.T_world_drone, atol=1e-14)
    assert recording.facts["poses"] == "tf odom → base_link"
    np.testing.assert_allclose(recording.T_drone_sensor, T_of((1, 0, 0)), atol=1e-14)


def test_poses_from_tf_through_two_that_move(bag1):
    bag1.clouds()
    for stamp in np.arange(0, 1, 0.1):
        bag1.tf("root", "base_link", T_of((stamp, 0, 0)), stamp, "/tf")
    for stamp in (0.0, 0.5):
        bag1.tf("world", "root", T_of((0, 10 * stamp, 0)), stamp, "/tf")
    recording = open_recording(bag1.write())
    stamps = recording.poses.stamp_s
    np.testing.assert_allclose(stamps, np.arange(0, 0.55, 0.1))  # as far as both are known
    np.testing.assert_allclose(recording.poses.position, np.outer(stamps, (1, 10, 0)), atol=1e-12)


def test_a_camera_frame_is_turned_to_the_drones_axes(bag1):
    """Poses and points of a camera's frame: one that looks ahead of a drone that does not turn."""
    ahead = T_of()
    ahead[:3, :3] = np.linalg.inv(T_OPTICAL_SENSOR)[:3, :3]  # world ← optical
    trajectory = replace(poses(5), T_world_drone=np.tile(ahead, (5, 1, 1)))
    bag1.clouds(frame="cam_optical_frame").odometry(trajectory=trajectory, child="cam_optical_frame")
    recording = open_recording(bag1.write())
    np.testing.assert_allclose(recording.poses.T_world_drone, np.tile(np.eye(4), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(recording.T_drone_sensor, np.eye(4), atol=1e-14)
    scan = next(recording.scans.walk()).points
    np.testing.assert_array_equal(scan, np.stack([POINTS[..., 2], -POINTS[..., 0], -POINTS[..., 1]], axis=-1))
    assert recording.facts["frames"] == (
        "poses of cam_optical_frame turned from a camera's axes, scans in cam_optical_frame"
    )


def test_tf_to_a_camera_frame_and_its_turn_cancel(bag1):
    T_base_camera = T_of((1, 0, 0))
    T_base_camera[:3, :3] = np.linalg.inv(T_OPTICAL_SENSOR)[:3, :3]
    bag1.clouds(frame="cam_optical_frame").odometry().tf("base_link", "cam_optical_frame", T_base_camera)
    recording = open_recording(bag1.write())
    np.testing.assert_allclose(recording.T_drone_sensor, T_of((1, 0, 0)), atol=1e-14)
    T = recording.T_drone_sensor
    in_drone = next(recording.scans.walk()).points @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(in_drone, POINTS @ T_base_camera[:3, :3].T + T_base_camera[:3, 3], atol=1e-12)


# ---- depth images


@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "<u2", 1000), ("32FC1", "<f4", 1)])
def test_depth_images_are_scans_where_there_are_no_clouds(bag, encoding, kind, unit):
    depth_m = np.array([[1.0, 2.0, 0.0], [0.5, 4.0, 3.0]])
    bag.images("/depth/image_raw", (depth_m * unit).astype(kind), encoding).camera().odometry()
    recording = open_recording(bag.write())
    points = next(recording.scans.walk()).points
    assert points.shape == (2, 3, 3)
    assert np.isnan(points[0, 2]).all()
    # x is the depth; fx 2, fy 4, cx 1, cy 0.5
    np.testing.assert_allclose(points[0, 0], (1, 1 * (1 - 0) / 2, 1 * 0.5 / 4))
    np.testing.assert_allclose(points[1, 2], (3, 3 * (1 - 2) / 2, 3 * (0.5 - 1) / 4))
    assert recording.facts["intrinsics"] == "/depth/camera_info"
    assert recording.facts["size"] == "3 × 2"


def test_depth_images_need_intrinsics(tmp_path):
    depth = np.ones((2, 3), "<u2")
    path = Bagged(tmp_path / "a.bag").images("/depth/image_raw", depth, "16UC1").odometry().write()
    with pytest.raises(RecordingError, match=r"no intrinsics for the depth images /depth/image_raw"):
        open_recording(path)
    (tmp_path / "s.toml").write_text("[intrinsics]\nfx = 2\nfy = 2\ncx = 1\ncy = 1\ndepth_scale = 0.5\n")
    points = next(open_recording(path, Choice(settings=tmp_path / "s.toml")).scans.walk()).points
    np.testing.assert_array_equal(points[..., 0], 0.5)
    bad = Bagged(tmp_path / "b.bag").images("/depth/image_raw", depth, "16UC1").odometry().camera(fx=0.0).write()
    with pytest.raises(RecordingError, match="no intrinsics"):
        open_recording(bad)


def test_an_image_of_another_size_than_the_camera_is_skipped(bag1):
    bag1.images("/depth/image", np.ones((2, 3), "<u2"), "16UC1").camera().odometry()
    bag1.images("/depth/image", np.ones((4, 3), "<u2"), "16UC1", stamps=[1.0])
    recording = open_recording(bag1.write())
    assert [scan.points.size for scan in recording.scans.walk()] == [18] * 5 + [0]
    assert recording.skipped == {"malformed cloud: 3 × 4 pixels; expected 3 × 2": 1}


def test_clouds_are_preferred_and_depth_may_be_named(bag1):
    path = bag1.clouds().images("/depth/image", np.ones((2, 3), "<u2"), "16UC1").camera().odometry().write()
    assert open_recording(path).facts["scans"] == "/points"
    assert open_recording(path, Choice(scans="/depth/image")).facts["scans"] == "/depth/image"


# ---- faults that are counted


def test_stamps_that_repeat_or_run_backwards_are_left_out(bag1):
    bag1.odometry(trajectory=poses(10))
    bag1.clouds(stamps=[0.0, 0.2, 0.2, 0.6, 0.4, 0.5, 0.8])
    rows = [(topic, kind, 0.1 * k, message) for k, (topic, kind, _, message) in enumerate(bag1.rows)]
    recording = open_recording(write_rows(bag1.path, rows))  # received in this order
    np.testing.assert_array_equal(recording.scans.stamp_s, [0.0, 0.2, 0.6, 0.8])
    assert [scan.stamp_s for scan in recording.scans.walk()] == [0.0, 0.2, 0.6, 0.8]
    assert recording.skipped == {"scan: duplicate stamp": 1, "scan: time ran backwards": 2}


def test_bad_clouds_are_counted_once_and_stay_in_step(bag):
    good = bag.clouds(points=POINTS).odometry().rows
    for k, spoil in enumerate(
        (
            lambda m: setattr(m, "point_step", 4),
            lambda m: setattr(m, "width", 0),
            lambda m: setattr(m, "data", np.frombuffer(b"\xff" * len(m.data), np.uint8)),
        )
    ):
        spoil(good[k + 1][3])
    recording = open_recording(bag.write())
    for _ in range(2):
        assert [len(scan.points) for scan in recording.scans.walk()] == [4, 0, 0, 0, 4]
    assert recording.skipped == {
        "malformed cloud: point_step 4; expected at least 12, where its fields end": 1,
        "empty cloud": 1,
        "no finite point": 1,
    }
    wanted = np.array([False, True, False, False, True])
    assert [scan.stamp_s for scan in recording.scans.walk(wanted)] == [0.2, 0.8]


def test_reasons_do_not_grow_without_bound(bag1):
    stamps = np.round(0.1 * np.arange(200), 9)
    bag1.clouds(stamps=stamps).odometry(trajectory=poses(100))
    for k, (_, kind, _, message) in enumerate(bag1.rows):
        if kind == CLOUD:
            message.row_step = k % 60
    recording = open_recording(bag1.write())
    assert sum(len(scan.points) for scan in recording.scans.walk()) == 0
    assert len(recording.skipped) < 40
    assert sum(recording.skipped.values()) == 200


def test_bad_poses_are_counted(bag1):
    bag1.clouds().odometry(trajectory=poses(8))
    messages = [message for _, kind, _, message in bag1.rows if kind == ODOMETRY]
    messages[1].pose.pose.position.x = np.nan
    turn = messages[2].pose.pose.orientation
    turn.x = turn.y = turn.z = turn.w = 0.0
    turn = messages[3].pose.pose.orientation
    turn.x, turn.y, turn.z, turn.w = 7 * turn.x, 7 * turn.y, 7 * turn.z, 7 * turn.w
    messages[5].header.stamp = messages[4].header.stamp
    recording = open_recording(bag1.write())
    np.testing.assert_allclose(recording.poses.stamp_s, [0.0, 0.6, 0.8, 1.2, 1.4])
    np.testing.assert_allclose(recording.poses.T_world_drone[1], poses(8).T_world_drone[3], atol=1e-14)
    assert sum(recording.skipped.values()) == 3


def test_messages_cut_short_are_counted(bag1):
    bag1.clouds().odometry()
    bag1.rows += [("/odom", ODOMETRY, 2.0, b"short"), ("/points", CLOUD, 2.0, b"tiny"), ("/imu", IMU, 2.0, b"no")]
    recording = open_recording(bag1.write())
    assert recording.skipped == {
        "malformed Odometry": 1, "malformed PointCloud2": 1, "malformed Imu": 1, "scan without a stamp": 1
    }  # fmt: skip
    assert len(list(recording.scans.walk())) == 5


def test_stamps_of_zero_give_way_to_when_messages_were_received(bag1):
    bag1.clouds().odometry()
    for _, kind, _, message in bag1.rows:
        if kind == CLOUD:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    np.testing.assert_array_equal(open_recording(bag1.write()).scans.stamp_s, STAMPS)


def test_poses_that_do_not_cover_the_scans(bag1):
    late = replace(poses(5), stamp_s=poses(5).stamp_s + 100.0)
    recording = open_recording(bag1.clouds().odometry(trajectory=late).write())
    with pytest.raises(RecordingError, match=r"no pose at any scan: 0.000 to 0.800 s of scans, 100.000 to 100.800 s"):
        recording.flight()


# ---- damaged files


def whole(path: Path) -> Path:
    save_recording(path, replace(made_up(20, 40, 50), truth=None))
    return path


def outcome(path: Path) -> str:
    """Open and walk: what came of it."""
    try:
        recording = open_recording(path)
        seen = sum(len(scan.points) > 0 for scan in recording.scans.walk())
        return f"{seen} scans"
    except SteelnbError as fault:
        text = str(fault)
        assert text.startswith(str(path))
        assert "\n" not in text
        assert "expected" in text
        return type(fault).__name__


@pytest.mark.parametrize("name", KINDS)
def test_a_bag_cut_at_every_tenth_is_refused(tmp_path, name):
    data = whole(tmp_path / name).read_bytes()
    cut = tmp_path / f"cut{Path(name).suffix}"
    outcomes = []
    for tenth in range(10):
        cut.write_bytes(data[: len(data) * tenth // 10])
        outcomes.append(outcome(cut))
    assert set(outcomes[1:]) == {"FileContentError"}
    assert outcomes[0] in ("FileContentError", "RecordingError")


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_a_folder_whose_file_is_cut_is_refused(tmp_path, form):
    save_recording(tmp_path / "bag", made_up(20, 40, 50), form)
    file = next(f for f in (tmp_path / "bag").iterdir() if f.suffix != ".yaml")
    data = file.read_bytes()
    for tenth in range(1, 10):
        file.write_bytes(data[: len(data) * tenth // 10])
        with pytest.raises(FileContentError):
            sum(1 for _ in open_recording(tmp_path / "bag").scans.walk())


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_flipped_bytes_end_in_our_errors_or_in_scans(tmp_path, name):
    data = whole(tmp_path / name).read_bytes()
    damaged = tmp_path / f"damaged{Path(name).suffix}"
    rng = np.random.default_rng(0)
    outcomes = Counter()
    for _ in range(60):
        noisy = np.frombuffer(data, np.uint8).copy()
        where = rng.integers(0, len(noisy), 30)
        where[:10] = rng.integers(0, 5000, 10)
        where[10:20] = len(noisy) - rng.integers(1, 3000, 10)
        noisy[where] = rng.integers(0, 256, 30)
        damaged.write_bytes(noisy.tobytes())
        outcomes[outcome(damaged)] += 1
    assert outcomes["FileContentError"] > 5


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    "data", [b"", b"garbage", b"\0" * 5000, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"]
)
def test_garbage_is_refused(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    assert outcome(tmp_path / name) == "FileContentError"


def test_paths_that_are_no_recordings(tmp_path):
    with pytest.raises(FileMissingError, match=r"gone.bag: does not exist; expected a recording"):
        open_recording(tmp_path / "gone.bag")
    (tmp_path / "a.xyz").touch()
    with pytest.raises(UnsupportedFormatError, match=r"ending '.xyz'; expected"):
        open_recording(tmp_path / "a.xyz")


def test_a_folder_that_may_not_be_listed(tmp_path, monkeypatch):
    def refused(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(FileMissingError, match="cannot be read: Permission denied; expected a recording"):
        open_recording(tmp_path)


def test_a_folder_without_its_metadata_is_read_by_its_files(tmp_path):
    save_recording(tmp_path / "bag", made_up(), "mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert len(list(open_recording(tmp_path / "bag").scans.walk())) == 6


@pytest.mark.parametrize("text", ["", "no yaml: [", "rosbag2_bagfile_information: {}", "a: 1"])
def test_bad_metadata_is_refused(tmp_path, text):
    save_recording(tmp_path / "bag", made_up(), "mcap")
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with pytest.raises(FileContentError, match="bag"):
        open_recording(tmp_path / "bag")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[extrinsics]\nshift = 1", "extrinsics.shift"),
        ("[extrinsics]\ntranslation_m = [1, 2]", "translation_m"),
        ("[extrinsics]\nrotation_xyzw = [0, 0, 0, 0]", "expected a quaternion not zero"),
        ("[extrinsics]\nrotation_xyzw = [0, 0, 0, 1]\nrotation_rpy_deg = [0, 0, 0]", "expected one of them"),
        ("[intrinsics]\nfx = 0\nfy = 1\ncx = 1\ncy = 1", "intrinsics.fx"),
        ("[extrinsics]\ntranslation_m = [nan, 0, 0]", "translation_m"),
        ("[more]\n", "more"),
    ],
)
def test_bad_settings_are_refused(bag1, tmp_path, text, says):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(SteelnbError, match=says) as caught:
        open_recording(bag1.clouds().odometry().write(), Choice(settings=tmp_path / "s.toml"))
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, SettingsError) or "rotation" in text
