"""Reader of point files: PLY, PCD, LAS, LAZ, NPY and text, of which what they leave open is stated. Writer of PLY.

PLY is read by trimesh, PCD by pypcd4, LAS by laspy and text by pandas. Sizes are checked before a reader that would
read less, or ask for much memory.
"""

import io
import re
import struct
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from steelnb.core.checks import COORDINATE_MAX_M, check_length, checked_array, shown
from steelnb.core.errors import InputError
from steelnb.core.files import new_file, reading
from steelnb.core.types import Array, IntArray, shift_of, translated
from steelnb.settings import RecordingOptions
from steelnb.settings.recording import METRES, metres_of

IDENTITY = ["0", "0", "0", "1", "0", "0", "0"]
"""VIEWPOINT of a PCD file without one: position, quaternion wxyz."""
FEET, DEGREES = (9002, 9003), 2
"""GeoTIFF's codes of the foot and the US survey foot, and of a system in longitude and latitude."""
LAS_RECORDS_AT, LAS_RECORD = 100, 54
"""Byte of a LAS file's header with the number of its variable length records, and their minimum size in bytes (LAS 1.4
R15, 2.4 and 2.5)."""
NAMED = "expected x, y and z, named by --columns t,x,y,z (in order, _ for one to skip)"
UNIT = re.compile(r"(.*?)(?: *[\[(](\D*)[\])]|_(s|ms|us|ns|m|mm|cm))?")
"""The name of a column and its unit, in brackets or after an underscore."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Distinct finite points of a file.

    ``points (N, 3)`` in metres are relative to ``origin (3,)``: add it to results derived from them. The origin is zero
    unless the coordinates are large (UTM), and a multiple of 100 m. ``invalid`` counts the dropped points without a
    return, ``duplicates`` the dropped exact duplicates. ``facts``: what was read, the unit, and a viewpoint.
    """

    points: Array
    origin: Array
    invalid: int
    duplicates: int
    facts: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def extent_m(self) -> Array:
        """Size of the box around all points, ``(3,)`` metres."""
        size: Array = np.ptp(self.points, axis=0)
        return size


def read_cloud(path: Path | str, *, unit: str | None = None, columns: Sequence[str] = ()) -> Cloud:
    """Read the points of a PLY, PCD, LAS, LAZ, NPY or text file (XYZ, TXT, CSV, ASC, PTS), chosen by the suffix.

    ``unit`` of the coordinates, such as "mm" or "ft": by default metres, or what the names of columns say. ``columns``:
    names of the columns of a text file or an array, "_" for one to skip, if it has other than three and no names.

    Raises `InputError` for a missing, truncated or ambiguous file, a mesh, and fewer than two distinct points.
    """
    options = RecordingOptions(unit=unit, columns=tuple(columns))
    points, facts = _read(Path(path), options)
    points = points.reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    distinct = finite[~pd.DataFrame(finite).duplicated().to_numpy()]
    if len(distinct) < 2:
        raise InputError(f"{path}: {len(distinct)} distinct finite points of {len(points)}; expected at least two")
    origin = shift_of(distinct.mean(axis=0))
    shifted = translated(distinct, -origin) if origin.any() else distinct
    return Cloud(shifted, origin, len(points) - len(finite), len(finite) - len(distinct), facts)


def read_points(path: Path | str, options: RecordingOptions | None = None) -> Array:
    """Points of one file, float64, metres: ``(N, 3)``, or ``(H, W, 3)`` of an organised cloud (PCD, NPY).

    Points without a return are NaN rows: not finite, all zero, or beyond `COORDINATE_MAX_M`. Raises `InputError`.
    """
    return _read(Path(path), options or RecordingOptions())[0]


class Read(NamedTuple):
    """What a reader gives: coordinates ``(..., 3)``, what kind of file it was, the metres of its unit if the file says
    it, and the viewpoint if it has one."""

    points: Any
    kind: str
    unit_m: float | None = None
    viewpoint: str = ""


