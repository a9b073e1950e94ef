"""Files of points are read as they say, as the user states, or refused with the option to write."""

import io
import os
import struct
import time
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_cloud, read_points, write_map
from steelnb.settings import RecordingOptions
from tests.io.samples import TRIALS

POINTS = np.round(np.random.default_rng(0).uniform(1, 9, (40, 3)), 3)
UTM = np.array([299100.0, 2801400.0, 1900.0])
NONE = RecordingOptions()
FORMATS = (
    "text.pcd", "binary.pcd", "compressed.pcd", "text.ply", "binary.ply", "a.las", "a.laz", "a.npy", "a.xyz", "a.csv",
)  # fmt: skip


def save(path: Path, points: np.ndarray = POINTS, kind: str = "f8") -> Path:
    encodings = {"text.pcd": Encoding.ASCII, "compressed.pcd": Encoding("binary_compressed")}
    if path.suffix == ".pcd":
        types = (np.dtype(kind).newbyteorder("=").type,) * 3
        cloud = PointCloud.from_points([column.astype(kind) for column in points.T], ("x", "y", "z"), types)
        cloud.save(path, encodings.get(path.name, Encoding.BINARY))
    elif path.name == "binary.ply":
        write_map(path, points, np.zeros(len(points), dtype=int))
    elif path.suffix == ".ply":
        properties = "".join(f"property double {axis}\n" for axis in "xyz")
        rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
        path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{properties}end_header\n{rows}")
    elif path.suffix in (".las", ".laz"):
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = np.full(3, 1e-3), np.floor(points.min(axis=0))
        las = laspy.LasData(header)
        las.xyz = points
        las.write(path)
    elif path.suffix == ".npy":
        np.save(path, points.astype(kind))
    else:
        np.savetxt(path, points, fmt="%.17g", delimiter="," if path.suffix == ".csv" else " ")
    return path


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
def test_what_is_written_is_read_and_half_of_it_refused(name: str, origin: np.ndarray, tmp_path: Path) -> None:
    path = save(tmp_path / name, POINTS + origin)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points + cloud.origin, POINTS + origin, atol=1e-9)
    assert (cloud.invalid, cloud.duplicates) == (0, 0)
    assert np.abs(cloud.points).max() < 200
    np.testing.assert_allclose(cloud.extent_m, np.ptp(POINTS, axis=0), atol=1e-9)
    assert "1 m" in cloud.facts["unit"]
    whole = path.read_bytes()
    end = len(whole) // 2 - 3
    if name in ("a.xyz", "a.csv"):  # a line that ends within its last number cannot be told from a whole one
        end = whole[:end].rfind(b"\n") + 4
    path.write_bytes(whole[:end])
    with pytest.raises(InputError, match=path.name):
        read_cloud(path)


@pytest.mark.parametrize("name", FORMATS)
def test_a_unit_scales_the_points_and_the_metre_changes_nothing(name: str, tmp_path: Path) -> None:
    path = save(tmp_path / name)
    plain = read_points(path, NONE)
    np.testing.assert_array_equal(read_points(path, RecordingOptions(unit="m")), plain)
    np.testing.assert_allclose(read_points(path, RecordingOptions(unit="0.25mm")), plain * 0.25e-3)
    assert "--unit" in read_cloud(path, unit="ft").facts["unit"]


def test_an_origin_far_away_shifts_the_cloud_to_the_bit(tmp_path: Path) -> None:
    near, far = (read_cloud(save(tmp_path / "a.npy", POINTS + at)) for at in (UTM, UTM + np.array([1e5, 0, 0])))
    np.testing.assert_array_equal(near.points, far.points)
    np.testing.assert_array_equal(far.origin - near.origin, [1e5, 0, 0])


def test_points_without_a_return_and_duplicates_are_dropped_and_counted(tmp_path: Path) -> None:
    without = [[np.nan, 1, 1], [1, np.inf, 1], [0, 0, 0], [1, 1, np.finfo(np.float32).max]]
    cloud = read_cloud(save(tmp_path / "a.npy", np.concatenate([POINTS, without, POINTS[:2], [[0.0, 1, 0]]])))
    np.testing.assert_array_equal(cloud.points, [*POINTS, [0, 1, 0]])
    assert (cloud.invalid, cloud.duplicates) == (4, 2)
    with pytest.raises(InputError, match="at least two"):
        read_cloud(save(tmp_path / "a.npy", np.ones((9, 3))))


