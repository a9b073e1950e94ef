"""Trajectories as text: exact round trips, evo on either side, and an error of ours for every bad line."""

import string
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.datatypes import Trajectory
from steelnb.errors import FileContentError, FileMissingError, OutputError, RecordingError, SteelnbError
from steelnb.recordings.depth_images import read_camera
from steelnb.recordings.imu_files import read_imu
from steelnb.recordings.stamps import read_list, read_stamps
from steelnb.recordings.trajectories import (
    form_of,
    read_euroc,
    read_kitti,
    read_trajectory,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)
from tests.recordings.folder_samples import flown

WRITERS = {"a.tum": write_tum, "a.kitti": write_kitti, "a.csv": write_euroc}
POSE = "0 0 0 0 0 0 1"


@pytest.mark.parametrize("begin_s", [0.0, 1403636580.838555648])
@pytest.mark.parametrize("name", WRITERS)
def test_round_trips_are_exact_to_a_nanosecond_and_a_nanometre(tmp_path: Path, name: str, begin_s: float) -> None:
    trajectory = flown(300, 1 / 125, begin_s)
    WRITERS[name](tmp_path / name, trajectory)
    again = read_trajectory(tmp_path / name)
    np.testing.assert_allclose(again.stamp_s, trajectory.stamp_s, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.T_world_drone, trajectory.T_world_drone, rtol=0, atol=1e-9)
    assert set(tmp_path.iterdir()) <= {tmp_path / name, tmp_path / "times.txt"}


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.tum", file_interface.read_tum_trajectory_file), ("a.csv", file_interface.read_euroc_csv_trajectory),
        ("a.kitti", file_interface.read_kitti_poses_file),
    ],
)  # fmt: skip
def test_evo_reads_what_we_write(tmp_path: Path, name: str, read: Callable) -> None:
    trajectory = flown(50, 0.1, 1.6e9)
    WRITERS[name](tmp_path / name, trajectory)
    poses = read(str(tmp_path / name))
    np.testing.assert_allclose(np.array(poses.poses_se3), trajectory.T_world_drone, rtol=0, atol=1e-9)
    if isinstance(poses, PoseTrajectory3D):
        np.testing.assert_allclose(poses.timestamps, trajectory.stamp_s, rtol=0, atol=1e-6)  # it rounds nanoseconds