def _read(path: Path, options: RecordingOptions) -> tuple[Array, dict[str, str]]:
    reader = READERS.get(path.suffix.lower())
    if path.is_dir():
        raise InputError(f"{path}: a folder; expected a file of points (`steelnb run` takes a folder of scans)")
    with reading(path, "a file of points"):
        if reader is None:
            raise InputError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
        found = reader(path, options)
        points = np.array(found.points, dtype=np.float64)
        if not points.size:
            raise ValueError("no points")
    unit_m = options.unit_m or found.unit_m or 1.0
    points *= unit_m
    with np.errstate(invalid="ignore"):
        largest = np.abs(points).max(axis=-1)  # NaN if one is
    points[~((largest > 0) & (largest <= COORDINATE_MAX_M))] = np.nan
    source = "--unit" if options.unit else "as the file says" if found.unit_m else "default; --unit states another"
    facts = {"read": found.kind, "unit": f"{unit_m:g} m ({source})"}
    return points, facts | ({"viewpoint": found.viewpoint} if found.viewpoint else {})


def _read_ply(path: Path, _: RecordingOptions) -> Read:
    from trimesh.exchange.ply import load_ply

    file = path.read_bytes()
    header = file.partition(b"end_header")[0].decode("ascii", "replace")
    faces = re.search(r"^element face +(\d+)", header, re.MULTILINE)
    if faces and int(faces[1]):
        raise ValueError(f"a mesh: {faces[1]} faces; expected a cloud, as of points sampled on it")
    points = load_ply(io.BytesIO(file)).get("vertices")
    count = re.search(r"^element vertex +(\d+)", header, re.MULTILINE)
    if points is None or count is None or len(points) != int(count[1]):
        raise ValueError(f"{np.size(points) // 3} vertices, unlike its header; expected x, y and z of each vertex")
    return Read(points, "PLY")


