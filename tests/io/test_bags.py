"""Bags of others: topics found or named, frames resolved, faults refused or counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from steelnb.io.bag_topics import CLOUD, IMU, ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM
from steelnb.io.calibration import T_OPTICAL_SENSOR
from steelnb.io.transforms import interpolate

from steelnb.errors import InputError, SteelnbError
from steelnb.io import read_flight, read_truth, write_tum
from tests.io.samples import KINDS, POINTS, STAMPS, Bagged, T_of, ns, poses


@pytest.fixture(params=KINDS)
def bag(request, tmp_path) -> Bagged:
    return Bagged(tmp_path / request.param)


@pytest.fixture
def bag1(tmp_path) -> Bagged:
    return Bagged(tmp_path / "a.bag")


@pytest.mark.parametrize("kind", [ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM])
def test_scans_and_poses_are_found_by_type(bag, kind):
    flight = read_flight(bag.clouds("/a/b").odometry("/c/d", kind=kind).write())
    assert flight.facts["scans"] == "/a/b"
    assert flight.facts["poses"].startswith("/c/d: 5 at 5 Hz")
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5).T_world_drone, atol=1e-14)
    scans = list(flight.scans)
    np.testing.assert_array_equal([scan.stamp_s for scan in scans], STAMPS)
    np.testing.assert_array_equal(scans[3].points, POINTS)
    assert flight.skipped == {}


def test_scans_are_picked_by_number_slice_and_mask(bag1):
    scans = read_flight(bag1.clouds().odometry().write()).scans
    assert (len(scans), scans[-1].stamp_s, scans[1].stamp_s) == (5, 0.8, 0.2)
    assert [scan.stamp_s for scan in scans[1:4:2]] == [0.2, 0.6]
    assert [scan.stamp_s for scan in scans[np.array([1, 0, 0, 0, 1], bool)]] == [0.0, 0.8]
    assert [scan.stamp_s for scan in scans[2:][:2]] == [0.4, 0.6]
    assert list(scans[5:]) == []
    with pytest.raises(IndexError):
        scans[5]


def test_messages_of_the_other_byte_order(tmp_path):
    flight = read_flight(Bagged(tmp_path / "a.mcap").clouds().odometry().write(little_endian=False))
    np.testing.assert_array_equal(flight.prior.stamp_s, STAMPS)
    np.testing.assert_allclose(flight.prior.position, poses(5).position)
    np.testing.assert_array_equal(flight.scans[0].points, POINTS)


def test_several_topics_that_fit_are_listed(bag1):
    path = bag1.clouds("/left").clouds("/right").odometry("/vio").odometry("/gps", kind=POSE).write()
    with pytest.raises(InputError, match=r"2 topics fit for the scans; .* /left \(PointCloud2\), /right"):
        read_flight(path)
    with pytest.raises(InputError, match=r"2 topics fit for the poses; .* /gps \(PoseStamped\), /vio \(Odometry\)"):
        read_flight(path, scans="/left")
    assert read_flight(path, scans="/right", poses="/gps").facts["scans"] == "/right"
    # the one that is the truth is not in question for the poses
    assert read_flight(path, scans="/right", truth="/gps").facts["poses"].startswith("/vio")
    np.testing.assert_allclose(read_truth(path, truth="/gps").position, poses(5).position)
    assert read_truth(path) is None


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ({"scans": "/none"}, r"no topic '/none' for the scans: it has /odom \(Odometry\), /points \(PointCloud2\)"),
        ({"poses": "/none"}, r"no topic '/none' for the poses: it has"),
        ({"scans": "/odom"}, r"/odom is of type nav_msgs/msg/Odometry, not for the scans; expected one of /points"),
        ({"poses": "/points"}, r"/points is of type sensor_msgs/msg/PointCloud2, not for the poses"),
        ({"truth": "/none"}, r"no topic and no file '/none': it has"),
        ({"truth": "/points"}, r"/points is of type sensor_msgs/msg/PointCloud2, not for the truth"),
    ],
)
def test_a_topic_that_is_not_there_or_of_no_use(bag1, named, says):
    path = bag1.clouds().odometry().write()
    with pytest.raises(InputError, match=says):
        read_truth(path, **named) if "truth" in named else read_flight(path, **named)


def test_no_scans_no_poses_and_no_messages(tmp_path):
    with pytest.raises(InputError, match=r"no scans; .* it has /odom \(Odometry\)"):
        read_flight(Bagged(tmp_path / "a.bag").odometry().write())
    with pytest.raises(InputError, match=r"no poses; .* it has /points \(PointCloud2\)"):
        read_flight(Bagged(tmp_path / "b.bag").clouds().write())
    with pytest.raises(InputError, match=r"no scans; .* it holds no messages"):
        read_flight(Bagged(tmp_path / "c.bag").write())


def test_poses_are_interpolated_and_gaps_leave_scans_out(bag1):
    trajectory = replace(poses(4), stamp_s=np.array([0.1, 0.3, 0.5, 1.5]))
    path = bag1.clouds(stamps=[0.0, 0.2, 0.5, 0.8]).odometry(trajectory=trajectory).write()
    flight = read_flight(path)
    write_tum(path.with_name("poses.tum"), trajectory)
    for named in ("/odom", str(path.with_name("poses.tum"))):
        prior, truth = read_flight(path, poses=named).prior, read_truth(path, truth=named)
        np.testing.assert_allclose(prior.T_world_drone, flight.prior.T_world_drone, atol=1e-12)
        np.testing.assert_allclose(truth.position, trajectory.position)
    np.testing.assert_array_equal(flight.prior.stamp_s, [0.2, 0.5])
    np.testing.assert_allclose(flight.prior.position[0], trajectory.position[:2].mean(axis=0))
    assert flight.skipped == {"no pose within the gap": 2}
    assert len(read_flight(path, gap_max_s=1.0)) == 3
    for gap in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="gap = "):
            read_flight(path, gap_max_s=gap)


@pytest.mark.parametrize(("period_s", "scans"), [(0.1, 0), (0.5, 5), (0.9, 5), (1.9, 5), (2.1, 0)])
def test_slow_poses_are_interpolated_between_unless_too_slow(period_s, scans):
    own = period_s * np.arange(20)
    own[10:] += 0.8 - period_s if period_s == 0.1 else 0.0  # a gap in quick ones
    asked = own[9] + (0.8 if period_s == 0.1 else period_s) * np.linspace(0.1, 0.9, 5)
    _, known = interpolate(replace(poses(20), stamp_s=own), asked)
    assert known.sum() == scans


def test_the_mount_is_tf_unless_settings_say_otherwise(bag, tmp_path):
    T_base_arm, T_arm_tof = T_of((1, 2, 3), (0.1, 0.2, 0.3)), T_of((0, 0, 1), (0, 0, 1))
    bag.clouds().odometry().tf("base_link", "arm", T_base_arm).tf("tof", "arm", np.linalg.inv(T_arm_tof))
    path = bag.write()
    np.testing.assert_allclose(read_flight(path).T_drone_sensor, T_base_arm @ T_arm_tof, atol=1e-14)
    (tmp_path / "s.toml").write_text("[extrinsics]\ntranslation_m = [1, 2, 3]\nrotation_rpy_deg = [0, 0, 90]\n")
    flight = read_flight(path, settings=tmp_path / "s.toml")
    np.testing.assert_allclose(flight.T_drone_sensor, T_of((1, 2, 3), (0, 0, np.pi / 2)), atol=1e-15)
    assert flight.facts["extrinsics"].startswith("settings ")


def test_only_a_transform_that_never_moves_is_a_mount(bag1, tmp_path):
    bag1.clouds().odometry()
    for stamp in STAMPS:
        bag1.tf("base_link", "tof", T_of((stamp, 0, 0)), stamp, "/tf")
    flight = read_flight(bag1.write())
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))
    assert flight.facts["extrinsics"].startswith("none")
    again = Bagged(tmp_path / "again.bag").clouds().odometry()
    for k, stamp in enumerate(STAMPS):
        again.tf("base_link", "tof", T_of((1, 2, 3), (0.1, 0.2, 0.3)), stamp, "/tf")
        turn = again.rows[-1][3].transforms[0].transform.rotation
        if k % 2:  # the same rotation
            turn.x, turn.y, turn.z, turn.w = -turn.x, -turn.y, -turn.z, -turn.w
    T = read_flight(again.write()).T_drone_sensor
    np.testing.assert_allclose(T, T_of((1, 2, 3), (0.1, 0.2, 0.3)), atol=1e-14)


def test_poses_from_tf_where_no_topic_has_them(bag):
    """map → odom jumps once; odom is preferred since it does not."""
    trajectory = poses(9, 0.1)
    bag.clouds().tf("base_link", "tof", T_of((1, 0, 0)))
    for stamp, T in zip(trajectory.stamp_s, trajectory.T_world_drone, strict=True):
        bag.tf("odom", "base_link", T, stamp, "/tf").tf("map", "odom", T_of((stamp > 0.4, 0, 0)), stamp, "/tf")
    flight = read_flight(bag.write())
    np.testing.assert_allclose(flight.prior.T_world_drone, trajectory.T_world_drone[::2], atol=1e-14)
    assert flight.facts["poses"].startswith("tf odom → base_link")
    np.testing.assert_allclose(flight.T_drone_sensor, T_of((1, 0, 0)), atol=1e-14)


def test_poses_from_tf_through_two_that_move(bag1):
    bag1.clouds()
    for stamp in np.arange(0, 1, 0.1):
        bag1.tf("root", "base_link", T_of((stamp, 0, 0)), stamp, "/tf")
    for stamp in (0.0, 0.5):
        bag1.tf("world", "root", T_of((0, 10 * stamp, 0)), stamp, "/tf")
    prior = read_flight(bag1.write()).prior
    np.testing.assert_allclose(prior.stamp_s, [0, 0.2, 0.4])  # as far as both are known
    np.testing.assert_allclose(prior.position, np.outer(prior.stamp_s, (1, 10, 0)), atol=1e-12)


def test_a_camera_frame_is_turned_to_the_drones_axes(bag1, tmp_path):
    """Poses and points of a camera's frame that looks ahead; and a camera on a drone, by tf."""
    ahead = np.linalg.inv(T_OPTICAL_SENSOR)  # world ← optical
    trajectory = replace(poses(5), T_world_drone=np.tile(ahead, (5, 1, 1)))
    bag1.clouds(frame="cam_optical_frame").odometry(trajectory=trajectory, child="cam_optical_frame")
    flight = read_flight(bag1.write())
    np.testing.assert_allclose(flight.prior.T_world_drone, np.tile(np.eye(4), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(flight.T_drone_sensor, np.eye(4), atol=1e-14)
    expected = np.stack([POINTS[..., 2], -POINTS[..., 0], -POINTS[..., 1]], axis=-1)
    np.testing.assert_array_equal(flight.scans[0].points, expected)
    T_base_camera = T_of((1, 0, 0)) @ ahead
    other = Bagged(tmp_path / "b.bag").clouds(frame="cam_optical_frame").odometry()
    flight = read_flight(other.tf("base_link", "cam_optical_frame", T_base_camera).write())
    np.testing.assert_allclose(flight.T_drone_sensor, T_of((1, 0, 0)), atol=1e-14)


def test_imu_samples_at_the_end_of_the_range_are_left_out(bag):
    make = bag.clouds().odometry().make
    for k in range(40):
        force = np.array(
            [0.1 * k, 0.0, min(9.8 + 3.0 * abs(np.sin(0.5 * k)) * (k > 9), 12.0)]
        )  # 12 m/s²: no range ends
        rate = np.array([0.0, np.clip(6.0 * np.sin(0.3 * k), -4.36, 4.36), 0.0])  # ±250°/s
        bag.rows.append(("/imu", IMU, 0.01 * k, make.imu(ns(0.01 * k), force, rate)))
    flight = read_flight(bag.write())
    full = np.abs(6.0 * np.sin(0.3 * np.arange(40))) > 4.36
    assert full.sum() > 10
    assert flight.skipped["IMU sample saturated"] == full.sum()
    np.testing.assert_allclose(flight.imu.stamp_s, 0.01 * np.flatnonzero(~full))


def test_imu_samples_are_turned_to_the_drone(bag):
    make = bag.clouds().odometry().tf("base_link", "imu", T_of((0, 0, 0), (0, 0, np.pi / 2))).make
    for stamp, x in ((0.0, 1.0), (0.1, 1.0), (0.1, 1.0), (0.2, np.nan)):
        message = make.imu(ns(stamp), np.array([x, 0, 9.8]), np.array([0, 2.0, 0]))
        message.header.frame_id = "imu"
        bag.rows.append(("/imu", IMU, stamp, message))
    flight = read_flight(bag.write())
    np.testing.assert_array_equal(flight.imu.stamp_s, [0.0, 0.1])
    np.testing.assert_allclose(flight.imu.specific_force[0], [0, 1, 9.8], atol=1e-12)
    np.testing.assert_allclose(flight.imu.angular_rate[0], [-2, 0, 0], atol=1e-12)
    assert flight.skipped == {"IMU sample not finite": 1, "IMU sample: duplicate stamp": 1}


@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "<u2", 1000), ("32FC1", "<f4", 1)])
def test_depth_images_are_scans_where_there_are_no_clouds(bag, encoding, kind, unit):
    depth_m = np.array([[1.0, 2.0, 0.0], [0.5, 4.0, 3.0]])
    bag.images("/depth/image_raw", (depth_m * unit).astype(kind), encoding).camera().odometry()
    flight = read_flight(bag.write())
    points = flight.scans[0].points
    assert points.shape == (2, 3, 3)
    assert np.isnan(points[0, 2]).all()
    # x is the depth; fx 2, fy 4, cx 1, cy 0.5
    np.testing.assert_allclose(points[0, 0], (1, 1 * (1 - 0) / 2, 1 * 0.5 / 4))
    np.testing.assert_allclose(points[1, 2], (3, 3 * (1 - 2) / 2, 3 * (0.5 - 1) / 4))
    assert flight.facts["intrinsics"] == "/depth/camera_info"