@pytest.mark.parametrize("name", ["a.npy", "a.pcd"])
def test_scans_keep_their_rows(name: str, tmp_path: Path) -> None:
    rows = POINTS.reshape(5, 8, 3).copy()
    rows[1, 2] = np.nan
    path = save(tmp_path / name, rows.reshape(-1, 3))
    if name == "a.npy":
        np.save(path, rows)
    else:
        path.write_bytes(path.read_bytes().replace(b"WIDTH 40\nHEIGHT 1", b"WIDTH 8\nHEIGHT 5"))
    np.testing.assert_array_equal(read_points(path, NONE), rows)


def pcd(data: str = "binary", **changed: str | None) -> bytes:
    lines = {"VERSION": "0.7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"}
    lines |= {"WIDTH": "40", "HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": "40", "DATA": data} | changed
    return "".join(f"{name} {value}\n" for name, value in lines.items() if value is not None).encode()


PADDED = np.zeros(40, [("x", "<f4"), ("a", "S4"), ("y", "<f4"), ("z", "<f4"), ("i", "<u2"), ("b", "S10")])
for axis, values in zip("xyz", POINTS.T, strict=True):
    PADDED[axis] = values
FLOATS = POINTS.astype("<f4").tobytes()
PADDING: dict[str, str | None] = {
    "FIELDS": "x _ y z ring _", "SIZE": "4 1 4 4 2 1", "TYPE": "F U F F U U", "COUNT": "1 4 1 1 1 10",
}  # fmt: skip


