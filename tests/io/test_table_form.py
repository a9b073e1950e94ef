"""Text files as other programs write them: separators, titles, units, names, comments, times, decimal commas."""

import gzip

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_cloud, read_points
from steelnb.io.trajectories import read_trajectory

EXPECTED = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
NUMBERS = "1 2 3\n4 5 6\n"
ROW = "1.5 2.5 3.5 0 0 0 1"


@pytest.mark.parametrize(
    "content",
    [
        # separators, ends of lines, counts, encodings
        "1,2,3\n4,5,6\n", "1, 2, 3\n4, 5, 6\n", "1;2;3\n4;5;6", "1\t2\t3\n4\t5\t6\n", "sep=;\n1;2;3\n4;5;6\n",
        " 1  2 3 \r\n4 5 6\r\n\r\n \n", "1 2 3\r4 5 6\r", "\ufeff1 2 3\n4 5 6\n", "2\n1 2 3 255\n4 5 6 255\n",
        "1,2,3,\n4,5,6,\n", "x,y,z,\n1,2,3,\n4,5,6,\n", "1.0D+00 2.0D0 3.0d0\n4.0D0 5.0D0 0.6D+01\n",
        NUMBERS.encode("utf-16"), NUMBERS.encode("utf-16-le"), "Z;X;Y\n3;1,0;2\n6;4,0;5\n".encode("utf-16"),
        "x|y|z\n1|2|3\n4|5|6\n", "n|x|y|z|d\nP1 | 1,0 | 2,0 | 3,0 | 7 beams\nP2 | 4 | 5 | 6,0 | b\n",
        "1 2 3 7|8|9|9\n4 5 6 7|8|9|9\n", "x,y,z,list\n1,2,3,1|2|3|4\n4,5,6,7|8|9|9\n",
        # decimal commas
        "Z;X;Y\n3;1,0;2\n6;4,0;5\n", "1,0 2,0 3,0\n4 5,0 6\n", '"1,0","2,0","3,0"\n"4,0","5","6,0"\n',
        "1 2 3\n4,0 5,0 6,0\n", "1,0 2.0 3 a\n4 5 6 b\n",
        # names of columns, in lines, in comments, as pandas writes none
        "x,y,z\n1,2,3\n4,5,6\n", "ID\tX (m)\tY (m)\tZ (m)\n7\t1\t2\t3\n8\t4\t5\t6\n",
        'name,"Points:0","Points:1","Points:2"\nA,1,2,3\nB,4,5,6\n', "x,y,z\n1,2,3\n#9,9,9\n4,5,6\n",
        "//X Y Z R\n1 2 3 9\n4 5 6 9\n", "# my scan one\n# z y x\n3 2 1\n6 5 4", "1 2 3 # a\n// b\n% c\n4 5 6",
        "# name x y z\n7 1 2 3\n7 4 5 6", "# id x y z of it\n7 1 2 3\n7 4 5 6", "# id x y z up\n7 1 2 3\n7 4 5 6",
        "# left right x y z\n7 7 1 2 3\n7 7 4 5 6", "# field x y z\n7 1 2 3\n7 4 5 6", "# fields x y z\n1 2 3\n4 5 6",
        ",0,1,2\n0,1.0,2.0,3.0\n1,4.0,5.0,6.0\n", "0,1,2\n1.0,2.0,3.0\n4.0,5.0,6.0\n",
        "easting,northing,elevation,h\n1,2,3,9\n4,5,6,9\n", "x,y,height,u\n1,2,3,9\n4,5,6,9\n",
        "x,y,z,x_local\n1,2,3,9\n4,5,6,9\n", "x,y,z,h\n1,2,3,9\n4,5,6,9\n",
        # titles, units and prose, also those that begin like another kind of file
        f"My scan\n{NUMBERS}", f"Survey 2023\n{NUMBERS}", f"Survey of the tower, station 3\nx y z\n{NUMBERS}",
        f"; made by a scanner\n{NUMBERS}", f"x y z\nm m m\n{NUMBERS}", f"x y z\n[m] [m] [m]\n{NUMBERS}",
        f"X (m) Y (m) Z (m)\n{NUMBERS}", f"x [m] y [m] z [m]\nm m m\n{NUMBERS}",
        f"# range unit: mm\n{NUMBERS}", f"# units: mm/s\n{NUMBERS}", f"# units: m\n# units: s\n{NUMBERS}",
        "# units: mm\nx [m],y [m],z [m]\n1,2,3\n4,5,6\n",
        f"# position is x\n{NUMBERS}", f"# columns x y z\n{NUMBERS}", f"# the fields are x, y, z\n{NUMBERS}",
        "# x right y down z forward\n1 2 3 10 20 30\n4 5 6 10 20 30\n",
        "# looks along x and y of the tower\n1 2 3 10 20 30\n4 5 6 10 20 30\n",
        f"Off\n{NUMBERS}", f"off\n{NUMBERS}", f"BZh9\n{NUMBERS}", f"\n\r\r\n{NUMBERS}", "bzh,x,y,z\n7,1,2,3\n7,4,5,6\n",
        "# long\n" * 10_000 + NUMBERS,
        # colours and normals
        "1,2,3,0,0,0\n4,5,6,0,0,0\n", "1,2,3,255,128,100\n4,5,6,255,128,100\n", "1,2,3,0,0,1\n4,5,6,0,0,1\n",
        # lists of any length, and times, which may be impossible
        "# a\n# POINT3D_ID, X, Y, Z, R, ERROR, TRACK[] as (IMAGE_ID, IDX)\n9 1 2 3 0 .5 1 2\n4 4 5 6 0 .5 1 2 3 4\n",
        "# POINT3D_ID, X, Y, Z, R, G, B, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n9 1 2 3 0 0 0\n4 4 5 6 0 0 0\n",
        "stamp,x,y,z\n12:00 h,1,2,3\n12:01 h,4,5,6\n",
        "date time x y z\n2024-05-01 10:00:00 1 2 3\n2024-05-01 10:00:01 4 5 6",
        "# date time x y z\n2024-05-01 10:00:00 1 2 3\n2024-05-01 10:00:01 4 5 6",
        *(f"# made {time}\nx,y,z,gps\n1,2,3,{time}\n4,5,6,{time}\n" for time in (
            "0000-00-00 00:00:00", "2024-02-30 10:00:00", "2024-05-01 23:59:60")),
    ],
)  # fmt: skip
def test_texts_of_many_programs_give_the_same_points(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content if isinstance(content, bytes) else content.encode())
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt"), EXPECTED)


