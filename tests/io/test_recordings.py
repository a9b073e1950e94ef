"""Recordings: what the user states about bags and folders alike, and what the facts say."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Flight, Trajectory
from steelnb.io import read_flight, read_truth, write_flight, write_tum
from steelnb.settings import RecordingOptions

from .samples import POINTS, STAMPS, Bagged, T_of, made_up, ns, poses
from .test_bags import same

DOWN = np.diag([1.0, -1, -1, 1])
"""Between axes with z up and those with z down."""


@pytest.fixture
def one(tmp_path: Path) -> Bagged:
    return Bagged(tmp_path / "a.mcap")


def folder_of(path: Path, clouds: list[Array], prior: Trajectory) -> Path:
    """A folder of clouds with their stamps in names, and a TUM file."""
    path.mkdir()
    for stamp_s, points in zip(prior.stamp_s, clouds, strict=True):
        np.save(path / f"{100 + stamp_s:.3f}.npy", points)
    write_tum(path / "poses.tum", Trajectory(prior.stamp_s + 100, prior.T_world_drone))
    return path


def bag_of(path: Path, clouds: list[Array], prior: Trajectory) -> Path:
    """The same as a bag, whose scans are in a frame that tf puts in the drone's."""
    bag = Bagged(path / "a.mcap").odometry("/odom", prior).tf("base_link", "tof", np.eye(4))
    for stamp_s, points in zip(prior.stamp_s, clouds, strict=True):
        bag.clouds(stamps=[stamp_s], points=points)
    return bag.write()


def in_world(flight: Flight) -> list[Array]:
    T = flight.prior.T_world_drone @ flight.T_drone_sensor
    return [transform_points(each, scan.points) for each, scan in zip(T, flight.scans, strict=True)]


def test_a_shift_of_the_clock_is_undone_by_its_offset_or_by_the_times_of_recording(one: Bagged) -> None:
    path = poses(len(STAMPS))
    one.clouds().odometry("/odom", path).tf("base_link", "tof", np.eye(4))
    right = read_flight(one.write())
    late = Bagged(one.path.with_name("late.mcap")).clouds().odometry("/odom", path).tf("base_link", "tof", np.eye(4))
    for topic, _, stamp, message in late.rows:
        if topic == "/points":
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns(stamp) + 7 * 10**9, 10**9)
    late.write()
    with pytest.raises(InputError, match="--time-offset"):
        read_flight(late.path)
    same(read_flight(late.path, time_offset=-7.0), right)
    same(read_flight(late.path, clock="bag"), right)
    assert "-7000" in read_flight(late.path, time_offset=-7.0).facts["clock"]


def test_options_stand_in_a_file_beside_the_recording_and_those_of_a_call_win(one: Bagged) -> None:
    one.clouds().clouds("/other", points=POINTS + 1).odometry().tf("base_link", "tof", np.eye(4)).write()
    (one.path.parent / "recording.toml").write_text('scans = "/other"\nmount = [0, 0, 2, 0, 0, 0]\n')
    flight = read_flight(one.path)
    assert "/other" in flight.facts["scans"]
    assert flight.T_drone_sensor[2, 3] == 2
    assert "/points" in read_flight(one.path, scans="/points").facts["scans"]
    (one.path.parent / "recording.toml").write_text("scanz = 1\n")
    with pytest.raises(InputError, match=r"recording\.toml.*scanz"):
        read_flight(one.path)


def test_poses_with_z_down_are_turned_if_it_is_stated_or_named(one: Bagged) -> None:
    down, path = np.diag([1.0, -1, -1, 1]), poses(len(STAMPS))
    ned = Trajectory(path.stamp_s, down @ path.T_world_drone @ down)
    one.clouds().odometry("/odom", ned).tf("base_link", "tof", np.eye(4)).write()
    stated = read_flight(one.path, world="ned").prior.T_world_drone
    np.testing.assert_allclose(stated, path.T_world_drone, atol=1e-12)
    other = Bagged(one.path.with_name("b.mcap")).clouds().tf("base_link", "tof", np.eye(4))
    other.odometry("/odom", Trajectory(path.stamp_s, down @ path.T_world_drone), frame="map_ned").write()
    np.testing.assert_allclose(read_flight(other.path).prior.T_world_drone, path.T_world_drone, atol=1e-12)


def test_a_plain_bag_is_opened_once_and_enters_few_files(tmp_path: Path) -> None:
    flight = made_up(20)
    write_flight(tmp_path / "a.bag", flight)
    entered, opened = set[str](), []

    def profile(frame, event, _):  # type: ignore[no-untyped-def]
        if event == "call":
            name = frame.f_code.co_filename
            if "/steelnb/io/" in name and frame.f_code.co_name != "<module>":
                entered.add(name)

    sys.addaudithook(lambda event, values: opened.append(values[0]) if event == "open" else None)
    sys.setprofile(profile)
    try:
        assert len(list(read_flight(tmp_path / "a.bag").scans)) == 20
    finally:
        sys.setprofile(None)
    assert len(entered) <= 8
    assert [str(name) for name in opened].count(str(tmp_path / "a.bag")) == 1


