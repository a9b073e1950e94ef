"""Trajectories are read as their names and options say: written poses come back, and the rest is refused."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.io.trajectories import (
    NOT_RISING,
    NOT_UNIT,
    TUM,
    interpolate,
    read_stamps,
    read_trajectory,
    trajectory_of,
    write_tum,
)
from tests.io.samples import T_of, poses

POSES = poses(12, 0.1, 1.7e9)
UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}


def rows_of(trajectory: Trajectory) -> np.ndarray:
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat()
    return np.column_stack([trajectory.stamp_s, trajectory.position, xyzw])


def write(path: Path, rows: np.ndarray, *, whole: float = 0, separator: str = " ", head: str = "") -> Path:
    """A line of numbers a row; with ``whole``, stamps are integers, so many to the second."""
    stamps = [f"{round(row[0] * whole)}" if whole else f"{row[0]:.9f}" for row in rows]
    others = [[repr(float(x)) for x in row[1:]] for row in rows]
    lines = [separator.join([stamp, *other]) for stamp, other in zip(stamps, others, strict=True)]
    path.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def assert_same(found: Trajectory, wanted: Trajectory, atol_s: float = 1e-6) -> None:
    np.testing.assert_allclose(found.stamp_s, wanted.stamp_s, rtol=0, atol=atol_s)
    np.testing.assert_allclose(found.T_world_drone, wanted.T_world_drone, atol=1e-9)


def test_a_written_trajectory_is_read_to_the_digit_and_by_evo(tmp_path: Path) -> None:
    from evo.tools import file_interface

    write_tum(tmp_path / "a.tum", POSES)
    for options in ({}, {"quaternion": "xyzw"}, {"columns": TUM}, {"time_offset": 5.0}):
        found = read_trajectory(tmp_path / "a.tum", **options)
        assert_same(found, POSES, 0)
    other = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_array_equal(other.timestamps, POSES.stamp_s)
    np.testing.assert_allclose(np.array(other.poses_se3), POSES.T_world_drone, atol=1e-9)


EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"


@pytest.mark.parametrize(
    ("head", "order", "layout"),
    [
        ("", "01234567", {}),
        ("# a flight\n# timestamp tx ty tz qx qy qz qw\n", "01234567", {}),
        ("\ufeff", "01234567", {"separator": ","}),
        ("timestamp tx ty tz qx qy qz qw\n", "01234567", {}),
        ("# timestamp tx ty tz qw qx qy qz\n", "01237456", {}),
        (EUROC, "01237456", {"separator": ",", "whole": 1e9}),
        ("QW,Z (cm),Y (cm),X (cm),qz,qy,qx,stamp_s\n", "73216540", {"separator": ","}),
    ],
)
def test_names_and_formats_say_the_columns(head: str, order: str, layout: dict, tmp_path: Path) -> None:
    rows = rows_of(POSES) * ([1, 100, 100, 100, 1, 1, 1, 1] if "cm" in head else 1)
    assert_same(read_trajectory(write(tmp_path / "a.csv", rows[:, [*map(int, order)]], head=head, **layout)), POSES)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_whole_stamps_have_the_stated_unit(unit: str, tmp_path: Path) -> None:
    since_boot = poses(12, 0.1, 1200.0)
    path = write(tmp_path / "a.tum", rows_of(since_boot), whole=UNITS[unit])
    assert_same(read_trajectory(path, stamps=unit), since_boot)
    write(path, rows_of(POSES), whole=UNITS[unit])
    with pytest.raises(InputError, match="--stamps"):
        read_trajectory(path)
    assert_same(read_trajectory(path, stamps=unit), POSES)


def test_a_decimal_point_means_seconds(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tum", rows_of(POSES))
    assert_same(read_trajectory(path, stamps="us"), POSES)
    np.testing.assert_array_equal(read_trajectory(path, stamps="in-order").stamp_s, np.arange(12))
    np.savetxt(path, rows_of(POSES) * [1e6, *[1] * 7])  # no seconds are so large
    assert_same(read_trajectory(path, stamps="us"), POSES)


@pytest.mark.parametrize("step_s", [1.0, 0.5])
def test_decimals_are_decimals_and_no_speed_decides(step_s: float, tmp_path: Path) -> None:
    far = poses(6, step_s)
    far = Trajectory(far.stamp_s + 0.378, np.array([T_of(1e4 * T[:3, 3]) for T in far.T_world_drone]))
    lines = (f"{stamp:.3f}".rstrip("0") + " " + " ".join(map(repr, row)) for stamp, *row in rows_of(far).tolist())
    (tmp_path / "a.tum").write_text("\n".join(lines))
    assert_same(read_trajectory(tmp_path / "a.tum"), far)


def test_quaternions_with_w_first_are_stated(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tum", rows_of(POSES)[:, [0, 1, 2, 3, 7, 4, 5, 6]])
    assert_same(read_trajectory(path, quaternion="wxyz"), POSES)
    assert np.abs(read_trajectory(path).T_world_drone - POSES.T_world_drone).max() > 0.1


@pytest.mark.parametrize(
    ("order", "columns", "layout"),
    [
        ("01237456", "t,x,y,z,qw,qx,qy,qz", {"separator": ",", "whole": 1e9, "options": {"stamps": "ns"}}),
        ("0123745611111", "t,x,y,z,qw,qx,qy,qz,_,_,_,_,_", {"separator": ","}),
        ("1003216547", "_,t,_,z,y,x,qz,qy,qx,qw", {}),
        ("1237456", "x,y,z,qw,qx,qy,qz", {"options": {"stamps": "in-order"}}),
        ("1237456", "x,y,z,qw,qx,qy,qz", {"options": {"stamps": "stamps.txt"}}),
    ],
)
def test_columns_without_names_are_refused_until_stated(order, columns, layout, tmp_path) -> None:
    layout, rows = dict(layout), rows_of(POSES)
    options = layout.pop("options", {})
    np.savetxt(tmp_path / "stamps.txt", POSES.stamp_s, fmt="%.9f")
    path = write(tmp_path / "a.csv", rows[:, [*map(int, order)]], **layout)
    with pytest.raises(InputError, match="--columns"):
        read_trajectory(path)
    found = read_trajectory(path, columns=columns.split(","), **options)
    wanted_s = np.arange(12.0) if options.get("stamps") == "in-order" else POSES.stamp_s
    assert_same(found, Trajectory(wanted_s, POSES.T_world_drone))


def test_kitti_takes_its_stamps_from_beside_and_its_scanner_from_calib(tmp_path: Path) -> None:
    path, T_camera_scanner = tmp_path / "00.txt", T_of((0.1, -0.2, 0.3), (0.5, -1.2, 0.7))
    T_camera = T_camera_scanner @ POSES.T_world_drone @ np.linalg.inv(T_camera_scanner)
    np.savetxt(path, T_camera[:, :3].reshape(-1, 12))
    with pytest.raises(InputError, match=r"times\.txt.*--stamps"):
        read_trajectory(path)
    np.savetxt(tmp_path / "seconds", POSES.stamp_s, fmt="%.6f")
    assert_same(read_trajectory(path, stamps="seconds"), Trajectory(POSES.stamp_s, T_camera))
    np.testing.assert_array_equal(read_trajectory(path, stamps="in-order").stamp_s, np.arange(12))
    np.savetxt(tmp_path / "times.txt", POSES.stamp_s, fmt="%.6f")
    numbers = " ".join(map(repr, T_camera_scanner[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 2\nTr: {numbers}\n")
    assert_same(read_trajectory(path), Trajectory(POSES.stamp_s, T_camera))
    assert_same(read_trajectory(path, calib="calib.txt"), POSES)
    np.savetxt(tmp_path / "times.txt", POSES.stamp_s[1:])
    with pytest.raises(InputError, match="12 poses, but 11 stamps"):
        read_trajectory(path)
    (tmp_path / "calib.txt").write_text("P0: 1 2\n")
    with pytest.raises(InputError, match=r"calib\.txt.*Tr"):
        read_trajectory(path, calib="calib.txt")
    np.savetxt(path, np.random.default_rng(0).normal(size=(12, 12)))
    with pytest.raises(InputError, match="rotations"):
        read_trajectory(path, stamps="in-order")


def test_poses_that_are_none_or_do_not_rise_are_dropped_and_counted(tmp_path: Path) -> None:
    rows = rows_of(POSES)
    bad = np.concatenate([rows[:4], rows[3:4] * np.nan, rows[2:3], rows[3:4], rows[4:]])
    bad[0, 4:] *= 1.3
    skipped = Counter[str]()
    found = trajectory_of("a.tum", bad, skipped)
    assert_same(found, Trajectory(POSES.stamp_s[1:], POSES.T_world_drone[1:]))
    assert skipped == {NOT_UNIT: 2, NOT_RISING: 2}
    rows[:, 4:] *= 1.04  # as of rounded numbers
    assert_same(trajectory_of("a.tum", rows, skipped), POSES)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 2 3 4 0 0 0\n", "--columns"),
        ("1 2 3 4 5 6 7 8\n", "length"),
        ("nan 2 3 4 0 0 0 1\n", "none valid"),
        ("1 2 3 4 0 0 0 1\n2 2 3\n", "line 2"),
        ("time,x,y,z,roll,pitch,yaw\n1,2,3,4,0,0,0\n", "--columns"),
        ("t,stamp,x,y,z,qx,qy,qz,qw\n1,1,2,3,4,0,0,0,1\n", "2 of them"),
        ("t [h],x,y,z,qx,qy,qz,qw\n1,2,3,4,0,0,0,1\n", "--stamps"),
        ("timestamp,position[0],position[1],position[2],q[0],q[1],q[2],q[3]\n1,1,1,1,1,0,0,0\n", "--columns"),
        ("t,x,y,z,qx,qy,qz\n1 2 3 4 0 0 0 1\n", "names"),
    ],
)
def test_unclear_trajectories_are_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=rf"a\.txt.*{says}"):
        read_trajectory(tmp_path / "a.txt")


def test_a_shift_of_the_clock_or_the_origin_shifts_the_poses(tmp_path: Path) -> None:
    moved = Trajectory(POSES.stamp_s + 64, POSES.T_world_drone + T_of((1e5, 5e6, 100)) - np.eye(4))
    write_tum(tmp_path / "a.tum", moved)
    found = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_allclose(found.position - POSES.position, np.tile([1e5, 5e6, 100], (12, 1)), atol=1e-8)
    at_s = POSES.stamp_s[:-1] + 0.0371
    plain, shifted = interpolate(POSES, at_s), interpolate(found, at_s + 64)
    np.testing.assert_allclose(shifted[0][:, :3, :3], plain[0][:, :3, :3], atol=1e-7)
    np.testing.assert_array_equal(shifted[1], plain[1])


@pytest.mark.parametrize(("step_s", "longest_s"), [(0.1, 0.5), (0.4, 0.8), (3.0, 2.0)])
def test_poses_are_interpolated_across_two_intervals_within_bounds(step_s: float, longest_s: float) -> None:
    line = Trajectory(step_s * np.arange(9.0), np.array([T_of((k, 0, 0), (0, 0, 0.1 * k)) for k in range(9)]))
    found, covered = interpolate(line, np.array([-0.1, 0.25 * step_s, step_s, 8 * step_s + 0.1]))
    assert covered.tolist() == [False, step_s <= longest_s, True, False]
    np.testing.assert_allclose(found[1], T_of((0.25, 0, 0), (0, 0, 0.025)), atol=1e-12)
    np.testing.assert_array_equal(found[2], line.T_world_drone[1])
    for gap_s, is_covered in ((0.99 * longest_s, True), (1.01 * longest_s, False)):
        late = np.concatenate([line.stamp_s[:5], line.stamp_s[4] + gap_s + step_s * np.arange(1.0, 5) - step_s])
        gap = Trajectory(late, line.T_world_drone)
        if np.median(np.diff(late)) == step_s:
            assert interpolate(gap, np.array([late[4] + gap_s / 2]))[1].tolist() == [is_covered]


def test_stamps_in_a_file_may_be_whole_numbers(tmp_path: Path) -> None:
    (tmp_path / "stamps.txt").write_text("7\n8\n9\n")
    np.testing.assert_array_equal(read_stamps(tmp_path / "stamps.txt"), [7, 8, 9])
    (tmp_path / "stamps.txt").write_text("7 1\n8 2\n")
    with pytest.raises(InputError, match="one"):
        read_stamps(tmp_path / "stamps.txt")