@pytest.mark.parametrize(
    "names",
    [
        "E,N,H", "east,north,up", "x,y,elev", "X:3,Y:3,Z:3", "Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2",
        "Coordinates:0,Coordinates:1,Coordinates:2", "points.x,points.y,points.z", "X1 (m),Y1 (m),Z1 (m)",
        "x in m,y in m,z in m", "x_local,y_local,z_local", "Ost,Nord,Hoehe", "Easting,Northing,Elevation",
    ],
)  # fmt: skip
def test_names_of_axes(tmp_path, names):
    x, y, z = names.split(",")
    (tmp_path / "a.csv").write_text(f"id,{y},{x},{z}\n7,2,1,3\n8,5,4,6\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), EXPECTED)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("time;x;y;z\n2024-05-01 10:00:00.25;1,5;2,5;3\n2024-05-01 10:00:01;4,5;5;6", [[1.5, 2.5, 3], [4.5, 5, 6]]),
        ('1,465 -4,144 8,262 "a,b"\n2,465 -4,144 8,262 "a,b"\n', [[1.465, -4.144, 8.262], [2.465, -4.144, 8.262]]),
        ('1,465\t-4,144\t8,262\t"a,b"\n', [[1.465, -4.144, 8.262]]),
        (" ".join("1" * 60) + "\n" + " ".join("2" * 60) + "\n" + " ".join("3" * 60), [[1, 2, 3]] * 60),
    ],
)
def test_texts_of_other_points(tmp_path, content, expected):
    (tmp_path / "a.csv").write_text(content)
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv"), expected)


@pytest.mark.parametrize(("sign", "point"), [(" ", "."), (",", "."), (";", "."), (";", ","), ("\t", ".")])
def test_missing_numbers_in_the_first_line_are_no_names(tmp_path, sign, point):
    missing = sign.join(["nan"] * 3) + "\n"
    number = sign.join(["1.5", "2.5", "3.5"]).replace(".", point) + "\n"
    (tmp_path / "a.txt").write_text(2 * missing + 3 * number)
    read = read_points(tmp_path / "a.txt")
    np.testing.assert_array_equal(np.isnan(read), [[True] * 3] * 2 + [[False] * 3] * 3)
    np.testing.assert_array_equal(read[2:], [[1.5, 2.5, 3.5]] * 3)