def test_depth_images_need_intrinsics_of_their_size(tmp_path):
    depth = np.ones((2, 3), "<u2")
    path = Bagged(tmp_path / "a.bag").images("/depth/image_raw", depth, "16UC1").odometry().write()
    with pytest.raises(InputError, match=r"no intrinsics for the depth images /depth/image_raw"):
        read_flight(path)
    (tmp_path / "s.toml").write_text("[intrinsics]\nfx = 2\nfy = 2\ncx = 1\ncy = 1\ndepth_scale = 0.5\n")
    np.testing.assert_array_equal(read_flight(path, settings=tmp_path / "s.toml").scans[0].points[..., 0], 0.5)
    bad = Bagged(tmp_path / "b.bag").images("/depth/image_raw", depth, "16UC1").odometry().camera(fx=0.0).write()
    with pytest.raises(InputError, match="no intrinsics"):
        read_flight(bad)
    other = Bagged(tmp_path / "c.bag").images("/depth/image", depth, "16UC1").camera().odometry()
    other.images("/depth/image", np.ones((4, 3), "<u2"), "16UC1", stamps=[0.7])
    scans = list(read_flight(other.clouds().write(), scans="/depth/image").scans)  # clouds are preferred
    assert [scan.points.size for scan in scans] == [18, 18, 18, 18, 0, 18]
    assert scans[4].fault == "unreadable scan: 3 × 4 pixels; expected 3 × 2"


