"""Writers of ``segments.csv`` and ``structure.json``, in metres and in the world frame with z up."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.core.checks import check_length, checked_array
from steelnb.core.files import new_file
from steelnb.core.types import Array, Segments
from steelnb.fusion.structure import Structure

COLUMNS = (
    "start_x_m", "start_y_m", "start_z_m", "end_x_m", "end_y_m", "end_z_m", "length_m", "count", "radius_m",
)  # fmt: skip


def write_segments(
    segments: Segments, path: Path | str, sigma_m: Array | None = None, more: Mapping[str, Array] | None = None
) -> None:
    """Write one CSV row per segment, metres, rounded to 0.1 mm.

    ``sigma_m (M, 2)``, the standard deviations across the axis at start and end, add two columns in millimetres;
    ``more``: further columns ``(M,)`` by name. Raises `InputError` and `OutputError`; no partial file is left.
    """
    rows = np.column_stack([segments.start, segments.end, segments.length, segments.count, segments.radius])
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype({"count": int})
    if sigma_m is not None:
        table[["sigma_start_mm", "sigma_end_mm"]] = (1e3 * checked_array(sigma_m, "sigma_m", (len(table), 2))).round(2)
    for name, values in (more or {}).items():
        check_length(values, name, len(table), "one per segment")
        table[name] = values
    with new_file(path) as file:
        table.to_csv(file, index=False, float_format="%.4f", lineterminator="\n")


def write_structure(structure: Structure, path: Path | str, about: Mapping[str, Any] | None = None) -> None:
    """Write bars, joints and the ties between them as JSON with all digits, one per line; null if unknown.

    ``about`` is stored as the origin of the structure. Raises `OutputError`; no partial file is left.
    """
    s, unknown = structure.segments, [None] * len(structure)
    opening = _null_if_nan(structure.opening) or unknown
    tube = unknown if structure.tube is None else structure.tube
    section = ["round" if is_tube else "angle" if to else None for is_tube, to in zip(tube, opening, strict=True)]
    bars = {
        "start_m": s.start.tolist(), "end_m": s.end.tolist(), "width_m": _null_if_nan(structure.width_m),
        "sigma_m": _null_if_nan(structure.sigma_m), "sightings": structure.sightings.tolist(),
        "points": s.count.tolist(), "radius_m": _null_if_nan(s.radius), "opening": opening, "section": section,
    }  # fmt: skip
    head = {
        "format": "steelnb structure", "version": 5, "units": {"length": "metre"},
        "frame": {"name": "world", "up": "z", "handedness": "right"}, "about": dict(about or {}),
        "reason": structure.reason,
    }  # fmt: skip
    lists = {
        "bars": [dict(zip(bars, row, strict=True)) for row in zip(*bars.values(), strict=True)],
        "joints": [{"position_m": position} for position in structure.joint.tolist()],
        "ties": [{"joint": joint, "bar": bar} for joint, bar in structure.tie.tolist()],
    }
    parts = [f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in head.items()]
    for key, entries in lists.items():
        rows = ",".join("\n  " + json.dumps(entry, allow_nan=False) for entry in entries)
        parts.append(f" {json.dumps(key)}: [{rows}]")
    with new_file(path) as file:
        file.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def _null_if_nan(values: Array | None) -> list[Any]:
    """Numbers or rows of numbers as a list, with None for those that are not finite."""
    return [] if values is None else [value if np.isfinite(value).all() else None for value in values.tolist()]
