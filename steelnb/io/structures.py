"""`Structure` ↔ JSON, the one format that is read back, and `Structure` → files for other programs (`drawings`).

`Document.model_json_schema` describes the JSON. Every number survives a round trip exactly. Reading is strict, since a
model that was read wrongly looks like one that was read rightly: an unknown key, a missing unit or a tie to a bar that
is not there is an error. So a new key is a new version. Version 3, without ``section``, and version 2, without
``opening`` either, are read, too.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from steelnb.errors import (
    EmptyStructureError,
    FileContentError,
    NonFiniteError,
    OutputError,
    SteelnbError,
    StructureError,
    UnitsError,
    UnsupportedFormatError,
    VersionError,
)
from steelnb.files import new_folder, reading
from steelnb.fusion.structure import Structure
from steelnb.io import drawings
from steelnb.io.clouds import FARTHEST_M
from steelnb.types import Array, Segments

FORMAT, VERSION, OLDER = "steelnb structure", 4, (2, 3)
DRAWN: Mapping[str, Callable[[Structure, Path], None]] = {
    ".dxf": drawings.write_dxf, ".glb": drawings.write_glb, ".ifc": drawings.write_ifc,
}  # fmt: skip
"""Formats that are of no use without a bar."""
FORMATS = (".json", ".csv", *DRAWN)

Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Point = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(description="x, y, z in the world frame, metres")]
Length = Annotated[float, Field(ge=0, le=FARTHEST_M)]
Number = Annotated[int, Field(ge=0, lt=2**63)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Units(_Part):
    length: Literal["metre"]


class Frame(_Part):
    name: Literal["world"]
    up: Literal["z"]
    handedness: Literal["right"]


class Bar(_Part):
    start_m: Point
    end_m: Point
    width_m: Length | None = Field(description="what the bar looks like across; null: not known")
    sigma_m: Length | None = Field(description="standard deviation of the axis's position across; null: not known")
    sightings: Number = Field(description="scans in which the bar was seen")
    points: Number = Field(description="points that the axis was fitted to")
    radius_m: Length = Field(description="root mean square distance of those points to the axis")
    opening: Point | None = Field(None, description="from the corner of an angle section to between its flanges")
    section: Literal["angle", "round"] | None = Field(
        None, description="round: width_m is its diameter; null: not known"
    )


class Joint(_Part):
    position_m: Point
    sigma_m: Length | None = Field(None, description="standard deviation where it is largest; null: not known")


class Tie(_Part):
    joint: Number = Field(description="place in the list of joints, from 0")
    bar: Number = Field(description="place in the list of bars, from 0")


class Document(_Part):
    """Bars and joints of a structure, and which joint ties which bars."""

    format: Literal["steelnb structure"]
    version: Literal[2, 3, 4]
    units: Units
    frame: Frame
    about: dict[str, Any] = Field(default={}, description="where the structure comes from; free")
    reason: str = Field(description="why there are no bars; empty if there are")
    bars: list[Bar]
    joints: list[Joint]
    ties: list[Tie] = Field(description="one for each bar that a joint ties")


def write_structure(
    structure: Structure, path: Path | str, *, overwrite: bool = False, about: Mapping[str, Any] | None = None
) -> tuple[Path, ...]:
    """Write a structure in the format that the ending of ``path`` names (`FORMATS`), and give the files written.

    Every format is in metres and in the world frame with z up, and says so; glTF has y up, so there the root node
    turns it. ``about`` goes into JSON. CSV is two tables, ``<name>_bars.csv`` and ``<name>_joints.csv``. GLB shows
    bars as prisms coloured by ``sigma_m``, shifted where coordinates are too large for single precision. The same
    structure gives the same bytes.

    Raises `UnsupportedFormatError`, `OutputError` (a file exists and ``overwrite`` is not set, or cannot be written),
    `NonFiniteError`, `StructureError`, `EmptyStructureError` (a drawing of no bars) and `MissingExtraError` (DXF, GLB
    and IFC without their library). Nothing is written then.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise UnsupportedFormatError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(FORMATS)}")
    text = _to_json(structure, path.name, about or {})
    _from_json(text, path.name, StructureError)  # only what the reader accepts is written
    if ending in DRAWN and not len(structure):
        raise EmptyStructureError(f"{path}: the structure has no bars; expected at least one to draw")
    with new_folder(path.parent) as folder:
        if ending == ".json":
            (folder / path.name).write_text(text, encoding="utf-8")
        else:
            DRAWN.get(ending, drawings.write_csv)(structure, folder / path.name)
        written = tuple(path.parent / file.name for file in sorted(folder.iterdir()))
        for file in written:
            if file.is_dir() or (file.exists() and not overwrite):
                raise OutputError(f"{file}: exists already; expected a new file, or overwrite=True (--force)")
    return written


def read_structure(path: Path | str) -> Structure:
    """Read a structure that `write_structure` wrote as JSON: world frame, metres, z up.

    Raises `FileMissingError`, `FileContentError` (not JSON, not this format, a missing or unknown key), `VersionError`,
    `UnitsError`, `NonFiniteError`, and `StructureError` for a tie to a joint or a bar that does not exist.
    """
    with reading(path, "a structure in JSON"):
        return _from_json(Path(path).read_bytes(), str(path))


