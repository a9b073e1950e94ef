"""Trajectory files of evo's making, and an error that names every bad one."""

from collections import Counter

import numpy as np
import pytest
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.errors import InputError, SteelnbError
from steelnb.io import read_trajectory, write_tum
from steelnb.io.trajectories import seconds
from tests.io.samples import poses

POSE = "0 0 0 0 0 0 1"


@pytest.mark.parametrize("begin_s", [0.0, 1403636580.838555648])
def test_tum_files_are_exact_and_evos(tmp_path, begin_s):
    trajectory = poses(300, 1 / 125, begin_s)
    write_tum(tmp_path / "new" / "a.tum", trajectory)
    again = read_trajectory(tmp_path / "new" / "a.tum")
    np.testing.assert_array_equal(again.stamp_s, trajectory.stamp_s)
    np.testing.assert_allclose(again.T_world_drone, trajectory.T_world_drone, rtol=0, atol=1e-12)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "new" / "a.tum")
    np.testing.assert_allclose(np.array(theirs.poses_se3), trajectory.T_world_drone, rtol=0, atol=1e-12)
    file_interface.write_tum_trajectory_file(tmp_path / "b.tum", theirs)
    np.testing.assert_allclose(read_trajectory(tmp_path / "b.tum").T_world_drone, again.T_world_drone, atol=1e-12)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.tum"]


def test_kitti_files_take_their_stamps_from_beside_or_from_the_caller(tmp_path):
    trajectory, path = poses(3), tmp_path / "poses.txt"
    file_interface.write_kitti_poses_file(path, PosePath3D(poses_se3=list(trajectory.T_world_drone)))
    with pytest.raises(InputError, match="hold no stamps"):
        read_trajectory(path)
    found = read_trajectory(path, stamp_s=np.array([1.0, 2.0, 4.0]))
    np.testing.assert_array_equal(found.stamp_s, [1, 2, 4])
    np.testing.assert_allclose(found.T_world_drone, trajectory.T_world_drone, atol=1e-12)
    (tmp_path / "times.txt").write_text("5.0\n5.1\n5.2\n")
    np.testing.assert_array_equal(read_trajectory(path).stamp_s, [5.0, 5.1, 5.2])
    (tmp_path / "times.txt").write_text("1\n2\n")
    with pytest.raises(InputError, match=r"times\.txt: 2 stamps; expected 3"):
        read_trajectory(path)


def test_euroc_files(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("timestamp,x,y,z,qw,qx,qy,qz\n1403636580838555648, 1,2,3, 1,0,0,0, 9,9,\n")
    trajectory = read_trajectory(path)
    assert trajectory.stamp_s[0] == pytest.approx(1403636580.838555648, abs=1e-6)
    np.testing.assert_array_equal(trajectory.T_world_drone[0], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def test_poses_that_are_none_are_counted_and_the_others_sorted_and_normalised(tmp_path):
    lines = [
        f"3 {POSE}", "1 1 0 0 0 0 0 -5e200", "2 0 0 0 0 0 0 0", "2 0 0 0 0 1e-9 0 0", f"nan {POSE}",
        "4 inf 0 0 0 0 0 1", f"3 {POSE}", "2 2 0 0 0 0 1 1",
    ]  # fmt: skip
    (tmp_path / "a.tum").write_text("\n".join(lines))
    skipped = Counter()
    trajectory = read_trajectory(tmp_path / "a.tum", skipped)
    np.testing.assert_array_equal(trajectory.stamp_s, [1, 2, 3])
    np.testing.assert_array_equal(trajectory.position[:, 0], [1, 2, 0])
    np.testing.assert_allclose(trajectory.T_world_drone[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert skipped == {
        "pose not finite": 2, "pose with a quaternion of length zero": 2, "pose out of order, sorted": 2,
        "pose with a stamp that another has": 1,
    }  # fmt: skip
    (tmp_path / "b.txt").write_text("\n".join(f"{k} 0 0 1 0 1 0 2 0 0 1 3" for k in (1, 2, -1, "nan")))
    skipped = Counter()
    trajectory = read_trajectory(tmp_path / "b.txt", skipped, np.arange(4.0))
    np.testing.assert_array_equal(trajectory.position, [[1, 2, 3]])
    assert skipped == {"pose whose matrix is no rotation": 2, "pose not finite": 1}


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ("", InputError, "no line with a pose"),
        ("# nothing\n\nhere\n", InputError, "no line with a pose"),
        ("1 2 3\n", InputError, "'1 2 3'; expected TUM's 8 numbers"),
        (f"1 {POSE}\n2 0 0 zero 0 0 0 1\n", InputError, "not a trajectory: could not convert string 'zero'"),
        (f"1 {POSE}\n\n2 {POSE} 9\n", InputError, "columns changed from 8 to 9"),
        ("1.5,0,0,0,1,0,0,0\n", InputError, "whole nanoseconds"),
        (f"nan {POSE}\n", InputError, "1 poses, none of use"),
        ("1 1e300 0 0 0 0 0 1\n", InputError, "1 poses, none of use"),
        ("1 2\0", InputError, "a.txt"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, content, error, words):
    (tmp_path / "a.txt").write_text(content)
    with pytest.raises(error, match=words) as caught:
        read_trajectory(tmp_path / "a.txt")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="gone"):
        read_trajectory(tmp_path / "gone.txt")


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("12.25", 12.25), ("1403636580", 1403636580.0), ("1403636580838", 1403636580.838), ("-3", -3.0),
        ("1403636580838555", 1403636580.838555), ("1403636580838555648", 1403636580838555648 / 10**9),
        ("1e3", 1000.0),
    ],
)  # fmt: skip
def test_stamps_in_every_unit(word, expected):
    assert seconds(word) == expected


@settings(max_examples=100, deadline=None, database=None)
@given(st.lists(st.text("0123456789 .,-+einfa#_\t\n", max_size=40) | st.just(f"1 {POSE}"), max_size=6))
def test_any_text_is_a_trajectory_or_one_of_our_errors(tmp_path_factory, lines):
    path = tmp_path_factory.getbasetemp() / "any.txt"
    path.write_text("\n".join(lines))
    fault = ""
    try:
        trajectory = read_trajectory(path, stamp_s=np.arange(3.0))
    except SteelnbError as caught:
        fault = str(caught)
    else:
        assert (np.diff(trajectory.stamp_s) > 0).all()
        assert np.isfinite(trajectory.T_world_drone).all()
    assert fault.startswith(str(path)) or not fault
    assert "\n" not in fault