@pytest.mark.parametrize(
    "content",
    [
        pcd(**PADDING) + PADDED.tobytes(),
        pcd(POINTS=None) + FLOATS,
        pcd(COUNT=None, VERSION=None, VIEWPOINT=None) + FLOATS,
        b"# a comment\n\n" + pcd().replace(b"\n", b"\r\n") + FLOATS,
        pcd(WIDTH=None, HEIGHT=None) + FLOATS + b"\0" * 4096,
        pcd("ascii") + b"".join(b"%r  %r\t%r\r\n" % tuple(row) for row in POINTS.tolist()) + b"\n",
    ],
    ids=["padding", "no points", "no count", "windows", "only points", "text"],
)
def test_headers_of_pcd_imply_what_they_leave_out(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd", NONE), POINTS, rtol=1e-6)


@pytest.mark.parametrize("kind", ["f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"])
@pytest.mark.parametrize("name", ["text.pcd", "binary.pcd", "compressed.pcd"])
def test_every_type_of_pcd_is_read(kind: str, name: str, tmp_path: Path) -> None:
    whole = np.round(POINTS)
    np.testing.assert_array_equal(read_points(save(tmp_path / name, whole, kind), NONE), whole)


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (pcd(FIELDS="x y range") + FLOATS, "x, y and z"),
        (pcd(SIZE="4 4") + FLOATS, "SIZE"),
        (pcd(POINTS="41") + FLOATS, "WIDTH"),
        (pcd(POINTS="80", WIDTH="80") + FLOATS, "80"),
        (pcd("ascii") + b"1 2 3\n", "40"),
        (pcd("ascii", WIDTH="2", POINTS="2") + b"1 2 3\n1 2\n", "line 12"),
        (pcd("binary_compressed") + struct.pack("<II", 19, 480) + b"\0" * 9, "truncated"),
        (b"VERSION 0.7\n", "DATA"),
    ],
)
def test_contradictions_of_pcd_are_refused(content: bytes, names: str, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.pcd.*{names}"):
        read_points(tmp_path / "a.pcd", NONE)


def test_a_viewpoint_is_said_and_a_mesh_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.pcd")
    assert "viewpoint" not in read_cloud(path).facts
    path.write_bytes(path.read_bytes().replace(b"VIEWPOINT 0.0 0.0", b"VIEWPOINT 0.0 4.5"))
    cloud = read_cloud(path)
    assert "4.5" in cloud.facts["viewpoint"]
    np.testing.assert_array_equal(cloud.points, POINTS)
    mesh = save(tmp_path / "a.ply")
    face = "element face 1\nproperty list uchar int vertex_indices\nend_header"
    mesh.write_text(mesh.read_text().replace("end_header", face) + "3 0 1 2\n")
    with pytest.raises(InputError, match="mesh: 1 faces"):
        read_cloud(mesh)


def test_withheld_points_of_las_are_no_returns(tmp_path: Path) -> None:
    path = save(tmp_path / "a.laz")
    las = laspy.read(path)
    las.withheld[:3] = 1
    las.write(path)
    assert np.isnan(read_points(path, NONE)).any(axis=1).tolist() == [True] * 3 + [False] * 37


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_a_header_of_las_with_more_records_than_its_file_holds_is_refused_at_once(name: str, tmp_path: Path) -> None:
    whole = bytearray(save(tmp_path / name).read_bytes())
    whole[103] = 255  # the number of records: 4 billion, which took minutes
    (tmp_path / name).write_bytes(whole)
    began_s = time.perf_counter()
    with pytest.raises(InputError, match="records"):
        read_points(tmp_path / name, NONE)
    assert time.perf_counter() - began_s < 5


def test_chunks_of_laz_that_are_said_to_be_huge_or_many_do_not_end_the_process(tmp_path: Path) -> None:
    path = save(tmp_path / "a.laz")
    whole, chunk = path.read_bytes(), struct.pack("<I", 50_000)
    path.write_bytes(whole.replace(chunk, chunk[:3] + b"\x7f"))
    np.testing.assert_allclose(read_points(path, NONE), POINTS)
    (begin,) = struct.unpack_from("<I", whole, 96)
    (table,) = struct.unpack_from("<q", whole, begin)
    path.write_bytes(whole[: table + 7] + b"\xff" + whole[table + 8 :])
    with pytest.raises(InputError, match="chunks"):
        read_points(path, NONE)


WKT = 'PROJCS["a",GEOGCS["b",UNIT["degree",0.0174532925]],UNIT["US survey foot",0.304800609601219]]'


@pytest.mark.parametrize("wkt", [WKT, WKT.replace("US survey foot", "foot").replace("609601219", "")])
def test_feet_that_a_coordinate_system_says_are_refused_until_stated(wkt: str, tmp_path: Path) -> None:
    path = save(tmp_path / "a.las")
    las = laspy.read(path)
    las.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las.write(path)
    with pytest.raises(InputError, match="--unit ft"):
        read_cloud(path)
    np.testing.assert_allclose(read_cloud(path, unit="ft").points, POINTS * 0.3048)
    las.vlrs[-1].string = wkt.replace("US survey foot", "metre").replace("foot", "metre").replace("0.3048", "1.0 ")
    las.write(path)
    np.testing.assert_allclose(read_cloud(path).points, POINTS)


ROWS = [f"{x} {y} {z}" for x, y, z in POINTS.tolist()]


@pytest.mark.parametrize(
    "text",
    [
        "\n".join(ROWS),
        "\ufeff" + "\r\n".join(ROWS) + "\r\n\r\n",
        "\n".join(row.replace(" ", ", ") for row in ROWS),
        "\n".join(row.replace(" ", ";") for row in ROWS),
        "\n".join(row.replace(" ", "\t") for row in ROWS),
        "# of a scanner\n//X Y Z\n" + "\n".join(ROWS),
        "\n".join(["40", *ROWS]),
        '"Z [m]","X [m]","label","Y [m]"\n' + "\n".join(f"{z},{x},#3,{y}" for x, y, z in POINTS.tolist()),
        "x(mm);y(mm);z(mm)\n" + "\n".join(f"{1e3 * x};{1e3 * y};{1e3 * z}" for x, y, z in POINTS.tolist()),
    ],
)
def test_text_is_read_by_its_names_or_three_columns(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text.replace("#3", "steel"), encoding="utf-8")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.txt").points, POINTS, rtol=1e-12)


@pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.npy"])
@pytest.mark.parametrize("columns", ["t,x,y,z", "x,y,z,_", "_,_,_,x,y,z", "z,_,y,x,t"])
def test_columns_without_names_are_refused_until_stated(name: str, columns: str, tmp_path: Path) -> None:
    order = columns.split(",")
    others = np.random.default_rng(1).uniform(0, 9, (40, len(order)))
    others[:, [order.index(axis) for axis in "xyz"]] = POINTS
    path = save(tmp_path / name, others)
    with pytest.raises(InputError, match="--columns"):
        read_cloud(path)
    np.testing.assert_array_equal(read_cloud(path, columns=order).points, POINTS)
    with pytest.raises(InputError, match="--columns"):
        read_cloud(path, columns=[*order, "_"])


def test_a_bar_along_x_does_not_count_its_lines(tmp_path: Path) -> None:
    bar = np.column_stack([0.05 * np.arange(1, 100), np.zeros((99, 2))])
    np.testing.assert_allclose(read_cloud(save(tmp_path / "bar.xyz", bar)).points, bar)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1,200 2,300 3,400\n1,300 2,300 3,400\n", "expected"),
        ("1,200, 2,300, 3,400\n1,300, 2,300, 3,400\n", "--columns"),
        ("1,2;2,3;3,4\n1,3;2,3;3,4\n", "decimal point"),
        ("1 2 3\n1 2\n", "line 2"),
        ("1 2 3\n1 2 3 4\n", "line 2"),
        ("1 2 3\n1 two 3\n", "two"),
        ("easting northing height\n1 2 3\n", "--columns"),
        ("x y z\n1 2 3 4\n", "x y z"),
        ("x[m],y[m],z[ft]\n1,2,3\n", "one unit"),
        ("7\n1 2 3\n1 2 4\n", "expected 7"),
        ("", "numbers.*empty"),
        ("\n\n<html><head>\nno tower\n" * 99, "numbers.*'<html><head>'"),
        ("x" * 999, f"numbers.*'{'x' * 70}.{{,40}}$"),
        ("\0\0\1", "binary"),
    ],
)
def test_unclear_text_is_refused_in_one_line(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=says) as refused:
        read_cloud(tmp_path / "a.csv")
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize("shape", [(3, 40), (40, 2), (40, 5), (2, 5, 4), (40,)])
def test_arrays_of_another_shape_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones(shape))
    with pytest.raises(InputError, match="expected"):
        read_points(tmp_path / "a.npy", NONE)