def _to_json(structure: Structure, name: str, about: Mapping[str, Any]) -> str:
    """One line for each bar, joint and tie, so that two files can be compared line by line."""
    s = structure.segments
    columns = {
        "start_m": s.start.tolist(), "end_m": s.end.tolist(), "width_m": _nullable(structure.width_m, len(s)),
        "sigma_m": _nullable(structure.sigma_m, len(s)), "sightings": structure.sightings.tolist(),
        "points": s.count.tolist(), "radius_m": s.radius.tolist(), "opening": _nullable(structure.opening, len(s)),
        "section": _sections(structure),
    }  # fmt: skip
    joint = _nullable(structure.joint_sigma_m, len(structure.joint))
    for column, values in columns.items():
        if len(values) != len(s):
            raise StructureError(f"{name}: {column} has {len(values)} rows for {len(s)} bars; expected one each")
    head = {
        "format": FORMAT, "version": VERSION, "units": {"length": "metre"},
        "frame": {"name": "world", "up": "z", "handedness": "right"}, "about": dict(about), "reason": structure.reason,
    }  # fmt: skip
    lists = {
        "bars": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        "joints": [
            {"position_m": at, "sigma_m": sigma_m} for at, sigma_m in zip(structure.joint.tolist(), joint, strict=True)
        ],
        "ties": [{"joint": joint, "bar": bar} for joint, bar in structure.tie.tolist()],
    }
    parts = [f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in head.items()]
    for key, entries in lists.items():
        parts.append(f" {json.dumps(key)}: [" + ",".join("\n  " + json.dumps(entry) for entry in entries) + "]")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _sections(structure: Structure) -> list[str | None]:
    """Which section each bar has, null where it is not known."""
    tube, opening = structure.tube, _nullable(structure.opening, len(structure))
    angle = ["angle" if towards else None for towards in opening]
    return angle if tube is None else ["round" if r else a for r, a in zip(tube.tolist(), angle, strict=True)]


def _nullable(values: Array | None, count: int) -> list[Any]:
    """``count`` numbers or rows of numbers, null where they are not known."""
    return [None] * count if values is None else [None if np.isnan(row).all() else row for row in values.tolist()]


def _from_json(text: str | bytes, name: str, misfit: type[SteelnbError] = FileContentError) -> Structure:
    """The structure of a JSON text; ``name`` begins the messages. Raises as `read_structure`, ``misfit`` for values
    that do not fit the format."""
    raw = json.loads(text)
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        found = raw.get("format") if isinstance(raw, dict) else type(raw).__name__
        raise FileContentError(f"{name}: format = {found!r:.60}; expected {FORMAT!r}")
    if raw.get("version") not in (VERSION, *OLDER):
        older = "; version 1 is no longer read: write the file again" if raw.get("version") == 1 else ""
        raise VersionError(f"{name}: version = {raw.get('version')!r:.60}; expected {VERSION}{older}")
    if raw.get("units") != {"length": "metre"}:
        raise UnitsError(f"{name}: units = {raw.get('units')!r:.60}; expected {{'length': 'metre'}}")
    try:
        document = Document.model_validate_json(text)
    except ValidationError as fault:
        raise _complaint(name, fault, misfit) from None
    return _tied(_structure(document), name)


def _structure(document: Document) -> Structure:
    bars = document.bars
    segments = Segments(
        _points([bar.start_m for bar in bars]),
        _points([bar.end_m for bar in bars]),
        np.array([bar.points for bar in bars], dtype=np.int64),
        np.array([bar.radius_m for bar in bars], dtype=float),
    )
    return Structure(
        segments,
        width_m=np.array([bar.width_m for bar in bars], dtype=float),  # None becomes NaN
        sightings=np.array([bar.sightings for bar in bars], dtype=np.int64),
        sigma_m=np.array([bar.sigma_m for bar in bars], dtype=float),
        joint=_points([joint.position_m for joint in document.joints]),
        tie=np.array([(tie.joint, tie.bar) for tie in document.ties], dtype=np.int64).reshape(-1, 2),
        reason=document.reason,
        opening=_known([bar.opening for bar in bars], (np.nan,) * 3),
        joint_sigma_m=_known([joint.sigma_m for joint in document.joints], np.nan),
        tube=np.array([bar.section == "round" for bar in bars])
        if any(bar.section == "round" for bar in bars)
        else None,
    )


def _known(values: Sequence[Any], unknown: Any) -> Array | None:
    """Numbers or rows of numbers with ``unknown`` for those that are null; None where all are."""
    if all(value is None for value in values):
        return None
    return np.array([unknown if value is None else value for value in values], dtype=float)


def _points(rows: Sequence[tuple[float, float, float]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, 3)


def _tied(structure: Structure, name: str) -> Structure:
    """The structure itself, if every bar has a length and every tie a joint and a bar, once; else `StructureError`."""
    segments, bars, joints = structure.segments, len(structure), len(structure.joint)
    for bar in np.flatnonzero(segments.length == 0):
        raise StructureError(f"{name}: bar {bar} starts and ends at {segments.start[bar].tolist()}; expected a length")
    for k, (joint, bar) in enumerate(structure.tie.tolist()):
        if joint >= joints or bar >= bars:
            raise StructureError(f"{name}: tie {k} is of joint {joint} and bar {bar}; there are {joints} and {bars}")
    twice = len(structure.tie) - len(np.unique(structure.tie, axis=0))
    if twice:
        raise StructureError(f"{name}: {twice} ties given twice; expected each joint and bar once")
    return structure


def _complaint(name: str, fault: ValidationError, misfit: type[SteelnbError]) -> SteelnbError:
    first = fault.errors()[0]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    value = "" if first["type"] == "missing" else f" = {str(first['input'])[:60]}"
    more = f" ({fault.error_count() - 1} more)" if fault.error_count() > 1 else ""
    error = NonFiniteError if first["type"] == "finite_number" else misfit
    return error(f"{name}: {where}{value}: {first['msg'][0].lower()}{first['msg'][1:]}{more}")
