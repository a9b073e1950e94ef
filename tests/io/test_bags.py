"""Bags: which topics, clocks and parts a flight is made of. Every message is a scan or a counted reason."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.core.types import Flight
from steelnb.io import read_flight, read_truth, write_flight
from steelnb.io.bags import is_bag
from steelnb.io.clouds import READERS
from steelnb.io.messages import ODOMETRY, POSE_COVARIANCE, POSE_STAMPED, TRANSFORM
from steelnb.io.trajectories import write_tum
from steelnb.settings import RecordingOptions

from .samples import KINDS, POINTS, STAMPS, Bagged, T_of, made_up, poses


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Bagged:
    return Bagged(tmp_path / request.param)


@pytest.fixture
def one(tmp_path: Path) -> Bagged:
    return Bagged(tmp_path / "a.mcap")


def same(one: Flight, other: Flight) -> None:
    np.testing.assert_allclose(one.prior.stamp_s, other.prior.stamp_s, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(one.prior.T_world_drone, other.prior.T_world_drone)
    np.testing.assert_array_equal(one.T_drone_sensor, other.T_drone_sensor)
    for a, b in zip(one.scans, other.scans, strict=True):
        np.testing.assert_array_equal(a.points, b.points)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_flight_comes_back_as_it_was_written(tmp_path: Path, name: str) -> None:
    flight, path = made_up(), tmp_path / name
    write_flight(path, flight, flight.prior)
    found = read_flight(path)
    np.testing.assert_allclose(found.prior.T_world_drone, flight.prior.T_world_drone, atol=1e-12)
    np.testing.assert_allclose(found.T_drone_sensor, flight.T_drone_sensor, atol=1e-12)
    for a, b in zip(found.scans, flight.scans, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
    assert found.imu is not None
    assert flight.imu is not None
    np.testing.assert_array_equal(found.imu.specific_force, flight.imu.specific_force)
    np.testing.assert_allclose(read_truth(path).T_world_drone, flight.prior.T_world_drone, atol=1e-12)
    assert found.skipped == {}
    same(read_flight(path, RecordingOptions()), found)
    same(read_flight(path, clock="header", world="enu", scans_in="sensor", time_offset=0.0, quaternion="xyzw"), found)


@pytest.mark.parametrize("kind", [ODOMETRY, POSE_STAMPED, POSE_COVARIANCE, TRANSFORM])
def test_scans_and_poses_are_found_by_type(bag: Bagged, kind: str) -> None:
    path = poses(len(STAMPS))
    found = read_flight(bag.clouds().odometry("/any", path, kind=kind).tf("base_link", "tof", T_of((0, 0, 1))).write())
    np.testing.assert_allclose(found.prior.T_world_drone, path.T_world_drone, atol=1e-12)
    np.testing.assert_array_equal(found.T_drone_sensor, T_of((0, 0, 1)))
    assert len(found.scans) == len(STAMPS)
    assert all((scan.points == POINTS).all() for scan in found.scans)


def test_poses_come_from_tf_if_no_topic_has_them_and_from_a_file_if_it_is_named(bag: Bagged, tmp_path: Path) -> None:
    path, other = poses(len(STAMPS)), poses(len(STAMPS), seed=5)
    bag.clouds().moving("odom", "base_link", path).tf("base_link", "tof", np.eye(4)).write()
    np.testing.assert_allclose(read_flight(bag.path).prior.T_world_drone, path.T_world_drone, atol=1e-12)
    write_tum(tmp_path / "other.tum", other)
    named = read_flight(bag.path, poses=str(tmp_path / "other.tum"))
    np.testing.assert_allclose(named.prior.T_world_drone, other.T_world_drone, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_topics_and_messages_does_not_matter(tmp_path_factory: pytest.TempPathFactory, random) -> None:
    made = []
    for name in ("sorted", "mixed"):
        bag = Bagged(tmp_path_factory.mktemp(name) / "a.mcap").clouds().odometry().imu(STAMPS, (0.0, 0, 9.8))
        bag.tf("base_link", "tof", T_of((0.1, 0, 0)))
        if name == "mixed":
            random.shuffle(bag.rows)
        made.append(read_flight(bag.write(in_order=name == "sorted")))
    same(*made)


@pytest.mark.parametrize("option", [{"scans": "/b"}, {"poses": "/b"}, {"imu": "/b"}])
def test_of_several_topics_one_is_named(one: Bagged, option: dict[str, str]) -> None:
    build = {"scans": one.clouds, "poses": one.odometry, "imu": lambda topic: one.imu(STAMPS, (0, 0, 9.8), topic=topic)}
    (role,) = option
    for name, make in build.items():
        for topic in ("/a", "/b") if name == role else (f"/{name}",):
            make(topic)
    one.tf("base_link", "tof", np.eye(4)).write()
    with pytest.raises(InputError, match=rf"--{role} TOPIC\): /a .*, /b"):
        read_flight(one.path)
    assert "/b" in read_flight(one.path, **option).facts[role]
    with pytest.raises(InputError, match="/c"):
        read_flight(one.path, **{role: "/c"})


def test_an_imu_that_measures_a_part_is_none_and_none_can_be_asked_for(one: Bagged) -> None:
    one.clouds().odometry().tf("base_link", "tof", np.eye(4)).imu(STAMPS, (0, 0, 9.8))
    one.imu(STAMPS, (0, 0, 9.8), topic="/accelerometer")
    for row in one.rows:
        if row[0] == "/accelerometer":
            row[3].angular_velocity_covariance[0] = -1
    assert "/imu" in read_flight(one.write()).facts["imu"]
    assert read_flight(one.path, imu="none").imu is None


def test_an_imu_turns_with_its_frame_or_is_left_out_without_one(one: Bagged) -> None:
    T, force = T_of((0.1, 0, 0), (0.3, -0.2, 0.9)), np.array([1.0, 2, 3])
    one.clouds().odometry().tf("base_link", "tof", np.eye(4)).tf("base_link", "imu", T)
    imu = read_flight(one.imu(STAMPS, force, force[::-1], frame="imu").write()).imu
    assert imu is not None
    np.testing.assert_allclose(imu.specific_force, np.tile(T[:3, :3] @ force, (len(STAMPS), 1)))
    np.testing.assert_allclose(imu.angular_rate, np.tile(T[:3, :3] @ force[::-1], (len(STAMPS), 1)))
    other = Bagged(one.path.with_name("b.mcap")).clouds().odometry().tf("base_link", "tof", np.eye(4))
    assert read_flight(other.imu(STAMPS, force, frame="elsewhere").write()).imu is None


@settings(max_examples=20, deadline=None)
@given(st.lists(st.sampled_from(["whole", "cut", "repeated", "early", "no x"]), min_size=2, max_size=8))
def test_every_message_is_a_scan_or_a_counted_reason(
    tmp_path_factory: pytest.TempPathFactory, kinds: list[str]
) -> None:
    kinds = ["whole", *kinds]
    bag = Bagged(tmp_path_factory.mktemp("x") / "a.mcap")
    stamps = 0.2 * np.arange(len(kinds)) + 10
    for k, kind in enumerate(kinds):
        bag.clouds(stamps=[{"repeated": stamps[0], "early": stamps[k] - 9}.get(kind, stamps[k])])
        if kind == "cut":
            bag.rows[-1][3].data = bag.rows[-1][3].data[:-20]
        if kind == "no x":
            bag.rows[-1][3].fields[0].name = "a"
    path = poses(len(kinds) + 10, begin_s=9.0)
    flight = read_flight(bag.odometry("/odom", path).tf("base_link", "tof", np.eye(4), 10.0).write())
    assert len(flight.scans) + sum(flight.skipped.values()) == len(kinds)
    assert sum(bool(scan.fault) for scan in flight.scans) == sum(kind in ("cut", "no x") for kind in kinds)


def test_an_undecodable_message_costs_only_itself(bag: Bagged) -> None:
    bag.clouds().odometry().tf("base_link", "tof", np.eye(4))
    for topic in ("/points", "/odom"):
        at = [k for k, row in enumerate(bag.rows) if row[0] == topic][2]
        bag.rows[at] = (*bag.rows[at][:3], b"\x00\x01\x00\x00" + b"\xff" * 7)
    flight = read_flight(bag.write())
    assert len(flight.scans) == 4
    assert sum(flight.skipped.values()) == 2


def test_parts_of_a_recording_are_read_in_the_order_of_their_messages(tmp_path: Path) -> None:
    folder, whole = tmp_path / "parts", Bagged(tmp_path / "whole.mcap")
    folder.mkdir()
    path = poses(10)
    whole.clouds(stamps=path.stamp_s).odometry("/odom", path).tf("base_link", "tof", np.eye(4))
    for k, name in enumerate(("b", "a")):  # the first part has the last name
        part = Bagged(folder / f"{name}.mcap")
        part.rows = [row for row in whole.rows if (row[2] < 0.9) == (k == 0)]
        part.write()
        (folder / f"{name}.rows").rename(tmp_path / f"{name}.rows")
    same(read_flight(folder), read_flight(whole.write()))


@pytest.mark.parametrize("suffix", [*READERS, ".LAS", ".tum", ".yaml"])
def test_a_folder_with_clouds_and_a_bag_is_one_of_clouds(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "flight.mcap").touch()
    assert is_bag(tmp_path)
    (tmp_path / f"000000{suffix}").touch()
    assert is_bag(tmp_path) == (suffix in (".txt", ".csv", ".tum", ".yaml")), "poses and notes are no clouds"
    (tmp_path / "metadata.yaml").touch()
    assert is_bag(tmp_path)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_damaged_file_is_refused_with_what_may_repair_it(tmp_path: Path, suffix: str) -> None:
    path = Bagged(tmp_path / f"a{suffix}").clouds().odometry().tf("base_link", "tof", np.eye(4)).write()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"reindex|recover"):
        list(read_flight(path).scans)
    path.write_bytes(b"")
    with pytest.raises(InputError):
        read_flight(path)


def test_a_bag_without_scans_or_poses_is_refused(one: Bagged) -> None:
    other, images = Bagged(one.path.with_name("b.mcap")), Bagged(one.path.with_name("c.mcap"))
    with pytest.raises(InputError, match="--scans"):
        read_flight(one.odometry().write())
    with pytest.raises(InputError, match="--poses"):
        read_flight(other.clouds().write())
    grey = np.full((4, 5), 7, np.uint16)
    images.images("/d/image", grey, "mono16").camera(size=(4, 5), topic="/d/camera_info").odometry()
    with pytest.raises(InputError, match="--scans"):
        read_flight(images.tf("base_link", "camera_optical_frame", np.eye(4)).write())
    assert len(read_flight(images.path, scans="/d/image").scans) == len(STAMPS)
    with pytest.raises(InputError, match="segment"):
        read_flight(one.path.with_suffix(".py") if one.path.with_suffix(".py").exists() else __file__)


def test_depth_images_are_scans_with_the_camera_beside_them(bag: Bagged) -> None:
    depth = np.full((2, 3), 2000, np.uint16)
    bag.images("/depth/image", depth, "16UC1").camera(size=(2, 3)).camera(topic="/colour/camera_info", size=(9, 9))
    bag.images("/colour/image", np.zeros((9, 9), np.uint8), "mono8").odometry()
    flight = read_flight(bag.tf("base_link", "camera_optical_frame", np.eye(4)).write())
    assert flight.scans[0].points.shape == (2, 3, 3)
    np.testing.assert_array_equal(flight.scans[0].points[..., 0], 2.0)  # x ahead
    np.testing.assert_array_equal(read_flight(bag.path, unit="0.5mm").scans[0].points[..., 0], 1.0)
    assert "16UC1" in flight.facts["scans"]
