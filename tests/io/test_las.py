"""Formats of LAS and LAZ files."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList

from steelnb.core.errors import InputError
from steelnb.io.clouds import read_points

POINTS = np.random.default_rng(0).normal([5e5, 5e6, 300], size=(60_000, 3))


def save(path: Path, point_format: int = 6, version: str = "1.4", count: int = 500) -> Path:
    file = laspy.create(point_format=point_format, file_version=version)
    file.header.scales, file.header.offsets = [1e-3] * 3, [5e5, 5e6, 0]
    file.add_extra_dim(laspy.ExtraBytesParams("quality", "f4"))
    file.vlrs.append(laspy.VLR("other", 7, "", b"other"))
    file.x, file.y, file.z = POINTS[:count].T
    file.write(str(path))
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("point_format", "version"), [(3, "1.2"), (1, "1.3"), (6, "1.4"), (10, "1.4")])
def test_points_are_those_of_laspy(suffix: str, point_format: int, version: str, tmp_path: Path) -> None:
    path = save(tmp_path / f"a.{suffix}", point_format, version, len(POINTS))  # more than a block of LASzip
    np.testing.assert_array_equal(read_points(path), np.array(laspy.read(path).xyz))


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("point_format", "version"), [(3, "1.2"), (6, "1.4")])
def test_withheld_points_are_no_returns_unless_most_are(
    suffix: str, point_format: int, version: str, tmp_path: Path
) -> None:
    path = save(tmp_path / f"a.{suffix}", point_format, version)
    for count, expected in ((20, 20), (400, 0)):
        file = laspy.read(path)
        file.withheld = np.arange(500) < count
        file.write(str(path))
        assert np.isnan(read_points(path)).all(axis=1)[:count].sum() == expected
        assert np.isnan(read_points(path)).sum() == 3 * expected


@pytest.mark.parametrize(
    ("name", "at", "form", "value", "message"),
    [
        ("a.las", 247, "<Q", 2**40, ""), ("a.las", 96, "<I", 2**31, ""), ("a.las", 105, "<H", 3, ""),
        ("a.las", 131, "<d", np.nan, ""), ("a.las", 131, "<d", 0.0, ""), ("a.las", 155, "<d", np.inf, ""),
        ("a.las", 104, "<B", 99, ""), ("a.laz", 247, "<Q", 2**40, ""), ("a.laz", 104, "<B", 0x80 + 99, ""),
        ("a.laz", 100, "<I", 0, ""), ("old.las", 105, "<H", 27, "a header of .* points of format 1 and 27 bytes"),
        ("old.las", 107, "<I", 100, "500 points; expected 100"),
    ],
)  # fmt: skip
def test_headers_that_contradict_the_file_are_refused(
    name: str, at: int, form: str, value: float, message: str, tmp_path: Path
) -> None:
    path = save(tmp_path / name, *((1, "1.2") if name == "old.las" else (6, "1.4")))
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, at, value)
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: not a {path.suffix[1:].upper()} file of points: {message}"):
        read_points(path)


def geo_keys(keys: dict[int, int]) -> tuple[int, bytes]:
    """Number and content of a record of GeoTIFF's keys."""
    entries = [1, 1, 0, len(keys), *(number for key, value in keys.items() for number in (key, 0, 1, value))]
    return 34735, struct.pack(f"<{len(entries)}H", *entries)


KEYS = [
    ("degrees", {1024: 2}), ("US survey feet", {3076: 9003}), ("feet", {3076: 9002}), ("", {3076: 9001}),
    ("another unit than the metre .EPSG 2277.", {1024: 1, 3072: 2277}), ("", {1024: 1, 3072: 2277, 3076: 9001}),
    ("feet", {1024: 1, 3072: 3361, 3076: 9002}), ("geocentric axes", {1024: 3, 2048: 4978}),
    ("another unit than the metre .EPSG 6360.", {1024: 1, 3072: 32632, 4096: 6360}),
    ("another unit than the metre .EPSG 6966.", {1024: 1, 3072: 6966}), ("", {1024: 1, 3072: 32632, 4096: 5783}),
]  # fmt: skip
WKT = [
    ("US survey foot", 'PROJCS["a",GEOGCS["b",UNIT["degree",0.0174532925]],UNIT["US survey foot",0.3048006096]]'),
    ("US survey foot", 'PROJCS["a",GEOGCS["b",UNIT[ "degree" , 0.017 ]],UNIT[ "US survey foot" ,0.3048006096]]'),
    ("degrees", 'GEOGCS["WGS 84",DATUM["c",SPHEROID["d",6378137,298.257]],UNIT["degree",0.0174532925199433]]'),
    ("degrees", 'GEODCRS["a",DATUM["b",ELLIPSOID["d",6378137,298]],CS[geodetic,2],ANGLEUNIT["degree",0.017]]'),
    ("geocentric axes", 'GEOCCS["WGS 84",DATUM["a",SPHEROID["b",6378137,298.257]],PRIMEM["c",0],UNIT["metre",1]]'),
    ("", 'PROJCS["a",GEOGCS["b",UNIT["degree",0.0174532925]],UNIT["metre",1]]'),
    ("foot", 'COMPD_CS["a",PROJCS["b",GEOGCS["c",UNIT["degree",0.017]],UNIT["foot",0.3048]],VERT_CS["d",UNIT["m",1]]]'),
]


@pytest.mark.parametrize(
    ("unit", "number", "content"),
    [(unit, *geo_keys(keys)) for unit, keys in KEYS] + [(unit, 2112, text.encode() + b"\0") for unit, text in WKT],
)
@pytest.mark.parametrize(("name", "records"), [("a.las", "vlrs"), ("a.las", "evlrs"), ("a.laz", "evlrs")])
def test_coordinates_that_are_no_metres_are_refused(
    unit: str, number: int, content: bytes, name: str, records: str, tmp_path: Path
) -> None:
    file = laspy.create(point_format=6, file_version="1.4")
    setattr(file, records, VLRList([laspy.VLR("LASF_Projection", number, "", content)]))
    file.x, file.y, file.z = POINTS[:9].T
    file.write(str(tmp_path / name))
    if not unit:
        assert len(read_points(tmp_path / name)) == 9
        return
    with pytest.raises(InputError, match=f"coordinates in {unit}, as its coordinate system says; expected metres"):
        read_points(tmp_path / name)


@pytest.mark.parametrize("more", range(0, 40, 4))
def test_sizes_of_compressed_layers_are_checked(more: int, tmp_path: Path) -> None:
    """lazrs allocates what they say, and ends the process if it cannot."""
    path = save(tmp_path / "a.laz")
    content = bytearray(path.read_bytes())
    begin, stride = struct.unpack_from("<I", content, 96)[0], struct.unpack_from("<H", content, 105)[0]
    struct.pack_into("<I", content, begin + 8 + stride + 4 + more, 0xFFFFFFF0)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a.laz: not a LAZ file of points: its compressed points are damaged"):
        read_points(path)
