"""`steelnb segment CLOUD`: point cloud of a structure → its bars, as files, a picture and a summary."""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.errors import SettingsError
from steelnb.files import new_folder, plain_name
from steelnb.hough.blocks import MIN_VOTES, segment_structure, within
from steelnb.hough.dx import default_dx, spacing
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.segments import GROUPS, orientation, write_segments
from steelnb.points import voxel_grid
from steelnb.report.words import counted
from steelnb.types import Segments


@dataclass(frozen=True)
class SegmentReport:
    """Result of `segment_file`.

    ``segments`` in the coordinates of the file; ``explained`` is the share of the file's distinct points that lie
    within ``dx_m`` of a segment, ``explained_filtered`` that of the voxel-filtered points; ``summary`` is a text.
    """

    folder: Path
    segments: Segments
    voxel_m: float
    dx_m: float
    explained: float
    explained_filtered: float
    seconds: float
    summary: tuple[str, ...]


def segment_file(
    path: Path | str,
    output: Path | str | None = None,
    *,
    voxel_m: float | None = None,
    dx_m: float | None = None,
    min_votes: int | None = None,
) -> SegmentReport:
    """Find the bars in the cloud of a file and write them to the folder ``output``, default ``<stem>_segments`` here.

    A cloud too large for memory is thinned while it is read (`Cloud.thinned_m`).

    ``dx_m`` is the radius of the tube that holds a bar's points (default: `default_dx`), ``voxel_m`` the edge of the
    voxel filter (default: dx/√3, so that a voxel's diagonal is dx, as in the report), ``min_votes`` the fewest
    filtered points of a bar, and the least number by which those in its tube outweigh those around it.
    ``segments.png`` shows what was found.

    Raises the errors of `read_cloud`, `SettingsError` and `OutputError`; nothing is written then.
    """
    path = Path(path)
    name = plain_name(path)
    target = Path(output) if output else Path(f"{path.stem}_segments")
    began = time.perf_counter()
    votes = MIN_VOTES if min_votes is None else min_votes
    if votes < 2:
        raise SettingsError(f"min_votes = {votes}: expected at least 2")
    with new_folder(target) as folder:
        cloud = read_cloud(path)
        _check_length("voxel_m", voxel_m, cloud)
        _check_length("dx_m", dx_m, cloud)
        dx = dx_m or max(default_dx(cloud.points), math.sqrt(3) * (voxel_m or 0.0))
        voxel = voxel_m or dx / math.sqrt(3)
        points = voxel_grid(cloud.points, voxel)
        found = segment_structure(points, dx, votes)
        found = found.take(np.argsort(-found.length, kind="stable"))
        groups = orientation(found)
        explained = float(np.average(within(cloud.points, found, dx), weights=cloud.count))
        filtered = float(within(points, found, dx).mean())
        about = {
            "source": name, "points": _size(cloud), "settings": {"voxel_m": voxel, "dx_m": dx, "min_votes": votes},
            "explained": explained, "explained_filtered": filtered,
        }  # fmt: skip
        write_segments(folder, found, cloud.origin, groups, about)
        from steelnb.report.three_views import figure_segments

        title = (
            f"{name}: {counted(len(found), 'segment')}, {100 * explained:.0f} % of the points within {dx:.2g} m of one"
        )
        figure_segments(cloud.points, found, groups, title).savefig(folder / "segments.png", dpi=150)
    seconds = time.perf_counter() - began
    segments = found.moved(cloud.origin)
    summary = (
        *_summary_of_cloud(name, cloud, len(points), voxel, dx),
        f"found     {counted(len(found), 'segment')}, {found.length.sum():.1f} m in all, in {seconds:.1f} s",
        f"explained {100 * explained:.0f} % of the points lie within dx of a segment "
        f"({100 * filtered:.0f} % of the filtered ones)",
        *_summary_of_segments(segments, groups),
        f"written   {target}/: segments.csv, .json, .obj, .ply, .png",
    )
    return SegmentReport(target, segments, voxel, dx, explained, filtered, seconds, summary)


def _check_length(name: str, value: float | None, cloud: Cloud) -> None:
    diagonal = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    # Finer than this, voxels could not be numbered.
    if value is not None and not 1e-9 * diagonal <= value <= diagonal:
        raise SettingsError(f"{name} = {value}: expected a length above 0 and at most the cloud's {diagonal:.3g} m")


def _size(cloud: Cloud) -> int:
    return len(cloud) if cloud.count is None else int(cloud.count.sum())


def _summary_of_cloud(name: str, cloud: Cloud, filtered: int, voxel: float, dx: float) -> list[str]:
    dropped = f"{cloud.dropped_duplicates} duplicates and {cloud.dropped_invalid} invalid ones dropped"
    apart = f"{spacing(cloud.points):.3g} m apart"
    if cloud.thinned_m:
        dropped = f"{cloud.dropped_invalid} invalid ones dropped"
        apart = f"too many to hold: thinned to the {len(cloud)} means of voxels of {cloud.thinned_m:.2g} m, {apart}"
    lines = [
        f"read      {name}: {_size(cloud)} points ({dropped}), {apart}",
        f"settings  voxel {voxel:.3g} m ({filtered} points after it), dx {dx:.3g} m",
    ]
    if cloud.thinned_m > voxel:
        lines.append(f"warning   the thinned cloud is coarser than voxels of {voxel:.3g} m")
    if cloud.resolution_m > dx / 20:
        lines.insert(1, f"warning   coordinates in steps of {cloud.resolution_m:.3g} m, as the file stores them")
    return lines


def _summary_of_segments(segments: Segments, groups: list[str]) -> list[str]:
    length = segments.length
    lines = [f"          {'':16}{'segments':>9}{'length m':>10}{'longest m':>11}"]
    for group in GROUPS:
        own = length[[other == group for other in groups]]
        lines.append(f"          {group.replace('_', ' '):16}{len(own):9d}{own.sum():10.1f}{own.max(initial=0):11.1f}")
    for k in range(min(3, len(segments))):
        start, end = (f"({', '.join(f'{v:.2f}' for v in end[k])})" for end in (segments.start, segments.end))
        lines.append(f"{'longest' if k == 0 else '':9} {length[k]:.2f} m from {start} to {end}")
    return lines