@pytest.mark.parametrize("stored", [np.ones((9, 3), "u1"), np.ones((9, 3), "U3"), np.ones(9, [("x", "f4")])])
def test_arrays_of_another_type_are_refused(stored: Any, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", stored)
    with pytest.raises(InputError, match="expected"):
        read_points(tmp_path / "a.npy", NONE)


def test_an_array_with_names_is_read_by_them(tmp_path: Path) -> None:
    named = np.zeros(40, [("t", "f8"), ("Z", "f4"), ("y", "f8"), ("x", "i2")])
    named["t"], named["Z"], named["y"], named["x"] = 7, *np.round(POINTS).T[::-1]
    np.save(tmp_path / "a.npy", named)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy", NONE), np.round(POINTS))


def test_other_files_and_folders_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    for name in ("", "a.e57", "pipe.ply", "missing.ply"):
        with pytest.raises(InputError, match=r"expected .*"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_give_points_or_one_line(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, rng = save(tmp_path / name), np.random.default_rng(0)
    whole, refused = path.read_bytes(), 0
    for _ in range(TRIALS):
        damaged = bytearray(whole[: int(rng.integers(len(whole)))] if rng.random() < 0.3 else whole)
        for at in rng.integers(0, max(len(damaged), 1), 3 if damaged else 0):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            assert len(read_points(path, NONE)) > 0
        except InputError as fault:
            refused += str(fault).count("\n") == 0
    assert refused > TRIALS / 10
    assert capfd.readouterr() == ("", "")


def test_a_map_is_read_by_others(tmp_path: Path) -> None:
    from trimesh.exchange.ply import load_ply

    write_map(tmp_path / "map.ply", POINTS + UTM, np.arange(40) - 1)
    found = load_ply(io.BytesIO((tmp_path / "map.ply").read_bytes()))
    np.testing.assert_array_equal(found["vertices"], POINTS + UTM)
    np.testing.assert_array_equal(found["metadata"]["_ply_raw"]["vertex"]["data"]["bar"], np.arange(40) - 1)
