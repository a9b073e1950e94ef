"""`steelnb segment CLOUD`: point cloud of a structure → its bars, as a table, a picture and a summary."""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import new_folder
from steelnb.core.types import Segments
from steelnb.hough.lines import default_dx, spacing
from steelnb.hough.whole_structure.search import MIN_VOTES, segment_structure, within
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.structures import write_segments
from steelnb.plots.flight import figure_bars
from steelnb.points import voxel_grid


@dataclass(frozen=True)
class SegmentReport:
    """``segments`` in the coordinates of the file, the longest first; ``explained``: share of the file's distinct
    points that lie within ``dx_m`` of a segment; ``summary`` and ``warnings``: lines of text."""

    segments: Segments
    voxel_m: float
    dx_m: float
    explained: float
    summary: tuple[str, ...]
    warnings: tuple[str, ...]


def segment_file(
    path: Path | str,
    output: Path | str,
    *,
    voxel_m: float | None = None,
    dx_m: float | None = None,
    min_votes: int | None = None,
) -> SegmentReport:
    """Find the bars in the cloud of a file and write ``segments.csv`` and ``segments.png`` to the folder ``output``.

    ``dx_m`` is the radius of the tube that holds a bar's points (default: `default_dx`), ``voxel_m`` the edge of the
    voxel filter (default: dx/√3, so that a voxel's diagonal is dx, as in the report). ``min_votes`` is the minimum
    number of filtered points of a bar, and the minimum by which the points in its tube exceed those around it.

    Raises the errors of `read_cloud`, `InputError` and `OutputError`; nothing is written then.
    """
    path, began = Path(path), time.perf_counter()
    min_votes = MIN_VOTES if min_votes is None else min_votes
    if min_votes < 2:
        raise InputError(f"min_votes = {min_votes}: expected at least 2")
    with new_folder(output) as folder:
        cloud = read_cloud(path)
        _check_length("voxel_m", voxel_m, cloud)
        _check_length("dx_m", dx_m, cloud)
        dx = dx_m or max(default_dx(cloud.points), math.sqrt(3) * (voxel_m or 0.0))
        voxel = voxel_m or dx / math.sqrt(3)
        points = voxel_grid(cloud.points, voxel)
        found = segment_structure(points, dx, min_votes)
        found = found.take(np.argsort(-found.length, kind="stable"))
        explained = float(within(cloud.points, found, dx).mean())
        segments = found.moved(cloud.origin)
        write_segments(segments, folder / "segments.csv")
        share = f"{100 * explained:.0f} % of the points lie within {dx:.2g} m of a bar"
        figure = figure_bars(cloud.points, found, f"{path.name}: {len(found)} bars; {share}")
        figure.savefig(folder / "segments.png", dpi=150)
    summary = (
        f"read      {path.name}: {len(cloud)} points ({cloud.duplicates} duplicates and {cloud.invalid} invalid ones "
        f"dropped), {spacing(cloud.points):.3g} m apart",
        f"settings  voxel {voxel:.3g} m ({len(points)} points after it), dx {dx:.3g} m",
        f"found     {len(found)} bars, {found.length.sum():.1f} m in all, the longest "
        f"{found.length.max(initial=0):.1f} m, in {time.perf_counter() - began:.1f} s",
        f"explained {share}",
        f"written   {output}/: segments.csv, segments.png",
    )
    left = f"voxels of {voxel:.3g} m leave {len(points)} of {len(cloud)} points, and a bar needs {min_votes}"
    return SegmentReport(segments, voxel, dx, explained, summary, () if len(found) else (f"no bar found: {left}",))


def _check_length(name: str, value: float | None, cloud: Cloud) -> None:
    diagonal = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    # The voxels of a finer grid could not be numbered.
    if value is not None and not 1e-9 * diagonal <= value <= diagonal:
        raise InputError(f"{name} = {value}: expected a length above 0 and at most the cloud's {diagonal:.3g} m")
