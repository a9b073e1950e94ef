"""Folders of clouds: which files are scans, what orders them, and where their stamps and poses are from."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.io import write_tum
from steelnb.io.folders import Recorded, open_folder
from steelnb.settings import RecordingOptions, read_options
from tests.io.samples import poses

COUNT, BEGIN_S = 12, 1.7e9
POSES = poses(COUNT, 0.1, BEGIN_S)
MORE = poses(2 * COUNT, 0.05, BEGIN_S)


def cloud(k: int) -> np.ndarray:
    return np.arange(12.0).reshape(4, 3) + k + 1


def make(folder: Path, name: Callable[[int], str], trajectory: Trajectory = POSES) -> Path:
    """Clouds ``name(k).npy``, of which the k-th has `cloud` k, and poses."""
    for k in range(COUNT):
        np.save(folder / f"{name(k)}.npy", cloud(k))
    write_tum(folder / "poses.tum", trajectory)
    return folder


def opened(folder: Path, **stated: object) -> Recorded:
    return open_folder(folder, read_options(folder, **stated))


def assert_in_order(found: Recorded, stamp_s: np.ndarray = POSES.stamp_s, scale: float = 1.0) -> None:
    np.testing.assert_allclose(found.stamp_s, stamp_s, rtol=0, atol=1e-6)
    for k, decode in enumerate(found.walk(np.arange(len(found.stamp_s)))):
        np.testing.assert_allclose(decode(), scale * cloud(k))


def ns(k: int) -> int:
    return int(BEGIN_S) * 10**9 + k * 10**8


@pytest.mark.parametrize("trajectory", [POSES, MORE], ids=["a pose each", "more poses"])
@pytest.mark.parametrize(
    ("name", "stated"),
    [
        (lambda k: f"{BEGIN_S + k / 10:.6f}", {}),
        (lambda k: f"lidar1_{BEGIN_S + k / 10:.1f}_v2", {}),
        (lambda k: f"{k}_{BEGIN_S + k / 10:.3f}", {}),
        (lambda k: f"{ns(k)}", {}),
        (lambda k: f"{k:04d}_{ns(k)}", {}),
        (lambda k: f"{ns(k) // 1000}", {"stamps": "us"}),
        (lambda k: f"{ns(k) // 10**6}", {"stamps": "ms"}),
        (lambda k: f"a{k}", {"stamps": "stamps.txt"}),
        (lambda k: f"{ns(k) // 10**9}_{ns(k) % 10**9:09d}", {"stamps": "stamps.txt"}),
    ],
)
def test_stamps_are_in_the_names_or_stated(name, stated, trajectory, tmp_path: Path) -> None:
    (tmp_path / "stamps.txt").write_text("\n".join(f"{stamp:.6f}" for stamp in POSES.stamp_s))
    if "stamps.txt" not in stated.values():
        (tmp_path / "stamps.txt").unlink()
    found = opened(make(tmp_path, name, trajectory), **stated)
    assert_in_order(found)
    np.testing.assert_allclose(found.prior.stamp_s, trajectory.stamp_s)
    np.testing.assert_array_equal(found.T_drone_sensor, np.eye(4))
    assert {"scans", "poses", "mount"} <= found.facts.keys()


@pytest.mark.parametrize(
    "name",
    [
        lambda k: f"{k}",
        lambda k: f"frame_{k:04d}",
        lambda k: f"{ns(k) // 10**9}_{ns(k) % 10**9:09d}",
        lambda k: f"{ns(k) // 10**6}",
        lambda k: f"v1.2_{k}",
    ],
)
def test_numbers_without_a_unit_are_an_order_of_one_pose_each(name, tmp_path: Path) -> None:
    assert_in_order(opened(make(tmp_path, name)))
    assert_in_order(opened(tmp_path, stamps="in-order"), np.arange(COUNT))
    write_tum(tmp_path / "poses.tum", MORE)
    for stated in ({}, {"stamps": "in-order"}):
        with pytest.raises(InputError, match="--stamps"):
            opened(tmp_path, **stated)


def test_stated_stamps_hold_for_whole_numbers_of_both_files(tmp_path: Path) -> None:
    make(tmp_path, lambda k: f"{1_200_000_000 + k * 100_000}")
    since_boot = poses(COUNT, 0.1, 1200.0)
    numbers = np.column_stack([1_200_000_000 + 100_000 * np.arange(COUNT), np.loadtxt(tmp_path / "poses.tum")[:, 1:]])
    np.savetxt(tmp_path / "poses.tum", numbers, fmt="%d" + " %.17g" * 7)
    found = opened(tmp_path, stamps="us")
    assert_in_order(found, since_boot.stamp_s)
    np.testing.assert_allclose(found.prior.stamp_s, since_boot.stamp_s)


def test_options_beside_the_data_hold_and_defaults_change_nothing(tmp_path: Path) -> None:
    plain = opened(make(tmp_path, str))
    stated = opened(tmp_path, unit="m", quaternion="xyzw", poses="poses.tum", scans=".")
    np.testing.assert_array_equal(stated.stamp_s, plain.stamp_s)
    np.testing.assert_array_equal(stated.prior.T_world_drone, plain.prior.T_world_drone)
    (tmp_path / "recording.toml").write_text('unit = "cm"\n')
    assert_in_order(opened(tmp_path), scale=0.01)
    assert_in_order(opened(tmp_path, unit="mm"), scale=0.001)


@pytest.mark.parametrize("shift_s", [-1e6, 0.5, 3600.0])
def test_a_shift_of_the_clock_shifts_both(shift_s: float, tmp_path: Path) -> None:
    later = Trajectory(POSES.stamp_s + shift_s, POSES.T_world_drone)
    found = opened(make(tmp_path, lambda k: f"{BEGIN_S + k / 10 + shift_s:.3f}", later))
    assert_in_order(found, POSES.stamp_s + shift_s)
    np.testing.assert_allclose(found.prior.stamp_s - shift_s, POSES.stamp_s, atol=1e-6)


def test_files_beside_the_scans_are_none_of_them(tmp_path: Path) -> None:
    make(tmp_path, lambda k: f"{k:03d}")
    for name in ("map.npy", "floor.ply"):
        np.save(tmp_path / name, cloud(99))
    np.savetxt(tmp_path / ".001.npy", cloud(0))
    for name in ("groundtruth.tum", "groundtruth.txt", "times.txt", "calib.txt"):
        (tmp_path / name).write_text("1 2 3\n")
    found = opened(tmp_path)
    assert_in_order(found)
    assert "map.npy" in found.facts["scans"]


def test_several_trajectories_are_listed_until_one_is_named(tmp_path: Path) -> None:
    make(tmp_path, str)
    write_tum(tmp_path / "other.txt", MORE)
    with pytest.raises(InputError, match=r"other\.txt, poses\.tum.*--poses"):
        opened(tmp_path)
    assert_in_order(opened(tmp_path, poses="poses.tum"))
    (tmp_path / "other.txt").unlink()
    (tmp_path / "poses.tum").unlink()
    with pytest.raises(InputError, match=r"no trajectory.*--poses"):
        opened(tmp_path)
    with pytest.raises(InputError, match="missing"):
        opened(tmp_path, poses="missing.tum")


def test_text_files_are_scans_if_there_are_no_others(tmp_path: Path) -> None:
    for k in range(COUNT):
        np.savetxt(tmp_path / f"{k}.txt", np.column_stack([cloud(k), np.ones(4)]))
    write_tum(tmp_path / "poses.tum", POSES)
    with pytest.raises(InputError, match="--columns"):
        next(opened(tmp_path).walk(np.arange(1)))()
    assert_in_order(opened(tmp_path, columns=("x", "y", "z", "_")))


def test_columns_of_the_trajectory_are_not_those_of_the_clouds(tmp_path: Path) -> None:
    make(tmp_path, str)
    rows = np.loadtxt(tmp_path / "poses.tum")[:, [1, 2, 3, 7, 4, 5, 6]]
    (tmp_path / "poses.tum").unlink()
    np.savetxt(tmp_path / "pose.txt", rows)
    with pytest.raises(InputError, match="--columns"):
        opened(tmp_path)
    found = opened(tmp_path, columns=("x", "y", "z", "qw", "qx", "qy", "qz"), stamps="in-order")
    assert_in_order(found, np.arange(COUNT))
    np.testing.assert_allclose(found.prior.T_world_drone, POSES.T_world_drone, atol=1e-9)


def test_a_folder_of_kitti_keeps_its_poses_unless_calib_is_stated(tmp_path: Path) -> None:
    make(tmp_path, lambda k: f"{k:06d}")
    (tmp_path / "poses.tum").unlink()
    np.savetxt(tmp_path / "poses.txt", POSES.T_world_drone[:, :3].reshape(-1, 12))
    np.savetxt(tmp_path / "times.txt", np.arange(COUNT) / 10)
    (tmp_path / "calib.txt").write_text("P0: 1\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    plain = opened(tmp_path)
    assert_in_order(plain, np.arange(COUNT) / 10)
    np.testing.assert_allclose(plain.prior.T_world_drone, POSES.T_world_drone, atol=1e-9)
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    turned = opened(tmp_path, calib="calib.txt").prior.T_world_drone
    np.testing.assert_allclose(turned, Tr.T @ POSES.T_world_drone @ Tr, atol=1e-9)


@pytest.mark.parametrize(
    ("names", "stated", "says"),
    [
        (["left_1", "right_1"], {}, "--scans"),
        (["a", "b"], {}, "--scans"),
        (["1_2", "2_3"], {"stamps": "ms"}, "--stamps FILE"),
        ([], {}, "expected files .*npy"),
        (["1", "2"], {"scans": "velodyne"}, "--scans"),
        (["1", "2"], {"stamps": "stamps.txt"}, "stamps.txt"),
    ],
)
def test_what_has_no_order_is_refused(names: list[str], stated: dict, says: str, tmp_path: Path) -> None:
    for name in names:
        np.save(tmp_path / f"{name}.npy", cloud(0))
    write_tum(tmp_path / "poses.tum", POSES)
    with pytest.raises(InputError, match=says):
        opened(tmp_path, **stated)


def test_clouds_in_a_folder_below_are_named(tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    make(tmp_path / "velodyne", str)
    (tmp_path / "velodyne" / "poses.tum").rename(tmp_path / "poses.tum")
    with pytest.raises(InputError, match="--scans velodyne"):
        opened(tmp_path)
    assert_in_order(open_folder(tmp_path, RecordingOptions(scans="velodyne")))