def test_missing_numbers_and_numbers_that_are_no_coordinates_are_no_returns(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n,,\nnan,NaN,-nan\n1.#QNAN,-1.#IND,1.#INF\n3e38,1,2\n4,5,6\n7,8,9\n")
    valid = np.isfinite(read_points(tmp_path / "a.csv"))
    np.testing.assert_array_equal(valid.all(axis=1), [True, False, False, False, False, True, True])
    assert read_cloud(tmp_path / "a.csv").invalid == 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1,2,3\n4,5\n", "line 2 has 2 fields, '4,5'; expected 3"),
        ("1 2 3\n4 5 6 7\n", "line 2 has 4 fields"),
        ("1,2,3,9\n4,5,6\n", "line 2 has 3 fields"),
        ("1,2,3\n" * 11_000 + "1,5,2,5,3,5\n", "line 11001 has 6 fields"),
        ("x y z\n1 2 3.5\n1 2 3,5\n", "line 3: '3,5'; expected a number"),
        ("3\n1 2 3\n4 5 6\n", "2 lines of numbers; expected 3"),
        ("x_mm,y_mm,z_mm\n1,2,3\n", "in mm; expected metres"),
        (f"# Units: US survey feet\n{NUMBERS}", "'Units: US survey feet' in its header; expected metres"),
        (f"Export of tower, units: mm\n{NUMBERS}", "'Export of tower, units: mm' in its header; expected metres"),
        (f"# x y z, units are inches\n{NUMBERS}", "'x y z, units are inches' in its header; expected metres"),
        ("lat,lon,alt\n48,11,500\n", "columns lat, lon, alt; expected x, y and z"),
        ("x,x,y,z\n1,2,3,4\n", "columns x and x"),
        ("x y z\n1 2 3 4\n", "3 names of columns, but 4 fields in line 2"),
        (
            "".join(f"{k} 1.5 2.5 3.5\n" for k in range(12)),
            "first column counts the lines in steps of 1; expected x, y",
        ),
        ("".join(f"{0.1 * k:.1f} 1.5 2.5 3.5\n" for k in range(12)), "in steps of 0.1; expected x, y and z first"),
        ('name,x,y,z\nA,1,2,3\n"B,4,5,6\nC",7,8,9\n', "line 3 has a quotation mark that is not closed"),
        ("name,x,y,z\n#1,1,2,3\nB2,4,5,6\n", "line 2 begins like a comment, but has all 4 fields"),
        ("name,x,y,z\nA,1,2,3\n//B,4,5,6\n", "line 3 begins like a comment"),
        (" ".join(["1"] * 60), "1 lines of 60 numbers; expected x, y and z in each line"),
        (" ".join(["1"] * 6000), "line 1 has 6000 numbers; expected those of one point"),
        ("1_0 2 3\n4 5 6\n", "expected numbers|expected a number"),
        ("1 2 3\n4 5 6\n\0\0\0", "byte 12 is zero; expected plain text"),
        (gzip.compress(NUMBERS.encode(), mtime=0), "compressed by gzip; expected plain text"),
        ('x,y,z\n"1,234.50","2,345.60","3,456.70"\n', 'no line of .* without signs of thousands, unlike \'"1,234.50"'),
        ("a b c\n", "no line of numbers"),
        ("", "no line of numbers"),
        ("1 2\n", "2 numbers in line 1"),
        ("1e30 0 1\n0 2e30 0\n1 2 3\n", "2 points that are not within 1e-30 to 1e.08 m"),
        (f"x y z\nmm mm mm\n{NUMBERS}", "x, y and z in mm; expected metres"),
        (f"x y z\na b c\n{NUMBERS}", "line 2: 'a b c'; expected numbers"),
        (f"My tower scan\n{NUMBERS}", "columns my, tower, scan; expected x, y and z"),
        (f"# x y stamp\n{NUMBERS}", "columns x, y, stamp; expected x, y and z"),
        *(
            (f"{names}\n7,1,2,3,4,5,6\n8,4,5,6,7,8,9\n", "names of columns, but 7 fields in line 2")
            for names in ("Nr,East,Height", "Point Number Easting Northing Elevation", "Latitude,Longitude,Altitude")
        ),
        ("ncols 4\nnrows 2\nxllcorner 0\ncellsize 1\n1 2 3 4\n5 6 7 8\n", "a grid of heights; expected x, y and z"),
        ("x [m],y [m],z [m]\nmm,mm,mm\n1,2,3\n", "column x in m by its name, and in mm by the line below"),
        ("5.400;0,25;12,5\n900;0,5;12,75\n", "'0,25'; expected a number"),
        ("12,500;1.5;2.5\n13,500;4.5;5.5\n", "line 1: '12,500'; expected a number"),
        *(
            (text, "whole numbers between commas, which may be decimal ones")
            for text in (
                "1,25,4,50,2,75\n3,25,1,50,0,05\n",
                "1,25,4,50,300,75\n3,25,1,50,400,35\n",
                "1,25,4,50,2,75\n1,35,4,55,2,85\n" * 50,
            )
        ),
    ],
)
def test_unclear_texts_are_refused_with_their_line(tmp_path, content, message):
    (tmp_path / "a.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=rf"a.csv: not a CSV file of points: .*({message})"):
        read_points(tmp_path / "a.csv")


def test_coordinates_in_degrees_are_refused_and_a_plumb_tube_is_none(tmp_path):
    points = np.random.default_rng(0).uniform(0, [5, 5, 20], (200, 3))
    np.savetxt(tmp_path / "a.xyz", points / [74_300, 110_540, 1] + [11.5, 48.1, 500], fmt="%.9f")
    with pytest.raises(InputError, match="longitude and latitude in degrees; expected metres"):
        read_cloud(tmp_path / "a.xyz")
    site = points * [100 / 74_300, 100 / 110_540, 1] + [11.5, 48.1, 500]
    np.save(tmp_path / "b.npy", site)
    with pytest.raises(InputError, match="longitude and latitude in degrees; expected metres"):
        read_cloud(tmp_path / "b.npy")
    corridor = points * [500 / 74_300, 500 / 110_540, 3] + [11.5, 48.1, 500]
    np.save(tmp_path / "c.npy", corridor)
    with pytest.raises(InputError, match="longitude and latitude in degrees; expected metres"):
        read_cloud(tmp_path / "c.npy")
    for width_m in (4e-3, 1e-16, 0):
        np.save(tmp_path / "a.npy", points * [width_m / 5, width_m / 5, 1] + [3, 4, 0])
        assert len(read_cloud(tmp_path / "a.npy")) == 200


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


HEADED = "t,x,y,z,qx,qy,qz,qw\n"
FIRST, SECOND = "1,2,3,0,0,0,1", "4,5,6,0,0,0,1"


@pytest.mark.parametrize(
    ("begin_s", "content"),
    [
        *(
            (1_700_000_000.25, f"{HEADED}{first},{FIRST}\n{second},{SECOND}\n".replace(",", separator))
            for separator in ",;"
            for first, second in (
                ("2023-11-14T22:13:20.25Z", "2023-11-14T22:13:20.35Z"),
                ("2023-11-14 22:13:20.25", "2023-11-14 22:13:20.35"),
                ("2023-11-15T00:13:20.25+02:00", "2023-11-15T00:13:20.35+02:00"),
            )
        ),
        *(
            (1_700_000_000, f"{HEADED}{first},{FIRST}\n{second},{SECOND}\n")
            for first, second in (
                ("2023-11-14T22:13:20", "2023-11-14T22:13:21"),
                ('"2023-11-14T22:13:20,0"', '"2023-11-14T22:13:21,0"'),
            )
        ),
        # times in comments and titles do not tell the form of others
        *(
            (1_700_000_000, f"{title}{names}2023-11-14T22:13:20,{FIRST}\n2023-11-14T22:13:21,{SECOND}\n")
            for title in ("# written 2023-11-14 22:13:20 by odom\n", "Written 2023-11-14 22:13:20 by odom\n")
            for names in ("", HEADED)
        ),
        # the first poses may be missing
        *(
            (2, f"{HEADED[:-1]},state\n{missing}\n2.0,{FIRST},ok\n3.0,{SECOND},ok\n")
            for missing in ("1.0,,,,,,,,INIT", "1.0,null,null,null,null,null,null,null,lost", ",,,,,,,,INIT")
        ),
        (0, f"# truth of drone x forward z up\n0,{FIRST}\n1,{SECOND}\n".replace(",", " ")),
        # a 0 before a sign tells that it is not one of thousands
        (1.25, "1,25;1.000;2.000;3.000;0;0;0.000;1.000\n2,5;4.000;5.000;6.000;0;0;0.000;1.000\n"),
        (1e9 + 0.5, "1000000000.5;1,000;2,000;3,000;0;0;0,000;1,000\n1000000001.5;4,000;5,000;6,000;0;0;0,0;1,0\n"),
    ],
)  # fmt: skip
def test_times_and_signs_of_many_programs_give_the_same_poses(tmp_path, begin_s, content):
    (tmp_path / "a.csv").write_text(content)
    found = read_trajectory(tmp_path / "a.csv")
    assert found.stamp_s[0] == begin_s
    np.testing.assert_array_equal(found.position, EXPECTED)
