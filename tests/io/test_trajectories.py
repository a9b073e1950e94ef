"""Trajectories of many programs."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.io import read_trajectory, write_tum
from steelnb.io.column_names import ROTATIONS
from steelnb.io.trajectories import trajectory_of
from tests.io.samples import poses

TURN = Rotation.from_euler("ZYX", [50, -20, 10], degrees=True)
X, Y, Z, W = (repr(number) for number in TURN.as_quat(canonical=True).tolist())
MATRIX = np.vstack([np.column_stack([TURN.as_matrix(), [1, 2, 3]]), [0, 0, 0, 1]])
NAMES = "x,y,z,qx,qy,qz,qw"
POSE = f"1,2,3,{X},{Y},{Z},{W}"


def named(prefix: str, sign: str = ".") -> str:
    """Names of the parts of a pose message."""
    parts = [f"position{sign}{axis}" for axis in "xyz"] + [f"orientation{sign}{axis}" for axis in "xyzw"]
    return ",".join(f"{prefix}{part}" for part in parts)


@pytest.mark.parametrize(
    ("begin_s", "content"),
    [
        (0.5, f"0.5,{POSE}\n1.5,{POSE}\n".replace(",", " ")),
        (0.5, f"\ufeff0.5,{POSE}\n1.5,{POSE}\n"),
        *(
            (0.5, f"# {comment}\n0.5 1 2 3 {W} {X} {Y} {Z}\n1.5 1 2 3 {W} {X} {Y} {Z}\n")
            for comment in (
                "timestamp tx ty tz qw qx qy qz",
                "timestamp x y z qw qx qy qz (w first)",
                "columns: t, px, py, pz, qw, qx, qy, qz, name",
                "t | x | y | z | qw | qx | qy | qz |",
            )
        ),
        (0.5, f"# t x y z qx qy qz qw (was qw qx qy qz before v2)\n0.5,{POSE}\n1.5,{POSE}\n".replace(",", " ")),
        (0.5, f"{NAMES},t\n{POSE},0.5\n{POSE},1.5\n"),
        (0.5, f"stamp_ms,{NAMES}\n500,{POSE}\n1500,{POSE}\n".replace(",", ";").replace(".", ",")),
        (0.5, "t,x,y,z,roll_deg,pitch_deg,yaw_deg\n0.5,1,2,3,10,-20,50\n1.5,1,2,3,10,-20,50\n"),
        (
            0.5,
            "time,x,y,z,roll [rad],pitch [rad],yaw [rad]\n"
            + "".join(f"{t},1,2,3,{np.pi / 18},{-np.pi / 9},{np.pi / 3.6}\n" for t in (0.5, 1.5)),
        ),
        (1.7e9, f"1700000000000 {POSE}\n1700000001000 {POSE}\n".replace(",", " ")),
        (1.7e9, f"1700000000000000000,{POSE}\n1700000001000000000,{POSE}\n"),
        (
            1.7e9,
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [],"
            " v_RS_R_x [m s^-1]\n"
            + "".join(f"{t}000000000,1,2,3,{W},{X},{Y},{Z},7\n" for t in (1700000000, 1700000001)),
        ),
        (1.7e9 + 0.5, f"#sec,nsec,{NAMES}\n1700000000,500000000,{POSE}\n1700000001,500000000,{POSE}\n"),
        (
            1.7e9,
            f"%time,field.header.stamp,field.header.frame_id,{named('field.pose.')}\n"
            f"1700000009000000000,1700000000000000000,map,{POSE}\n1700000009900000000,1700000001000000000,map,{POSE}\n",
        ),
        (
            1.7e9 + 0.5,
            f"Time,header.stamp.secs,header.stamp.nsecs,{named('pose.pose.')},pose.covariance,twist.twist.linear.x\n"
            + "".join(f'{t}.9,{t},500000000,{POSE},"(0.1, 0.2)",7\n' for t in (1700000000, 1700000001)),
        ),
        (0.5, f",t,{NAMES}\n0,0.5,{POSE}\n1,1.5,{POSE}\n"),
        (0.5, f"m,rad,time,{NAMES},\n7,7,0.5,{POSE},\n7,7,1.5,{POSE},\n"),
        (0.5, f"processing_time,time,{NAMES}\n9,0.5,{POSE}\n8,1.5,{POSE}\n"),
        (0.5, f"0.5,{POSE},\n1.5,{POSE},\n"),
        (
            1.7e9 + 0.5,
            f"stamp.sec,stamp.nanosec,stamp,{NAMES}\n"
            + "".join(f"{t},{part},{t},{POSE}\n" for t, part in ((1700000000, 500000000), (1700000001, 500000000)))
            + f",,,{POSE}\n",
        ),
        *(
            (0.5, f"{stamp},{axes},{turn}\n0.5,1,2,3,{W},{X},{Y},{Z}\n1.5,1,2,3,{W},{X},{Y},{Z}\n")
            for stamp, axes, turn in (
                ("Stamp (UTC)", "x,y,z", "q0,q1,q2,q3"),
                ("t", "position[0],position[1],position[2]", "q[0],q[1],q[2],q[3]"),
                ("t", "PosX,PosY,PosZ", "RotW,RotX,RotY,RotZ"),
                ("Time", "tX,tY,tZ", "oW,oX,oY,oZ"),
                ("unix_time", "x,y,z", "qr,qi,qj,qk"),
                ("t", "pos_x,pos_y,pos_z", "rot_w,rot_x,rot_y,rot_z"),
            )
        ),
        (0.5, f"timeMs,{NAMES}\n500,{POSE}\n1500,{POSE}\n"),
        (0.5, f"elapsed_time,unix_time,{NAMES}\n7,0.5,{POSE}\n8,1.5,{POSE}\n"),
        *(
            (1.7e9, f"{names}2023-11-14 22:13:20 {POSE}\n2023-11-14 22:13:21 {POSE}\n".replace(",", " "))
            for names in ("", f"# stamp {NAMES}\n", f"stamp {NAMES}\n")
        ),
        *(
            (0.5, "".join(f"{text}\n" for text in (names, f"0.5,{numbers}", f"1.5,{numbers}") if text))
            for names, numbers in (
                ("", ",".join(map(str, MATRIX[:3].ravel()))),
                ("", ",".join(map(str, MATRIX.ravel()))),
                ("t," + ",".join(f"T{i}{j}" for i in range(4) for j in range(4)), ",".join(map(str, MATRIX.ravel()))),
                ("t,tx,ty,tz," + ",".join(ROTATIONS), ",".join(map(str, [1, 2, 3, *TURN.as_matrix().ravel()]))),
            )
        ),
        (0.5, f"__time,{named('/odom/pose/pose/', '/')}\n0.5,{POSE}\n1.5,{POSE}\n"),
    ],
)
def test_poses_of_many_programs_are_the_same(begin_s: float, content: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(content, encoding="utf-8")
    read = read_trajectory(tmp_path / "a.csv")
    np.testing.assert_allclose(read.stamp_s, [begin_s, begin_s + 1], rtol=0, atol=3e-7)
    np.testing.assert_array_equal(read.position, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(read.T_world_drone[:, :3, :3], [TURN.as_matrix()] * 2, atol=1e-12)


def test_poses_of_kitti_take_their_stamps_from_the_file_beside(tmp_path: Path) -> None:
    matrix = np.column_stack([TURN.as_matrix(), [1, 2, 3]])
    np.savetxt(tmp_path / "00.txt", [matrix.ravel()] * 3)
    with pytest.raises(InputError, match=r"12 numbers per line \(KITTI\) without stamps; expected them in times.txt"):
        read_trajectory(tmp_path / "00.txt")
    np.savetxt(tmp_path / "times.txt", [0, 0.1, 0.2])
    read = read_trajectory(tmp_path / "00.txt")
    np.testing.assert_array_equal(read.stamp_s, [0, 0.1, 0.2])
    np.testing.assert_allclose(read.T_world_drone[:, :3], [matrix] * 3, atol=1e-12)
    np.savetxt(tmp_path / "times.txt", [0, 0.1])
    with pytest.raises(InputError, match=r"3 poses, 2 stamps in times.txt"):
        read_trajectory(tmp_path / "00.txt")
    np.savetxt(tmp_path / "times.txt", [[0, 5.0], [1, 5.1], [2, 5.2]])
    with pytest.raises(InputError, match=r"times.txt beside it has 2 numbers a line; expected one, the stamp"):
        read_trajectory(tmp_path / "00.txt")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3 4 5 6 7\n", "7 numbers per line, without names; expected 8"),
        (f"{NAMES}\n{POSE}\n", "none for stamp; expected stamp, x, y"),
        ("# time x y z q1 q2 q3 q4\n0 1 2 3 0 0 0 1\n", "none for qx, qy, qz, qw"),
        ("a,b,c,d,e,f,g,h\n1,2,3,4,5,6,7,8\n", "columns a, b, c, d, e, f, g, h; expected stamp, x"),
        ("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,90\n", "without their unit; expected names such as roll_deg"),
        (f"t,x_mm,y_mm,z_mm,qx,qy,qz,qw\n0,{POSE}\n", "in mm; expected metres"),
        ("50000000000 1 2 3 0 0 0 1\n50100000000 1 2 3 0 0 0 1\n", "stamps 1e.08 s apart; expected seconds"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0\n", "line 2 has 6 fields"),
        ("2 " * 12 + "\n", "without stamps"),
        ("2 " * 17 + "\n", "16 numbers after the stamp that are no transforms"),
        (
            f"t,x,y,z,{','.join(ROTATIONS)}\n0,{'1,' * 11}1\n",
            "r11, r12, .* are no rotations; expected a matrix, row by",
        ),
        ("0 1e30 2 3 0 0 0 1\n", "1 poses, none valid"),
        ("0 1 2 3 0.1 -0.2 1.5 0.9\n1 1 2 3 0.1 0 -1.4 0.9\n", "quaternions of length 1.7.*; expected qx, qy, qz, qw"),
        ("0 1 2 3 30 0 90 1\n1 1 2 3 30 0 91 1\n", "2 poses, none valid; expected .* unit quaternions"),
        ("0 1 2 3 0 0 0 1\n33 1 2 3 0 0 0 1\n67 1 2 3 0 0 0 1\n", "stamps 33.5 s apart; expected seconds"),
        (
            "0 1000 2000 3000 0 0 0 1\n0.1 1040 2000 3000 0 0 0 1\n",
            "poses 40 m apart after 0.1 s; expected positions in metres",
        ),
        (f"start_time,end_time,{NAMES}\n0,1,{POSE}\n", "2 columns may be stamps: start_time, end_time; expected one"),
        (f"date,{NAMES},a,b,c,d\n0,{POSE},0,0,0,0\n", "columns date, .*none for stamp"),
        ("5000 1 2 3 0 0 0 1\n5100 1 2 3 0 0 0 1\n5200 1 2 3 0 0 0 1\n", "stamps 100 s apart; expected seconds"),
        (
            "".join(f"1.7e+09 {k} 2 3 0 0 0 1\n" for k in range(50)),
            "50 poses have 1 stamps; expected one each, written",
        ),
        ("1 2 3\n", "3 numbers per line"),
        ("a b\n", "TUM trajectory .*no line of numbers"),
        ("4 0 0 0 0 0 0 0\n", "1 poses, none valid"),
    ],
)
def test_unclear_trajectories_are_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(InputError, match=rf"a.csv: .*{message}"):
        read_trajectory(tmp_path / "a.csv")


def test_a_written_trajectory_is_read_by_us_and_by_evo(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_tum_trajectory_file

    written = poses(20, begin_s=1_700_000_000.0)
    write_tum(tmp_path / "a.tum", written)
    read = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.stamp_s, written.stamp_s)
    np.testing.assert_allclose(read.T_world_drone, written.T_world_drone, atol=1e-12)
    np.testing.assert_allclose(read_tum_trajectory_file(str(tmp_path / "a.tum")).poses_se3, written.T_world_drone)


@pytest.mark.parametrize(
    ("at", "shift_m", "dropped"),
    [
        (slice(0, 1), 3e6, 1),
        (slice(1, 2), 60.0, 1),
        (slice(17, 20), 300.0, 3),
        (slice(28, 30), -3e6, 2),
        (slice(15, 30), 60.0, 0),  # the map is corrected
        (slice(0, 30), 5.8e6, 0),  # UTM
        (slice(0, 30, 2), 60.0, 0),  # two programs
    ],
)
def test_a_few_poses_where_no_drone_can_be_are_dropped(at, shift_m, dropped) -> None:
    rows, skipped = np.zeros((30, 8)), Counter[str]()
    rows[:, 0], rows[:, 1], rows[:, 7] = 0.1 * np.arange(30), 0.3 * np.arange(30), 1
    rows[at, 2] += shift_m
    kept = trajectory_of("a", rows, skipped)
    assert len(kept) == 30 - dropped
    assert skipped["pose farther from those before and after than a drone flies"] == dropped
    if dropped:
        assert np.abs(kept.position[:, 1]).max() == 0


def test_invalid_poses_are_dropped(tmp_path: Path) -> None:
    lines = ["# stamp x y z qx qy qz qw", "2 1 0 0 0 0 0 2", "1 0 0 0 0 0 0 1", "1 5 0 0 0 0 0 1", "3 nan 0 0 0 0 0 1"]
    (tmp_path / "a.tum").write_text("\n".join([*lines, "4 0 0 0 0 0 0 0"]))
    read = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.stamp_s, [1.0, 2.0])
    np.testing.assert_array_equal(read.position[:, 0], [0.0, 1.0])


@pytest.mark.parametrize(
    ("yaw_deg", "w_first", "is_noted"), [(50, True, False), (50, False, False), (0, False, True), (180, True, True)]
)
def test_rows_as_of_euroc_without_names_have_w_first_if_the_drone_is_upright_so(
    yaw_deg: float, w_first: bool, is_noted: bool, tmp_path: Path
) -> None:
    turn = Rotation.from_euler("ZYX", [yaw_deg, 4, 3], degrees=True)
    xyzw = turn.as_quat()
    numbers = ",".join(map(str, np.roll(xyzw, 1) if w_first else xyzw))
    (tmp_path / "a.csv").write_text("".join(f"{t}000000000,1,2,3,{numbers},\n" for t in (1700000000, 1700000001)))
    skipped = Counter[str]()
    read = read_trajectory(tmp_path / "a.csv", skipped)
    assert any("EuRoC" in reason for reason in +skipped) == is_noted
    if not (w_first and is_noted):
        np.testing.assert_allclose(read.T_world_drone[0, :3, :3], turn.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("by_columns", [False, True])
def test_matrices_are_read_row_by_row_or_column_by_column(by_columns: bool, tmp_path: Path) -> None:
    flown = poses(6)
    T = flown.T_world_drone.transpose(0, 2, 1) if by_columns else flown.T_world_drone
    np.savetxt(tmp_path / "a.txt", np.column_stack([flown.stamp_s, T.reshape(-1, 16)]))
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.txt").T_world_drone, flown.T_world_drone, atol=1e-9)


def test_poses_of_kittis_camera_are_turned_to_its_scanner(tmp_path: Path) -> None:
    flown, T_camera_scanner = poses(6), np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    of_camera = T_camera_scanner @ flown.T_world_drone @ np.linalg.inv(T_camera_scanner)
    np.savetxt(tmp_path / "poses.txt", of_camera[:, :3].reshape(-1, 12))
    np.savetxt(tmp_path / "times.txt", flown.stamp_s)
    numbers = " ".join(map(str, T_camera_scanner[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: 7 0 6 0 0 7 1 0 0 0 1 0\nTr: {numbers}\n")
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt").T_world_drone, flown.T_world_drone, atol=1e-9)
    (tmp_path / "calib.txt").write_text("P0: 7 0 6 0 0 7 1 0 0 0 1 0\n")
    with pytest.raises(InputError, match=r"poses of a camera \(KITTI\), and calib.txt beside it has no Tr"):
        read_trajectory(tmp_path / "poses.txt")
    (tmp_path / "calib.txt").write_text("board: 7 x 5\n")
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt").T_world_drone, of_camera, atol=1e-9)


@pytest.mark.parametrize("head", ["", "stamp x y z qx qy qz qw\n"])
def test_nanoseconds_without_zeros_before_them_are_padded(head: str, tmp_path: Path) -> None:
    flown, begin = poses(40, 0.05), 1_700_000_000
    rows = np.column_stack([flown.position, Rotation.from_matrix(flown.T_world_drone[:, :3, :3]).as_quat()])
    stamps = [divmod(round(1e9 * stamp_s), 10**9) for stamp_s in flown.stamp_s]
    lines = [f"{begin + s}.{ns} {' '.join(map(str, row))}" for (s, ns), row in zip(stamps, rows.tolist(), strict=True)]
    (tmp_path / "a.tum").write_text(head + "\n".join(lines))
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.tum").stamp_s, begin + flown.stamp_s, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "last"),
    [
        ("timestamp_us,position[0],position[1],position[2],q[0],q[1],q[2],q[3],pose_frame", "1"),
        ("TimeStamp_us,POS_X,POS_Y,POS_Z,Q_W,Q_X,Q_Y,Q_Z,ImageFile", "img_1.png"),
    ],
)
def test_poses_of_px4_and_airsim_are_turned_up(names: str, last: str, tmp_path: Path) -> None:
    flown, down = poses(6), np.diag([1.0, -1, -1, 1])
    T = down @ flown.T_world_drone @ down
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    rows = np.column_stack([1e6 * flown.stamp_s, T[:, :3, 3], xyzw[:, [3, 0, 1, 2]]]).tolist()
    (tmp_path / "a.csv").write_text("\n".join([names, *(",".join([*map(str, row), last]) for row in rows)]))
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.csv").T_world_drone, flown.T_world_drone, atol=1e-9)


def test_zeros_between_poses_that_go_on_are_none() -> None:
    stamp_s = 0.01 * np.arange(200)
    rows = np.column_stack([stamp_s, 5 + stamp_s, 0 * stamp_s, 2 + 0 * stamp_s, np.tile([0, 0, 0, 1.0], (200, 1))])
    rows[50:90, 1:4] = 0
    skipped: Counter[str] = Counter()
    assert len(trajectory_of("a", rows, skipped)) == 160
    assert skipped["pose at (0, 0, 0) between others, where no drone gets so fast"] == 40
    standing = rows.copy()
    standing[:, 1:4] *= 0.01  # from a start near the origin a drone flies on
    assert len(trajectory_of("a", standing, skipped)) == 200


def test_coordinates_from_the_centre_of_the_earth_are_refused() -> None:
    rows = np.zeros((20, 8))
    rows[:, 0], rows[:, 7], rows[:, 1:4] = np.arange(20), 1, (4_177_000.0, 855_000, 4_728_000)
    with pytest.raises(InputError, match=r"around \(4177000, 855000, 4728000\) m, as from the centre of the Earth"):
        trajectory_of("a", rows, Counter())
    rows[:, 1:4] = 500_000, 6_350_000, 120  # UTM, as far from its origin
    assert len(trajectory_of("a", rows, Counter())) == 20


@pytest.mark.parametrize("unit", [1.0, 1e9])
def test_the_times_beside_kittis_poses_may_be_nanoseconds(unit: float, tmp_path: Path) -> None:
    flown, begin = poses(6), 1_700_000_000
    np.savetxt(tmp_path / "poses.txt", flown.T_world_drone[:, :3].reshape(-1, 12))
    (tmp_path / "times.txt").write_text("".join(f"{(begin + stamp_s) * unit:.0f}\n" for stamp_s in 5 * flown.stamp_s))
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt").stamp_s, begin + 5 * flown.stamp_s, atol=1e-6)