@pytest.mark.parametrize("make", [folder_of, bag_of])
@pytest.mark.parametrize("world", ["enu", "ned"])
@pytest.mark.parametrize("mount", [None, (0.1, 0, 0.2, 0, 0, 90)])
def test_scans_that_are_in_the_world_stay_where_they_are(tmp_path: Path, make, world, mount) -> None:  # type: ignore[no-untyped-def]
    prior, points = poses(len(STAMPS)), POINTS.reshape(-1, 3)
    path = (
        make(tmp_path / "a", [points] * len(STAMPS), prior)
        if make is folder_of
        else make(tmp_path, [points.astype(np.float32)] * len(STAMPS), prior)
    )
    flight = read_flight(path, scans_in="world", world=world, mount=mount)
    for found in in_world(flight):
        np.testing.assert_allclose(found, points @ DOWN[:3, :3] if world == "ned" else points, atol=1e-9)
    if mount:
        np.testing.assert_allclose(flight.T_drone_sensor, T_of(mount[:3], (0, 0, np.pi / 2)), atol=1e-12)
    assert "stated" in flight.facts["frames"]


def test_points_in_a_world_with_z_down_are_turned_with_it(one: Bagged) -> None:
    path = one.odometry("/odom", poses(len(STAMPS))).clouds(frame="odom").write()
    for found in in_world(read_flight(path, world="ned")):
        np.testing.assert_allclose(found, POINTS @ DOWN[:3, :3], atol=1e-9)


def test_files_are_named_from_here_or_from_the_folder_of_the_recording(one: Bagged) -> None:
    path, other = poses(len(STAMPS)), poses(len(STAMPS), seed=5)
    one.clouds().odometry("/odom", path).tf("base_link", "tof", np.eye(4)).write()
    write_tum(one.path.with_name("other.tum"), other)
    (one.path.parent / "recording.toml").write_text('poses = "other.tum"\ntruth = "other.tum"\n')
    assert read_truth(one.path) is not None
    np.testing.assert_allclose(read_flight(one.path).prior.T_world_drone, other.T_world_drone, atol=1e-12)
    stated = RecordingOptions(mount=(0, 0, 1, 0, 0, 0))  # what it does not say is still the file's
    np.testing.assert_allclose(read_flight(one.path, stated).prior.T_world_drone, other.T_world_drone, atol=1e-12)
    both = read_flight(one.path, stated, poses="/odom")
    np.testing.assert_allclose(both.prior.T_world_drone, path.T_world_drone, atol=1e-12)
    assert both.T_drone_sensor[2, 3] == 1


@settings(max_examples=10, deadline=None)
@given(shift=st.integers(-(10**6), 10**6), unit=st.sampled_from(["mm", "0.5cm", "ft"]))
def test_clock_and_unit_scale_and_shift_what_is_read(
    tmp_path_factory: pytest.TempPathFactory, shift: int, unit: str
) -> None:
    prior, metres = poses(len(STAMPS)), {"mm": 1e-3, "0.5cm": 5e-3, "ft": 0.3048}[unit]
    clouds = [POINTS.reshape(-1, 3)] * len(STAMPS)
    early = Trajectory(prior.stamp_s + shift / 8, prior.T_world_drone)
    folder = folder_of(tmp_path_factory.mktemp("x") / "a", clouds, prior)
    write_tum(folder / "poses.tum", Trajectory(early.stamp_s + 100, early.T_world_drone))
    flight = read_flight(folder, time_offset=shift / 8, unit=unit)
    np.testing.assert_allclose(flight.prior.stamp_s, early.stamp_s + 100)
    np.testing.assert_allclose(flight.prior.T_world_drone, prior.T_world_drone, atol=1e-6)
    for scan in flight.scans:
        np.testing.assert_allclose(scan.points, clouds[0] * metres)


def test_a_mount_that_differs_from_tf_by_more_than_ten_of_its_sigmas_is_refused(one: Bagged) -> None:
    path = one.clouds().odometry().tf("base_link", "tof", T_of((0, 0, 1))).write()
    lower, sigma = {"mount": (0, 0, 0.8, 0, 0, 0)}, {"mount_sigma": (1.0, 0.01)}
    assert read_flight(path, **lower).T_drone_sensor[2, 3] == pytest.approx(0.8)
    with pytest.raises(InputError, match=r"--mount is 0.0° and 0.200 m from that of tf.*--mount-sigma 1,0.01"):
        read_flight(path, **lower, **sigma)
    with pytest.raises(InputError, match=r"--mount is 20.0° and 0.000 m"):
        read_flight(path, mount=(0, 0, 1, 0, 20, 0), **sigma)
    for other in ({"mount": (0, 0, 0.95, 0, 5, 0)}, {}):
        read_flight(path, **other, **sigma)


@pytest.mark.parametrize("option", [{"imu": "/imu"}, {"clock": "bag"}])
def test_a_folder_refuses_what_only_a_bag_has(tmp_path: Path, option: dict[str, str]) -> None:
    folder = folder_of(tmp_path / "a", [POINTS] * len(STAMPS), poses(len(STAMPS)))
    with pytest.raises(InputError, match=f"--{next(iter(option))}"):
        read_flight(folder, **option)


def test_the_facts_say_what_was_taken_from_where(one: Bagged) -> None:
    facts = read_flight(one.clouds().odometry().tf("base_link", "tof", T_of((0, 0, 1))).write()).facts
    assert {*facts} == {"scans", "poses", "frames", "clock", "mount", "imu"}
    assert "/points" in facts["scans"]
    assert "0.000 to 0.800 s" in facts["scans"]
    assert "/odom" in facts["poses"]
    assert "base_link → tof" in facts["frames"]
    assert "tf_static" in facts["mount"]
    assert read_flight(one.path, mount=(0, 0, 0, 0, 0, 0)).facts["mount"] == "as stated"