def test_stamps_that_repeat_or_run_backwards_are_left_out(bag1):
    bag1.odometry(trajectory=poses(10)).clouds(stamps=[0.0, 0.2, 0.2, 0.6, 0.4, 0.5, 0.8])
    flight = read_flight(bag1.write(in_order=False))
    assert [scan.stamp_s for scan in flight.scans] == [0.0, 0.2, 0.6, 0.8]
    assert flight.skipped == {"duplicate stamp": 1, "time ran backwards": 2}


def test_bad_scans_say_why_and_stay_in_step(bag):
    rows = bag.clouds().odometry().rows
    faults = (
        lambda m: setattr(m, "point_step", 4),
        lambda m: setattr(m, "width", 0),
        lambda m: setattr(m, "data", np.frombuffer(b"\xff" * len(m.data), np.uint8)),
        lambda m: setattr(m, "data", np.zeros(len(m.data), np.uint8)),
    )
    for k, spoil in enumerate(faults):
        spoil(rows[k + 1][3])
    flight = read_flight(bag.write())
    for _ in range(2):
        scans = list(flight.scans)
        assert [scan.stamp_s for scan in scans] == STAMPS.tolist()
        assert [scan.points.shape for scan in scans] == [(4, 5, 3)] + [(0, 3)] * 4
        assert [scan.fault for scan in scans] == [
            "", "unreadable scan: point_step 4; expected at least 12, where its fields end", "empty cloud",
            "no finite point", "no finite point",
        ]  # fmt: skip
    assert flight.skipped == {}