def _read_pcd(path: Path, _: RecordingOptions) -> Read:
    """Fields of a header may be missing that others imply, and its lines may end as those of Windows."""
    from pypcd4.pypcd4 import PointCloud

    file = path.read_bytes()
    start = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", file, re.MULTILINE)
    if start is None:
        raise ValueError("no line DATA; expected the header of a PCD file")
    lines = [line.split() for line in file[: start.start()].decode("ascii", "replace").splitlines()]
    words = {line[0].upper(): line[1:] for line in lines if line and not line[0].startswith("#")}
    encoding, data = start[1].decode().lower(), file[start.end() :]
    fields = words.get("FIELDS", words.get("COLUMNS", []))
    kinds = {name: words.get(name, ["1"] * len(fields)) for name in ("SIZE", "TYPE", "COUNT")}
    if {len(each) for each in kinds.values()} != {len(fields)} or {"SIZE", "TYPE"} - words.keys():
        raise ValueError(f"{len(fields)} fields; expected as many values in SIZE, TYPE and COUNT")
    missing = [axis for axis in "xyz" if fields.count(axis) != 1 or kinds["COUNT"][fields.index(axis)] != "1"]
    if missing:
        raise ValueError(f"fields {shown(' '.join(fields))}; expected x, y and z")
    width, height = (int(words.get(name, ["1"])[0]) for name in ("WIDTH", "HEIGHT"))
    count = int(words.get("POINTS", [str(width * height)])[0])
    if "WIDTH" in words and count != width * height:
        raise ValueError(f"POINTS {count}, but WIDTH × HEIGHT = {width * height}")
    viewpoint = words.get("VIEWPOINT", IDENTITY)
    said = "" if [float(each) for each in viewpoint] == [float(each) for each in IDENTITY] else " ".join(viewpoint)
    stride = sum(int(size) * int(number) for size, number in zip(kinds["SIZE"], kinds["COUNT"], strict=True))
    if encoding == "ascii":
        names = [name for name, number in zip(fields, kinds["COUNT"], strict=True) for _ in range(int(number))]
        points = _numbers(data, [names.index(axis) for axis in "xyz"], " ", len(names), len(lines) + 2)
        held = len(points)
    else:
        sizes = struct.unpack_from("<II", data.ljust(8, b"\0")) if encoding == "binary_compressed" else (0, len(data))
        held = sizes[1] // max(stride, 1)
        if sizes[0] > len(data) - 8:
            raise ValueError(f"truncated: {len(data) - 8} bytes after its header; expected {sizes[0]}")
    if held < count or (encoding != "binary" and held > count):
        raise ValueError(f"{held} points after its header, which says {count}")
    if encoding != "ascii":
        header = [["VERSION", "0.7"], ["FIELDS", *fields], *([name, *kinds[name]] for name in kinds)]
        header += [["WIDTH", str(count)], ["HEIGHT", "1"], ["POINTS", str(count)], ["DATA", encoding]]
        text = "".join(" ".join(line) + "\n" for line in header)
        cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(text.encode() + data)))
        points = np.stack([cloud.pc_data[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    shape = (height, width, 3) if height > 1 and "WIDTH" in words else (-1, 3)
    pose = f"{said} (position, quaternion wxyz): not applied" if said else ""
    return Read(points.reshape(shape), f"PCD, {encoding}", viewpoint=pose)


def _read_las(path: Path, options: RecordingOptions) -> Read:
    """Points that the file withholds are NaN."""
    import laspy

    with path.open("rb") as file:
        head = file.read(LAS_RECORDS_AT + 4)
    records = int.from_bytes(head[LAS_RECORDS_AT:], "little")
    if head.startswith(b"LASF") and records * LAS_RECORD > path.stat().st_size:  # laspy would try to read them all
        raise ValueError(f"a header that says {records} records; expected at least {LAS_RECORD} bytes of each")
    # The parallel reader ends the process if a damaged file says that its chunks are huge.
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as file:
        header, parts = file.header, []
        if options.unit is None:
            _check_metres(header)
        stored = header.point_count * header.point_format.size
        if not header.are_points_compressed and (held := path.stat().st_size - header.offset_to_point_data) < stored:
            raise ValueError(f"truncated: {held} bytes of points; expected {stored}, as its header says")
        if header.are_points_compressed:
            _check_chunks(path, header.offset_to_point_data, header.point_format.size)
        try:
            for part in file.chunk_iterator(1 << 20):
                xyz = np.stack([part.x, part.y, part.z], axis=-1).astype(np.float64)
                xyz[np.asarray(part.withheld, dtype=bool)] = np.nan
                parts.append(xyz)
        except BaseException as fault:  # a panic of lazrs is no Exception
            if isinstance(fault, KeyboardInterrupt | SystemExit | MemoryError):
                raise
            raise ValueError(f"its points are damaged, after {sum(map(len, parts))}: {fault}") from None
    if sum(map(len, parts)) != header.point_count:
        raise ValueError(f"{sum(map(len, parts))} points; expected {header.point_count}, as its header says")
    version = f"{path.suffix[1:].upper()} {header.version}, point format {header.point_format.id}"
    return Read(np.concatenate(parts) if parts else np.zeros((0, 3)), version)


def _check_chunks(path: Path, begin: int, point_size: int) -> None:
    """Raise ValueError if the table of a LAZ file says that it has more chunks than fit: each begins with a whole point
    (Isenburg, "LASzip: lossless compression of lidar data", 2013). The memory for them would end the process."""
    with path.open("rb") as file:
        file.seek(begin)
        table = int.from_bytes(file.read(8), "little", signed=True)
        file.seek(max(table, 0) + 4)
        chunks = int.from_bytes(file.read(4), "little")
    if table > begin and chunks * point_size > path.stat().st_size:
        raise ValueError(f"a table of {chunks} chunks of points; expected at least {point_size} bytes of each")


def _check_metres(header: Any) -> None:
    """Raise ValueError if the coordinate system of a LAS file says that its unit is not the metre."""
    for record in header.vlrs:
        keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", ())}
        text = str(getattr(record, "string", ""))
        lengths = [float(size) for size in re.findall(r'(?<!ANGLE)UNIT\["(?!deg|rad)[^"]*",\s*([0-9.eE+-]+)', text)]
        if keys.get(1024) == DEGREES or (text.startswith(("GEOGCS", "GEOGCRS"))):
            raise ValueError("longitude and latitude, as its coordinate system says; expected metres, as of UTM")
        if keys.get(3076) in FEET or any(abs(size - METRES["ft"]) < 1e-6 for size in lengths):
            raise ValueError("coordinates in feet, as its coordinate system says; expected --unit ft")


def _read_npy(path: Path, options: RecordingOptions) -> Read:
    stored = np.load(path, mmap_mode="r", allow_pickle=False)
    names = stored.dtype.names
    if names is not None:
        field = {name.lower(): name for name in names}
        if not {"x", "y", "z"} <= field.keys():
            raise ValueError(f"fields {shown(', '.join(names))}; expected x, y and z")
        return Read(np.stack([stored[field[axis]].astype(np.float64) for axis in "xyz"], axis=-1), "NPY")
    if stored.dtype.kind not in "fiu" or stored.dtype.itemsize == 1:
        raise ValueError(f"an array of {stored.dtype}; expected coordinates")
    if stored.ndim == 2 and stored.shape[1] == len(options.columns):
        return Read(stored[:, _axes_of(options.columns)], "NPY, x, y and z named by --columns")
    if stored.ndim not in (2, 3) or stored.shape[-1] != 3:
        hint = "; --columns x,y,z,_ names its columns" if stored.ndim == 2 and len(stored) > stored.shape[1] > 3 else ""
        raise ValueError(f"an array of shape {stored.shape}; expected (N, 3) or (H, W, 3){hint}")
    return Read(stored, "NPY")


def _read_text(path: Path, options: RecordingOptions) -> Read:
    table = read_table(path, options.columns)
    if not table.names and table.width == 3:
        return Read(table.values([0, 1, 2]), "text, three columns")
    if not table.names:
        raise ValueError(f"{table.width} columns without names; {NAMED}")
    axes = _axes_of([name.lower() for name in table.names])
    units = {table.units[k] for k in axes} - {""}
    if len(units) > 1:
        raise ValueError(f"x, y and z in {' and '.join(sorted(units))}; expected one unit")
    unit_m = metres_of(units.pop()) if units and options.unit is None else None
    source = "named by --columns" if options.columns else "named in its first line"
    return Read(table.values(axes), f"text, x, y and z {source}", unit_m)


def _axes_of(columns: Sequence[str]) -> list[int]:
    """Numbers of the columns x, y and z. Raises ValueError."""
    if [columns.count(axis) for axis in "xyz"] != [1, 1, 1]:
        raise ValueError(f"columns {shown(', '.join(columns))}; {NAMED}")
    return [columns.index(axis) for axis in "xyz"]


class Table(NamedTuple):
    """A text file: the lines of numbers from ``data`` on, with ``width`` fields each, divided by ``separator`` (a blank
    stands for white space); ``first``: number of the first line of numbers in the file, and ``first_cells`` its fields;
    ``names`` of the columns and their ``units`` ("" if not given), both empty without names."""

    data: bytes
    width: int
    separator: str
    first: int
    first_cells: list[str]
    names: Sequence[str] = ()
    units: Sequence[str] = ()

    def values(self, wanted: Sequence[int]) -> Array:
        """Columns ``wanted (C,)`` of all lines, ``(N, C)``. Raises ValueError for a line of another form."""
        return _numbers(self.data, wanted, self.separator, self.width, self.first)


def read_table(path: Path, columns: Sequence[str] = ()) -> Table:
    """Open a text file of numbers, divided by blanks, or by one of comma, semicolon and tab.

    Its names stand in the line before the numbers, which may be a comment (``#``, ``//``), or are ``columns``. A line
    with the number of all lines may stand before them (PTS). Raises ValueError.
    """
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    if b"\0" in text[:4096]:
        raise ValueError("binary data or UTF-16; expected text in UTF-8")
    at, before, declared = 0, "", None
    for first, raw in enumerate(text.splitlines(keepends=True), 1):  # noqa: B007
        line = raw.decode("utf-8", "replace").strip()
        is_comment = line.startswith(("#", "//"))
        cells, separator = _cells(line)
        if line and not is_comment and any(map(_is_number, cells)):
            if declared is not None or len(cells) > 1 or not cells[0].isdigit() or at + len(raw) == len(text):
                break
            declared = int(cells[0])
        elif line:
            before = line.lstrip("#/ \t") if is_comment or not before else before
        at += len(raw)
    else:
        start = text.strip().partition(b"\n")[0].decode("utf-8", "replace")
        found = f"its first line is {shown(start)}" if start else "it is empty"
        raise ValueError(f"no lines of numbers with decimal points; {found}")
    data = text[at:]
    if declared is not None and declared != (lines := sum(1 for each in data.splitlines() if each.strip())):
        raise ValueError(f"{lines} lines of numbers; expected {declared}, as its first line says")
    table = Table(data, len(cells), separator, first, cells)
    if columns:
        if len(columns) != len(cells):
            raise ValueError(f"{len(cells)} columns; expected {len(columns)}, as --columns names")
        return table._replace(names=columns, units=[""] * len(columns))
    header, _ = _cells(re.sub(r"\s+(?=[\[(])", "", before))
    named = [match for name in header if (match := UNIT.fullmatch(name.strip('" \t')))]
    if len(named) == len(cells):
        return table._replace(names=[each[1] for each in named], units=[each[2] or each[3] or "" for each in named])
    if before and not text[:at].splitlines()[-1].lstrip().startswith((b"#", b"//")):
        raise ValueError(f"{len(named)} names for {len(cells)} columns: {shown(before)}; expected as many")
    return table


def _cells(line: str, separator: str = "") -> tuple[list[str], str]:
    """The fields of a line, and what divides them, if not given."""
    separator = separator or next((each for each in ";\t," if each in line), " ")
    return [cell.strip() for cell in line.split(None if separator == " " else separator)], separator


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _numbers(data: bytes, wanted: Sequence[int], separator: str, count: int, first: int) -> Array:
    """Columns ``wanted (C,)`` of lines with ``count`` fields. Raises ValueError that names a line of another form."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about texts among the numbers of other columns
            table = pd.read_csv(
                io.BytesIO(data), sep=separator.replace(" ", r"\s+"), header=None, comment="#", skipinitialspace=True,
                dtype=dict.fromkeys(wanted, np.float64), encoding_errors="replace",
            )  # fmt: skip
        if len(table.columns) == count and not table.iloc[:, -1].isna().any():
            values: Array = table[list(wanted)].to_numpy(np.float64)
            return values
    except ValueError:  # pandas names neither the line nor the text
        table = None
    for number, raw in enumerate(data.splitlines(), first):
        line = raw.partition(b"#")[0].decode("utf-8", "replace").strip(" \r\n")
        cells, _ = _cells(line, separator)
        if line and len(cells) != count:
            raise ValueError(f"line {number} has {len(cells)} fields, {shown(line)}; expected {count}")
        for cell in (cells[k] for k in wanted if line):
            if not _is_number(cell) and cell not in ("", "NA", "null", "NULL", "None"):
                raise ValueError(f"line {number}: {shown(cell)}; expected a number with a decimal point")
    if table is None:
        raise ValueError(f"no lines of numbers that can be read from line {first} on")
    values = table[list(wanted)].to_numpy(np.float64)
    return values


READERS: Mapping[str, Callable[[Path, RecordingOptions], Read]] = {
    ".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las, ".npy": _read_npy,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text, ".asc": _read_text, ".pts": _read_text,
}  # fmt: skip
"""Reader of each suffix."""


def write_map(path: Path | str, points: Array, bar: IntArray) -> None:
    """Write points ``(N, 3)`` in metres, and the bar ``(N,)`` of each as the property ``bar``, to a binary
    little-endian PLY file. Coordinates are doubles, so that UTM keeps its millimetres."""
    points = checked_array(points, "points", ("N", 3))
    check_length(bar, "bar", len(points), "one per point")
    vertex = np.empty(len(points), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("bar", "<i4")])
    vertex["x"], vertex["y"], vertex["z"], vertex["bar"] = *points.T, bar
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "property double x\nproperty double y\nproperty double z\nproperty int bar\nend_header\n"
    with new_file(path) as file:
        file.write_bytes(header.encode() + vertex.tobytes())
