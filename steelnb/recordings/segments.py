"""Segments → CSV, JSON, OBJ and PLY, and the folder that they appear in all at once."""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.datatypes import Array, Segments
from steelnb.errors import OutputError

COLUMNS = (
    "start_x_m", "start_y_m", "start_z_m", "end_x_m", "end_y_m", "end_z_m", "length_m", "count", "radius_m",
)  # fmt: skip


def write_segments(
    folder: Path, segments: Segments, origin: Array, groups: Sequence[str], about: Mapping[str, Any]
) -> None:
    """Write ``segments.csv``, ``.json``, ``.obj`` and ``.ply``.

    ``segments`` are those of a shifted cloud and ``origin (3,)`` is its shift in metres. CSV and JSON hold the
    coordinates of the cloud's file, to a tenth of a millimetre. OBJ and PLY are for viewers, which compute in single
    precision and would round UTM coordinates to 0.25 m: they stay shifted and name the origin in a comment.
    ``groups (M)`` names the OBJ group of each segment; ``about`` goes into the JSON file.
    """
    ends = np.concatenate([segments.start, segments.end], axis=1)
    rows = np.column_stack([ends + np.tile(origin, 2), segments.length, segments.count, segments.radius])
    lines = [f"{','.join(f'{v:.4f}' for v in row[:7])},{int(row[7])},{row[8]:.4f}" for row in rows.tolist()]
    (folder / "segments.csv").write_text("\n".join([",".join(COLUMNS), *lines, ""]))
    schema = {
        "start": "one end: x, y, z", "end": "the other end: x, y, z", "length": "distance of the ends",
        "count": "points of the filtered cloud that the segment was fitted to",
        "radius": "root mean square distance of those points to the segment", "group": "class of orientation",
    }  # fmt: skip
    entries = [
        {
            "start": [round(v, 4) for v in row[0:3]], "end": [round(v, 4) for v in row[3:6]],
            "length": round(row[6], 4), "count": int(row[7]), "radius": round(row[8], 4), "group": group,
        }
        for row, group in zip(rows.tolist(), groups, strict=True)
    ]  # fmt: skip
    document = {
        "format": "steelnb segments, version 1", "units": "metres", "origin": origin.tolist(), **about,
        "schema": schema, "segments": entries,
    }  # fmt: skip
    (folder / "segments.json").write_text(json.dumps(document, indent=1) + "\n")
    shift = " ".join(f"{v:.1f}" for v in origin)
    corners = [f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in ends.reshape(-1, 3).tolist()]
    _write_obj(folder / "segments.obj", corners, groups, shift)
    _write_ply(folder / "segments.ply", corners, shift)


def _write_obj(path: Path, corners: list[str], groups: Sequence[str], shift: str) -> None:
    lines = ["# segments in metres, z up", f"# origin: add {shift} to every vertex", *(f"v {c}" for c in corners)]
    for group in dict.fromkeys(groups):
        lines.append(f"g {group}")
        lines += [f"l {2 * k + 1} {2 * k + 2}" for k, other in enumerate(groups) if other == group]
    path.write_text("\n".join([*lines, ""]))


def _write_ply(path: Path, corners: list[str], shift: str) -> None:
    header = [
        "ply", "format ascii 1.0", "comment segments in metres, z up", f"comment origin: add {shift} to every vertex",
        f"element vertex {len(corners)}", *(f"property double {axis}" for axis in "xyz"),
        f"element edge {len(corners) // 2}", "property int vertex1", "property int vertex2", "end_header",
    ]  # fmt: skip
    edges = [f"{k} {k + 1}" for k in range(0, len(corners), 2)]
    path.write_text("\n".join([*header, *corners, *edges, ""]))


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """A hidden folder to write into, which becomes ``target`` at the end, or whose files replace those in ``target``.

    It is made at once, so an unwritable place raises `OutputError` before any work is done. On any error, Ctrl-C
    included, ``target`` and the folders above it are left as they were. Other files in ``target`` stay.
    """
    target = target.absolute()
    made = [folder for folder in (target, *target.parents) if not folder.exists()]
    try:
        # Inside an existing target, which may be writable where its parent is not; else beside it, on the same disk.
        place = target if not made else target.parent
        place.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=".steelnb-", dir=place))
    except OSError as fault:
        _remove_empty(made)
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}; expected a folder") from None
    try:
        (folder := scratch / "new").mkdir()  # mkdtemp's own is closed to the group, this one is as the user wants it
        yield folder
        if made:
            os.rename(folder, target)
        for file in folder.iterdir() if not made else ():
            os.replace(file, target / file.name)
    except OSError as fault:
        raise OutputError(f"{target}: cannot be written: {fault.strerror or fault}") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if not target.exists():
            _remove_empty(made)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