def test_points_at_the_sensor_are_no_return(bag1):
    points = POINTS.copy()
    points[1, 2] = points[3, 3] = 0.0
    points[0, 1, 0] = 0.0  # a point beside the sensor, not at it
    scan = read_flight(bag1.clouds(points=points).odometry().write()).scans[0].points
    assert np.argwhere(np.isnan(scan).all(axis=-1)).tolist() == [[1, 2], [3, 3]]
    np.testing.assert_array_equal(scan[0, 1], points[0, 1])


def test_bad_poses_and_messages_cut_short_are_counted(bag1):
    bag1.clouds().odometry(trajectory=poses(8))
    messages = [message for _, kind, _, message in bag1.rows if kind == ODOMETRY]
    messages[1].pose.pose.position.x = np.nan
    turn = messages[2].pose.pose.orientation
    turn.x = turn.y = turn.z = turn.w = 0.0
    turn = messages[3].pose.pose.orientation
    turn.x, turn.y, turn.z, turn.w = 7 * turn.x, 7 * turn.y, 7 * turn.z, 7 * turn.w
    messages[5].header.stamp = messages[4].header.stamp
    bag1.rows += [("/odom", ODOMETRY, 2.0, b"short"), ("/points", CLOUD, 2.0, b"tiny"), ("/imu", IMU, 2.0, b"no")]
    flight = read_flight(bag1.write(), gap_max_s=1.0)
    np.testing.assert_allclose(flight.prior.T_world_drone[3], poses(8).T_world_drone[3], atol=1e-14)
    assert flight.skipped == {
        "malformed Odometry": 1, "malformed PointCloud2": 1, "malformed Imu": 1, "stamp not finite": 1,
        "pose not finite": 1, "pose with a quaternion of length zero": 1, "pose with a stamp that another has": 1,
    }  # fmt: skip
    assert len(list(flight.scans)) == 5


