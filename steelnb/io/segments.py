"""Segments → ``segments.csv``, ``.json``, ``.obj`` and ``.ply``."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.types import Array, Segments

COLUMNS = (
    "start_x_m", "start_y_m", "start_z_m", "end_x_m", "end_y_m", "end_z_m", "length_m", "count", "radius_m",
)  # fmt: skip
SCHEMA = {
    "start": "one end: x, y, z", "end": "the other end: x, y, z", "length": "distance of the ends",
    "count": "points of the filtered cloud that the segment was fitted to",
    "radius": "root mean square distance of those points to the segment", "group": "class of orientation",
}  # fmt: skip
VERTICAL_DEG, HORIZONTAL_DEG = 20.0, 10.0
"""Near vertical is up to 20° from the vertical, since legs lean; near horizontal up to 10° from the horizontal."""
GROUPS = ("near_vertical", "inclined", "near_horizontal")


def orientation(segments: Segments) -> list[str]:
    """Class of each segment out of `GROUPS`, from its direction alone."""
    lean = np.degrees(np.arccos(np.clip(np.abs(segments.direction[:, 2]), 0, 1)))
    return [GROUPS[0] if angle <= VERTICAL_DEG else GROUPS[1 + (angle >= 90 - HORIZONTAL_DEG)] for angle in lean]


def write_segments(
    folder: Path, segments: Segments, origin: Array, groups: Sequence[str], about: Mapping[str, Any],
    sigma_m: Array | None = None,
) -> None:  # fmt: skip
    """Write segments to four files in ``folder``.

    ``segments`` are those of a shifted cloud and ``origin (3,)`` is its shift in metres. CSV and JSON hold the
    coordinates of the cloud's file, to a tenth of a millimetre. OBJ and PLY are for viewers, which compute in single
    precision and would round UTM coordinates to 0.25 m: they stay shifted and name the origin in a comment.
    ``groups (M)`` names the OBJ group of each segment; ``about`` goes into the JSON file. ``sigma_m (M, 2)``, standard
    deviations across the axis at start and end, are two more columns of the CSV, in millimetres.
    """
    ends = np.concatenate([segments.start, segments.end], axis=1)
    rows = np.column_stack([ends + np.tile(origin, 2), segments.length, segments.count, segments.radius]).tolist()
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype({"count": int})
    if sigma_m is not None:
        table[["sigma_start_mm", "sigma_end_mm"]] = (1e3 * sigma_m).round(2)
    table.to_csv(folder / "segments.csv", index=False, float_format="%.4f", lineterminator="\n")
    entries = [
        {
            "start": [round(v, 4) for v in row[0:3]], "end": [round(v, 4) for v in row[3:6]],
            "length": round(row[6], 4), "count": int(row[7]), "radius": round(row[8], 4), "group": group,
        }
        for row, group in zip(rows, groups, strict=True)
    ]  # fmt: skip
    document = {
        "format": "steelnb segments, version 1", "units": "metres", "origin": origin.tolist(), **about,
        "schema": SCHEMA, "segments": entries,
    }  # fmt: skip
    (folder / "segments.json").write_text(json.dumps(document, indent=1) + "\n")

    shift = f"origin: add {' '.join(f'{v:.1f}' for v in origin)} to every vertex"
    corners = [f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in ends.reshape(-1, 3).tolist()]
    obj = ["# segments in metres, z up", f"# {shift}", *(f"v {corner}" for corner in corners)]
    for group in dict.fromkeys(groups):
        obj += [f"g {group}", *(f"l {2 * k + 1} {2 * k + 2}" for k, own in enumerate(groups) if own == group)]
    (folder / "segments.obj").write_text("\n".join([*obj, ""]))

    header = [
        "ply", "format ascii 1.0", "comment segments in metres, z up", f"comment {shift}",
        f"element vertex {len(corners)}", *(f"property double {axis}" for axis in "xyz"),
        f"element edge {len(segments)}", "property int vertex1", "property int vertex2", "end_header",
    ]  # fmt: skip
    edges = [f"{k} {k + 1}" for k in range(0, len(corners), 2)]
    (folder / "segments.ply").write_text("\n".join([*header, *corners, *edges, ""]))
