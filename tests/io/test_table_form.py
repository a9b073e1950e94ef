"""Text files as other programs write them: titles, units, names, comments, times."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_cloud, read_points
from steelnb.io.trajectories import read_trajectory

EXPECTED = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
NUMBERS = "1 2 3\n4 5 6\n"


@pytest.mark.parametrize(
    "head",
    [
        "My scan\n", "Survey 2023\n", "Survey of the tower, station 3\nx y z\n", "; made by a scanner\n",
        "x y z\nm m m\n", "x y z\n[m] [m] [m]\n", "# position is x\n", "# columns x y z\n",
        "# the fields are x, y, z\n",
    ],
)  # fmt: skip
def test_titles_units_and_prose_before_the_numbers_are_no_points(tmp_path, head):
    (tmp_path / "a.txt").write_text(head + NUMBERS)
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("x y z\nmm mm mm\n", "x, y and z in mm; expected metres"),
        ("x y z\na b c\n", "line 2: 'a b c'; expected numbers"),
        ("x y z i\n", "4 names of columns, but 3 fields in line 2"),
        ("My tower scan\n", "columns my, tower, scan; expected x, y and z"),
        ("# x y stamp\n", "columns x, y, stamp; expected x, y and z"),
    ],
)
def test_other_units_and_columns_are_refused(tmp_path, head, message):
    (tmp_path / "a.txt").write_text(head + NUMBERS)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "names",
    [
        "E,N,H", "east,north,up", "x,y,elev", "X:3,Y:3,Z:3", "Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2",
        "Coordinates:0,Coordinates:1,Coordinates:2", "points.x,points.y,points.z", "X1 (m),Y1 (m),Z1 (m)",
        "x in m,y in m,z in m", "x_local,y_local,z_local", "Ost,Nord,Hoehe",
    ],
)  # fmt: skip
def test_names_of_axes(tmp_path, names):
    (tmp_path / "a.csv").write_text(f"id,{names}\n7,1,2,3\n8,4,5,6\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), EXPECTED)
    swapped = names.split(",")
    (tmp_path / "b.csv").write_text(f"{swapped[1]},{swapped[0]},{swapped[2]}\n2,1,3\n5,4,6\n")
    np.testing.assert_array_equal(read_points(tmp_path / "b.csv"), EXPECTED)


@pytest.mark.parametrize("comment", ["# x right y down z forward", "# looks along x and y of the tower"])
def test_words_of_a_sentence_are_no_names(tmp_path, comment):
    (tmp_path / "a.txt").write_text(f"{comment}\n1 2 3 10 20 30\n4 5 6 10 20 30\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)
    (tmp_path / "a.tum").write_text("# truth of drone x forward z up\n0 1 2 3 0 0 0 1\n1 4 5 6 0 0 0 1\n")
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.tum").position, EXPECTED)


@pytest.mark.parametrize("text", ["sep=;\n1;2;3\n4;5;6\n", "1.0D+00 2.0D0 3.0d0\n4.0D0 5.0D0 0.6D+01\n"])
def test_spreadsheets_and_fortran(tmp_path, text):
    (tmp_path / "a.txt").write_text(text)
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)


def test_lists_at_the_ends_of_lines_may_have_any_length(tmp_path):
    head = "# 3D point list\n#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    (tmp_path / "a.txt").write_text(f"{head}9 1 2 3 0 0 0 0.5 1 2\n4 4 5 6 0 0 0 0.5 1 2 3 4 5 6\n8 7 8 9 0 0 0 .5\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), [*EXPECTED, [7, 8, 9]])


@pytest.mark.parametrize(
    "times",
    [
        ("2023-11-14T22:13:20.25Z", "2023-11-14T22:13:20.35Z"), ("2023-11-14 22:13:20.25", "2023-11-14 22:13:20.35"),
        ("2023-11-15T00:13:20.25+02:00", "2023-11-15T00:13:20.35+02:00"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("separator", [",", ";"])
def test_times_are_stamps(tmp_path, times, separator):
    rows = ["time,x,y,z,qx,qy,qz,qw", *(f"{time},1,2,3,0,0,0,1" for time in times)]
    (tmp_path / "a.csv").write_text("\n".join(rows).replace(",", separator))
    assert read_trajectory(tmp_path / "a.csv").stamp_s.tolist() == [1700000000.25, 1700000000.35]


@pytest.mark.parametrize(
    "comment",
    [
        "timestamp x y z qw qx qy qz",
        "timestamp x y z qw qx qy qz (w first)",
        "columns: t, px, py, pz, qw, qx, qy, qz, name",
    ],
)
def test_a_comment_tells_that_w_is_first(tmp_path, comment):
    turn = Rotation.from_euler("z", 50, degrees=True)
    x, y, z, w = turn.as_quat()
    (tmp_path / "a.tum").write_text(f"# {comment}\n0 1 2 3 {w} {x} {y} {z}\n1 1 2 3 {w} {x} {y} {z}\n")
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "a.tum").T_world_drone[1, :3, :3], turn.as_matrix(), atol=1e-9
    )


@pytest.mark.parametrize("cast", [lambda stamp: f"{stamp:.9g}", lambda stamp: repr(float(np.float32(stamp)))])
def test_stamps_without_all_their_digits_are_refused(tmp_path, cast):
    rows = [f"{cast(1_700_000_000 + 0.1 * k)} {0.1 * k} 2 3 0 0 0 1\n" for k in range(50)]
    (tmp_path / "a.tum").write_text("".join(rows))
    with pytest.raises(InputError, match=r"50 poses have . stamps; expected one each, written with all their digits"):
        read_trajectory(tmp_path / "a.tum")


def test_degrees_and_decimal_commas_between_commas_are_refused(tmp_path):
    points = np.random.default_rng(0).uniform(0, [5, 5, 20], (200, 3))
    degrees = points / [74_300, 110_540, 1] + [11.5, 48.1, 500]
    np.savetxt(tmp_path / "a.xyz", degrees, fmt="%.9f")
    with pytest.raises(InputError, match="longitude and latitude in degrees; expected metres"):
        read_cloud(tmp_path / "a.xyz")
    text = "\n".join(f"{x:.2f},{y:.2f},{z:.2f}".replace(".", ",") for x, y, z in points)
    (tmp_path / "b.csv").write_text(text)
    with pytest.raises(InputError, match="whole numbers between commas, which may be decimal ones"):
        read_cloud(tmp_path / "b.csv")
    np.savetxt(tmp_path / "c.xyz", points * [0, 0, 1] + [1, 2, 0])
    assert len(read_cloud(tmp_path / "c.xyz")) == 200


@pytest.mark.parametrize(
    ("comment", "before"),
    [
        ("name x y z", 1), ("id x y z of the point", 1), ("left right x y z", 2), ("id x y z up", 1),
        ("field x y z", 1), ("fields x y z", 0),
    ],
)  # fmt: skip
def test_names_beside_other_words_are_names(tmp_path, comment, before):
    rows = ["7 " * before + f"{x} {y} {z}" for x, y, z in EXPECTED]
    (tmp_path / "a.txt").write_text("\n".join([f"# {comment}", *rows]))
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)


@pytest.mark.parametrize("head", ["date time x y z", "# date time x y z"])
def test_date_and_time_may_be_two_columns(tmp_path, head):
    rows = [f"2024-05-01 10:00:0{k} {x} {y} {z}" for k, (x, y, z) in enumerate(EXPECTED)]
    (tmp_path / "a.txt").write_text("\n".join([head, *rows]))
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)


@pytest.mark.parametrize(
    "head", ["Nr,East,North,Height", "Point Number Easting Northing Elevation", "Latitude,Longitude,Altitude"]
)
def test_names_of_other_columns_are_no_title(tmp_path, head):
    (tmp_path / "a.csv").write_text(f"{head}\n" + "7,1,2,3,4,5,6\n8,4,5,6,7,8,9\n")
    with pytest.raises(InputError, match=r"names of columns, but 7 fields in line 2"):
        read_points(tmp_path / "a.csv")


@pytest.mark.parametrize("first", ["1.0,,,,,,,,INIT", "1.0,null,null,null,null,null,null,null,lost", ",,,,,,,,INIT"])
def test_the_first_poses_may_be_missing(tmp_path, first):
    head = "t,x,y,z,qx,qy,qz,qw,state"
    (tmp_path / "a.csv").write_text(f"{head}\n{first}\n2.0,1,2,3,0,0,0,1,ok\n3.0,4,5,6,0,0,0,1,ok\n")
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.csv").position, EXPECTED)


def test_decimal_commas_beside_times(tmp_path):
    rows = ["time;x;y;z", "2024-05-01 10:00:00.25;1,5;2,5;3", "2024-05-01 10:00:01;4,5;5;6"]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), [[1.5, 2.5, 3], [4.5, 5, 6]])


@pytest.mark.parametrize("time", ["0000-00-00 00:00:00", "2024-02-30 10:00:00", "2024-05-01 23:59:60"])
def test_impossible_times_matter_only_where_they_are_wanted(tmp_path, time):
    (tmp_path / "a.csv").write_text(f"# made {time}\nx,y,z,gps\n1,2,3,{time}\n4,5,6,{time}\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), EXPECTED)


def test_a_remark_on_other_files_turns_no_quaternions(tmp_path):
    comment = "# stamp x y z qx qy qz qw (was qw qx qy qz before v2)"
    x, y, z, w = Rotation.from_euler("z", 50, degrees=True).as_quat()
    (tmp_path / "a.tum").write_text(f"{comment}\n0 1 2 3 {x} {y} {z} {w}\n1 4 5 6 {x} {y} {z} {w}\n")
    T = read_trajectory(tmp_path / "a.tum").T_world_drone[0]
    np.testing.assert_allclose(Rotation.from_matrix(T[:3, :3]).as_quat(), [x, y, z, w])


@pytest.mark.parametrize("names", ["easting,northing,elevation,h", "x,y,height,u", "x,y,z,x_local", "x,y,z,h"])
def test_rarer_names_give_way(tmp_path, names):
    (tmp_path / "a.csv").write_text(f"{names}\n1,2,3,9\n4,5,6,9\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), EXPECTED)


@pytest.mark.parametrize("rest", ["0,0,0", "255,128,100", "0,0,1"])
def test_whole_coordinates_with_colours_or_normals_are_points(tmp_path, rest):
    (tmp_path / "a.csv").write_text(f"1,2,3,{rest}\n4,5,6,{rest}\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), EXPECTED)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ncols 4\nnrows 2\nxllcorner 0\ncellsize 1\n1 2 3 4\n5 6 7 8\n", "a grid of heights; expected x, y and z"),
        ("x [m],y [m],z [m]\nmm,mm,mm\n1,2,3\n", "column x in m by its name, and in mm by the line below"),
    ],
)
def test_grids_and_two_units_are_refused(tmp_path, text, message):
    (tmp_path / "a.asc").write_text(text)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / "a.asc")


def test_a_plumb_tube_is_not_in_degrees(tmp_path):
    rng = np.random.default_rng(0)
    for width in (4e-3, 1e-16):
        np.save(tmp_path / "a.npy", rng.uniform([3, 4, 0], [3 + width, 4 + width, 12], (300, 3)))
        assert len(read_cloud(tmp_path / "a.npy")) == 300


ROW = "1.5 2.5 3.5 0 0 0 1"


@pytest.mark.parametrize("separator", [" ", "\t", ";", "; "])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize(
    ("times", "begin_s"),
    [
        (("12,5", "13"), 12.5),
        (("1700000000,250", "1700000001,250"), 1_700_000_000.25),
        (("2023-11-14T22:13:20,25", "2023-11-14T22:13:21,25"), 1_700_000_000.25),
        (("2023-11-14T22:13:20,25Z", "2023-11-14T22:13:21Z"), 1_700_000_000.25),
    ],
)
def test_times_have_decimal_commas(tmp_path, separator, decimal, times, begin_s):
    rows = [f"{time} {ROW}".replace(" ", separator) for time in times]
    (tmp_path / "a.tum").write_text("\n".join(rows).replace(".", decimal))
    trajectory = read_trajectory(tmp_path / "a.tum")
    assert trajectory.stamp_s[0] == begin_s
    np.testing.assert_array_equal(trajectory.position[0], [1.5, 2.5, 3.5])


@pytest.mark.parametrize("time", ["2023-11-14T22:13:20", '"2023-11-14T22:13:20,0"'])
def test_commas_after_times_separate_unless_they_are_quoted(tmp_path, time):
    rows = [f"{time},1,2,3,0,0,0,1", f"{time.replace('20', '21')},4,5,6,0,0,0,1".replace("2123", "2023")]
    (tmp_path / "a.csv").write_text("\n".join(["t,x,y,z,qx,qy,qz,qw", *rows]))
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.csv").position, EXPECTED)


def test_a_first_line_with_decimal_commas_and_a_label_is_no_title(tmp_path):
    (tmp_path / "a.txt").write_text("1,5 2.5 3 a\n4 5 6 b\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), [[1.5, 2.5, 3], [4, 5, 6]])


def test_commas_of_thousands_are_refused(tmp_path):
    (tmp_path / "a.tum").write_text(f"12,500;{ROW}\n13,500;{ROW}\n".replace(" ", ";"))
    with pytest.raises(InputError, match="line 1: '12,500'; expected a number"):
        read_trajectory(tmp_path / "a.tum")


@pytest.mark.parametrize("head", ["# written 2023-11-14 22:13:20 by odom\n", "Written 2023-11-14 22:13:20 by odom\n"])
@pytest.mark.parametrize("names", ["", "t,x,y,z,qx,qy,qz,qw\n"])
def test_times_in_comments_and_titles_do_not_tell_the_form_of_others(tmp_path, head, names):
    rows = "".join(f"2023-11-14T22:13:2{k},{k},2,3,0,0,0,1\n" for k in range(3))
    (tmp_path / "a.csv").write_text(head + names + rows)
    found = read_trajectory(tmp_path / "a.csv")
    np.testing.assert_array_equal(found.position, [[k, 2, 3] for k in range(3)])
    np.testing.assert_array_equal(found.stamp_s, 1_700_000_000 + np.arange(3))


@pytest.mark.parametrize("separator", [" ", "\t"])
def test_labels_with_commas_do_not_hide_decimal_commas(tmp_path, separator):
    rows = [f'{k},465 -4,144 8,262 "a,b"\n'.replace(" ", separator) for k in (1, 2)]
    (tmp_path / "a.txt").write_text("".join(rows))
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), [[1.465, -4.144, 8.262], [2.465, -4.144, 8.262]])


def test_numbers_that_begin_with_0_have_no_thousands(tmp_path):
    rows = [f"170000000{k}.5;2,465;-0,144;8,262;0,000;0,000;0,100;0,995\n" for k in range(3)]
    (tmp_path / "a.tum").write_text("".join(rows))
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.tum").position, [[2.465, -0.144, 8.262]] * 3)


def test_a_0_before_a_point_tells_that_no_point_is_of_thousands(tmp_path):
    (tmp_path / "a.tum").write_text("1,25;1.500;2.500;3.500;0;0;0.100;0.995\n2,5;4.500;5.500;6.500;0;0;0.100;0.995\n")
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.tum").stamp_s, [1.25, 2.5])


def test_points_of_thousands_beside_decimal_commas_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("5.400;0,25;12,5\n900;0,5;12,75\n")
    with pytest.raises(InputError, match="'0,25'; expected a number"):
        read_points(tmp_path / "a.txt")