def test_stamps_of_zero_give_way_to_when_messages_were_received(bag1):
    bag1.clouds().odometry()
    for _, kind, _, message in bag1.rows:
        if kind == CLOUD:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    np.testing.assert_array_equal(read_flight(bag1.write()).prior.stamp_s, STAMPS)


def test_poses_that_do_not_cover_the_scans(bag1):
    late = replace(poses(5), stamp_s=poses(5).stamp_s + 100.0)
    path = bag1.clouds().odometry(trajectory=late).write()
    with pytest.raises(InputError, match=r"no pose at any scan: 0.000 to 0.800 s of scans, 100.000 to 100.800 s"):
        read_flight(path)


def test_paths_that_are_no_recordings(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"gone.bag: does not exist; expected a recording"):
        read_flight(tmp_path / "gone.bag")
    (tmp_path / "a.xyz").touch()
    with pytest.raises(InputError, match=r"ending '.xyz'; expected"):
        read_truth(tmp_path / "a.xyz")

    def refused(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(InputError, match="cannot be read: Permission denied; expected a recording"):
        read_flight(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[extrinsics]\nshift = 1", "extrinsics.shift"),
        ("[extrinsics]\ntranslation_m = [1, 2]", "translation_m"),
        ("[intrinsics]\nfx = 0\nfy = 1\ncx = 1\ncy = 1", "intrinsics.fx"),
        ("[extrinsics]\ntranslation_m = [nan, 0, 0]", "translation_m"),
        ("[extrinsics]\nrotation_rpy_deg = [1e300, 0, 0]", "rotation_rpy_deg"),
        ("[more]\n", "more"),
    ],
)
def test_bad_settings_are_refused(bag1, tmp_path, text, says):
    (tmp_path / "s.toml").write_text(text)
    path = bag1.clouds().odometry().write()
    with pytest.raises(SteelnbError, match=says) as caught:
        read_flight(path, settings=tmp_path / "s.toml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "no yaml: [", "rosbag2_bagfile_information: {}", "a: 1"])
def test_bad_metadata_is_refused(tmp_path, text):
    (tmp_path / "bag").mkdir()
    Bagged(tmp_path / "a.mcap").clouds().odometry().write().rename(tmp_path / "bag" / "a.mcap")
    assert len(read_flight(tmp_path / "bag")) == 5
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match="bag"):
        read_flight(tmp_path / "bag")
