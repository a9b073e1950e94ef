"""`Structure` ↔ JSON, the one format that is read back. ``structure-2.schema.json`` beside this file describes it.

Every number survives a round trip exactly. Reading is strict: an unknown key, a missing unit or a tie to a bar that is
not there is an error, since a model that was read wrongly looks like one that was read rightly. So a new key is a new
version: version 1 had no ``reason``, and is still read.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from steelnb.datatypes import Array, Segments
from steelnb.errors import FileContentError, FileMissingError, NonFiniteError, UnitsError, VersionError
from steelnb.exports.members import Extras, checked
from steelnb.fusion.structure import Structure

FORMAT, VERSION = "steelnb structure", 2
SCHEMA = Path(__file__).with_name(f"structure-{VERSION}.schema.json")

Point = Annotated[tuple[float, float, float], Field(description="x, y, z in the world frame, metres")]
Length = Annotated[float, Field(ge=0)]
Number = Annotated[int, Field(ge=0)]


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


class Joint(_Part):
    position_m: Point


class Tie(_Part):
    joint: Number = Field(description="place in the list of joints, from 0")
    bar: Number = Field(description="place in the list of bars, from 0")


class Document(_Part):
    """Bars and joints of a structure, and which joint ties which bars."""

    format: Literal["steelnb structure"]
    version: Literal[2]
    units: Units
    frame: Frame
    about: dict[str, Any] = Field(default={}, description="where the structure comes from; free")
    reason: str = Field(description="why there are no bars; empty if there are")
    bars: list[Bar]
    joints: list[Joint]
    ties: list[Tie] = Field(description="one for each bar that a joint ties")


def schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of the format, which the package ships as `SCHEMA`."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Document.model_json_schema()}


def write_json(structure: Structure, path: Path, extras: Extras) -> None:
    """Write a structure, one line for each bar, joint and tie, so that two files can be compared line by line."""
    s = structure.segments
    columns = {
        "start_m": s.start, "end_m": s.end, "width_m": structure.width_m, "sigma_m": structure.sigma_m,
        "sightings": structure.sightings, "points": s.count, "radius_m": s.radius,
    }  # fmt: skip
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    head = {
        "format": FORMAT, "version": VERSION, "units": {"length": "metre"},
        "frame": {"name": "world", "up": "z", "handedness": "right"}, "about": dict(extras.about),
        "reason": structure.reason,
    }  # fmt: skip
    lists = {
        "bars": [dict(zip(columns, map(_known, row), strict=True)) for row in rows],
        "joints": [{"position_m": position} for position in structure.joint.tolist()],
        "ties": [{"joint": joint, "bar": bar} for joint, bar in structure.tie.tolist()],
    }
    parts = [f" {_text(key)}: {_text(value)}" for key, value in head.items()]
    parts += [f" {_text(key)}: [" + ",".join("\n  " + _text(entry) for entry in of) + "]" for key, of in lists.items()]
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def read_structure(path: Path | str) -> Structure:
    """Read a structure that `export_structure` wrote as JSON: world frame, metres, z up.

    Raises `FileMissingError`, `FileContentError` (not JSON, not this format, a missing or unknown key), `VersionError`,
    `UnitsError`, `NonFiniteError`, and `StructureError` for a tie to a joint or a bar that does not exist.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as fault:
        raise FileMissingError(f"{path}: cannot be read: {fault.strerror or fault}; expected a JSON file") from None
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise FileContentError(f"{path}: not JSON: {fault}") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        found = raw.get("format") if isinstance(raw, dict) else type(raw).__name__
        raise FileContentError(f"{path}: format = {found!r}; expected {FORMAT!r}")
    version = raw.get("version")
    if version == 1 and "reason" not in raw:
        raw |= {"version": VERSION, "reason": ""}
        text = json.dumps(raw).encode()
    elif version != VERSION:
        raise VersionError(f"{path}: version = {version!r}; expected {VERSION}, or 1 without a reason")
    if raw.get("units") != {"length": "metre"}:
        raise UnitsError(f"{path}: units = {raw.get('units')!r}; expected {{'length': 'metre'}}")
    try:
        document = Document.model_validate_json(text)
    except ValidationError as fault:
        raise _complaint(path, fault) from None
    return checked(_structure(document), str(path))


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
    )


def _points(rows: Sequence[tuple[float, float, float]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, 3)


def _known(value: Any) -> Any:
    return None if value != value else value  # NaN alone differs from itself


def _text(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def _complaint(path: Path, fault: ValidationError) -> FileContentError | NonFiniteError:
    first = fault.errors()[0]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    value = "" if first["type"] == "missing" else f" = {str(first['input'])[:60]}"
    more = f" ({fault.error_count() - 1} more)" if fault.error_count() > 1 else ""
    error = NonFiniteError if first["type"] == "finite_number" else FileContentError
    return error(f"{path}: {where}{value}: {first['msg'][0].lower()}{first['msg'][1:]}{more}")