def test_evo_traj_accepts_our_files(tmp_path: Path) -> None:
    trajectory = flown(50, 0.1)
    program = Path(sys.executable).with_name("evo_traj")
    for name, write in WRITERS.items():
        write(tmp_path / name, trajectory)
    for form, name in (("tum", "a.tum"), ("kitti", "a.kitti"), ("euroc", "a.csv")):
        done = subprocess.run([program, form, str(tmp_path / name)], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "50 poses" in done.stdout


def test_what_evo_refuses_or_rounds_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf# stamp x y z\r\n\r\n  0.5\t1  2 3 0 0 0 1 \r\n1.5 1 2 3 0 0 0 2  # remark\r\n")
    np.testing.assert_array_equal(read_tum(path).position, [[1, 2, 3]] * 2)
    path.write_text("timestamp,x,y,z,qw,qx,qy,qz\n1403636580838555648, 1,2,3, 1,0,0,0, 9,9,\n")
    trajectory = read_trajectory(path)
    assert trajectory.stamp_s[0] == 1403636580838555648 / 10**9
    np.testing.assert_array_equal(trajectory.T_world_drone[0, :3, :3], np.eye(3))


def test_poses_that_are_none_are_counted_and_the_others_sorted_and_normalised(tmp_path: Path) -> None:
    lines = [
        f"3 {POSE}", "1 1 0 0 0 0 0 -5e200", "2 0 0 0 0 0 0 0", "2 0 0 0 0 1e-9 0 0", f"nan {POSE}",
        "4 inf 0 0 0 0 0 1", f"3 {POSE}", "2 2 0 0 0 0 1 1",
    ]  # fmt: skip
    path = tmp_path / "a.tum"
    path.write_text("\n".join(lines))
    skipped: Counter[str] = Counter()
    trajectory = read_trajectory(path, skipped)
    np.testing.assert_array_equal(trajectory.stamp_s, [1, 2, 3])
    np.testing.assert_array_equal(trajectory.position[:, 0], [1, 2, 0])
    np.testing.assert_allclose(trajectory.T_world_drone[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert skipped == {
        "pose not finite": 2, "pose with a quaternion of length zero": 2, "pose out of order, sorted": 2,
        "pose with a stamp that another has": 1,
    }  # fmt: skip


def test_matrices_that_do_not_rotate_are_counted(tmp_path: Path) -> None:
    rows = [
        "1 0 0 1 0 1 0 2 0 0 1 3",
        "2 0 0 1 0 1 0 2 0 0 1 3",
        "-1 0 0 1 0 1 0 2 0 0 1 3",
        "nan 0 0 1 0 1 0 2 0 0 1 3",
    ]
    path = tmp_path / "a.txt"
    path.write_text("\n".join(rows))
    skipped: Counter[str] = Counter()
    trajectory = read_kitti(path, skipped, rate_hz=10.0)
    np.testing.assert_array_equal(trajectory.position, [[1, 2, 3]])
    assert skipped == {"pose whose matrix is no rotation": 2, "pose not finite": 1}


def test_kitti_takes_its_stamps_from_a_file_or_a_rate(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    write_kitti(path, flown(3, 0.1, 5.0))
    np.testing.assert_allclose(read_trajectory(path).stamp_s, [5.0, 5.1, 5.2])
    np.testing.assert_allclose(read_kitti(path, times=np.array([1.0, 2.0, 4.0])).stamp_s, [1, 2, 4])
    (tmp_path / "times.txt").write_text("1\n2\n")
    with pytest.raises(RecordingError, match=r"times\.txt: 2 stamps; expected the 3"):
        read_trajectory(path)
    (tmp_path / "times.txt").unlink()
    with pytest.raises(RecordingError, match="hold no stamps"):
        read_trajectory(path)
    np.testing.assert_allclose(read_trajectory(path, rate_hz=10.0).stamp_s, [0, 0.1, 0.2])


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ("", FileContentError, "no line with a pose"),
        ("# nothing\n\n", FileContentError, "no line with a pose"),
        ("1 2 3\n", FileContentError, "no line with a pose"),
        (f"1 {POSE}\n2 0 0 zero 0 0 0 1\n", FileContentError, "line 2: '2 0 0 zero 0 0 0 1'; expected TUM's 8 numbers"),
        (f"1 {POSE}\n\n2 {POSE} 9\n", FileContentError, "line 3"),
        (f"1 {POSE}\n2 0 0 0 0 0", FileContentError, "line 2"),
        (f"1 {POSE}\n1_0 {POSE}\n", FileContentError, "line 2"),
        (f"1 {POSE}\n٣ {POSE}\n", FileContentError, "line 2"),
        ("1,0,0,0,1,0,0,0\n1.5,0,0,0,1,0,0,0\n", FileContentError, "line 2: .*EuRoC's a stamp in whole nanoseconds"),
        ("1,0,0,0,1,0,0,0\n2,0,0,0,1,0,0\n", FileContentError, "line 2"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0\n", FileContentError, "line 2: '1 0 0 0'; expected KITTI's 12"),
        ("\0\1\2", FileContentError, "zero bytes"),
        ("1 0 0 0 0 0 0 0\n", RecordingError, "1 poses, none of use"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, content: str, error: type, words: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(content)
    with pytest.raises(error, match=words) as caught:
        read_trajectory(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_file_and_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(FileMissingError):
        read_trajectory(tmp_path / "none.tum")
    with pytest.raises(FileMissingError):
        read_trajectory(tmp_path)
    for target in (tmp_path, Path("/proc/none/a.tum")):
        with pytest.raises(OutputError):
            write_tum(target, flown(2, 1.0))
    assert list(tmp_path.iterdir()) == []


def test_stamps_in_any_unit(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("#timestamp [ns],filename\n1403636580838555648,a.png\n1403636580.5 b\n1403636580838 c\n12 d\n")
    assert [round(stamp, 3) for stamp in read_stamps(path)] == [1403636580.839, 1403636580.5, 1403636580.838, 12.0]
    assert [name for _, name in read_list(path)] == ["a.png", "b", "c", "d"]
    path.write_text("2011-09-26 13:02:25.594360375\n")
    assert read_stamps(path)[0] == pytest.approx(1317042145.594360375, abs=1e-6)
    path.write_text("1.0\nnone\n")
    with pytest.raises(FileContentError, match="line 2: 'none'"):
        read_stamps(path)


NUMBERS = st.one_of(
    st.floats().map(repr),
    st.integers(-(10**25), 10**25).map(str),
    st.sampled_from(["", "nan", "-inf", "1e999", "0x10", "1_0", "٣", "+", ".", "1e", "q", "2011-13-45 99:00:00"]),
)
LINES = st.one_of(
    st.lists(NUMBERS, max_size=14).flatmap(
        lambda words: st.sampled_from([" ", ",", ", ", "\t"]).map(lambda s: s.join(words))
    ),
    st.text(string.printable + "\x00é٣￼", max_size=40),
    st.sampled_from([f"1 {POSE}", "1,0,0,0,1,0,0,0", "1 0 0 0 0 1 0 0 0 0 1 0", "# remark", ""]),
)
READERS: tuple[Callable, ...] = (
    read_trajectory, read_tum, read_euroc, form_of, read_stamps, read_list,
    lambda path: read_trajectory(path, rate_hz=30.0), lambda path: read_kitti(path, rate_hz=30.0),
    read_camera, lambda path: read_imu(path, Counter()),
)  # fmt: skip


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "a.txt"


def _ours_alone(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    for read in READERS:
        said, found = "", None
        try:
            found = read(path)
        except SteelnbError as fault:
            said = str(fault)
        assert "\n" not in said
        assert len(said) < 600
        if isinstance(found, Trajectory):
            assert (np.diff(found.stamp_s) > 0).all()
            assert np.isfinite(found.T_world_drone).all()
            R = found.T_world_drone[:, :3, :3]
            np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-6)


@settings(max_examples=8000, deadline=None)
@given(st.lists(LINES, max_size=6).map("\n".join))
def test_any_text_gives_rising_poses_or_an_error_of_ours(scratch: Path, text: str) -> None:
    _ours_alone(scratch, text.encode("utf-8", errors="surrogatepass"))


@settings(max_examples=4000, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_give_an_error_of_ours(scratch: Path, content: bytes) -> None:
    _ours_alone(scratch, content)
