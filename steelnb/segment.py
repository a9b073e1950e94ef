"""`steelnb segment CLOUD`: a point cloud of a structure → its bars, as files, a picture and a summary."""

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from steelnb.config import StructureSettings
from steelnb.datatypes import Array, Segments
from steelnb.errors import SettingsError
from steelnb.exports import GROUPS, export_structure, orientation
from steelnb.fusion.reconstruct import reconstruct_cloud
from steelnb.fusion.structure import Structure
from steelnb.hough.blocks import segment_structure, within
from steelnb.preprocess import voxel_grid
from steelnb.recordings import Cloud, new_folder, read_cloud, write_segments
from steelnb.recordings.thinning import is_large, read_thinned

MIN_VOTES = 8
STRAIGHT = 0.7
STRAIGHT_THINNED = 0.5
"""What 30 % of the spheres in a cloud of bars reach of 1 − the ratio of standard deviations across and along, and then
in a thinned one. In noise, in a plane and on a ball they reach 0.2 to 0.32."""


@dataclass(frozen=True)
class SegmentReport:
    """What `segment_file` found.

    ``segments`` and ``structure`` (None where none was asked for) in the coordinates of the file; ``explained`` is the
    share of the file's distinct points that lie within ``dx_m`` of a segment, ``explained_filtered`` that of the
    voxel-filtered points; ``summary`` is a text.
    """

    folder: Path
    segments: Segments
    structure: Structure | None
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
    structure: bool = True,
) -> SegmentReport:
    """Find the bars in the cloud of a file and write them to the folder ``output``, default ``<stem>_segments`` here.

    A cloud too large for memory is thinned while it is read, to voxels a fraction of dx wide (`recordings.thinning`);
    what follows then sees their means alone.

    ``dx_m`` is the radius of the tube that holds a bar's points (default: `tube_radius`), ``voxel_m`` the edge of the
    voxel filter (default: dx/√3, so that a voxel's diagonal is dx, as in the report), ``min_votes`` the fewest
    filtered points of a bar, and the least number by which those in its tube outweigh those around it. With
    ``structure``, the final reconstruction, its lengths in proportion to dx, goes to ``structure.json``: bars, joints,
    and which joint ties which bars; a cloud without bars gives an empty one, with the reason.

    Raises the errors of `steelnb.recordings.read_cloud`, `SettingsError` and `OutputError`; nothing is written then.
    """
    path = Path(path)
    began = time.perf_counter()
    votes = MIN_VOTES if min_votes is None else min_votes
    if votes < 2:
        raise SettingsError(f"min_votes = {votes}: expected at least 2")
    with new_folder(Path(output) if output else Path(f"{path.stem}_segments")) as folder:
        cloud = read_thinned(path) if is_large(path) else read_cloud(path)
        _check_length("voxel_m", voxel_m, cloud)
        _check_length("dx_m", dx_m, cloud)
        dx = dx_m or max(tube_radius(cloud.points, cloud.thinned_m > 0), math.sqrt(3) * (voxel_m or 0.0))
        voxel = voxel_m or dx / math.sqrt(3)
        points = voxel_grid(cloud.points, voxel)
        found = segment_structure(points, dx, votes)
        found = found.take(np.argsort(-found.length, kind="stable"))
        groups = orientation(found)
        explained = float(np.average(within(cloud.points, found, dx), weights=cloud.count))
        filtered = float(within(points, found, dx).mean())
        about = {
            "source": path.name, "points": _size(cloud), "settings": {"voxel_m": voxel, "dx_m": dx, "min_votes": votes},
            "explained": explained, "explained_filtered": filtered,
        }  # fmt: skip
        write_segments(folder, found, cloud.origin, groups, about)
        built = _structure(cloud, dx, folder, path.name) if structure else None
        from steelnb.figures.segments import figure_segments

        title = f"{path.name}: {len(found)} segments, {100 * explained:.0f} % of the points within {dx:.2g} m of one"
        figure_segments(cloud.points, found, groups, title).savefig(folder / "segments.png", dpi=150)
    target = Path(output) if output else Path(f"{path.stem}_segments")
    seconds = time.perf_counter() - began
    segments = Segments(found.start + cloud.origin, found.end + cloud.origin, found.count, found.radius)
    summary = (
        *_summary_of_cloud(path.name, cloud, len(points), voxel, dx),
        f"found     {len(found)} segments, {found.length.sum():.1f} m in all, in {seconds:.1f} s",
        f"explained {100 * explained:.0f} % of the points lie within dx of a segment "
        f"({100 * filtered:.0f} % of the filtered ones)",
        *_summary_of_segments(segments, groups),
        *([_summary_of_structure(built)] if built is not None else []),
        f"written   {target}/: segments.csv, .json, .obj, .ply, .png{'; structure.json' if structure else ''}",
    )
    return SegmentReport(target, segments, built, voxel, dx, explained, filtered, seconds, summary)


def _structure(cloud: Cloud, dx_m: float, folder: Path, source: str) -> Structure:
    """Bars and joints of a cloud in the coordinates of its file, written to ``structure.json``."""
    settings = StructureSettings.for_cloud(dx_m)
    try:
        found = reconstruct_cloud(cloud.points, settings)
    except SettingsError as fault:  # so fine a dx that the cloud's voxels cannot be numbered
        found = Structure.empty(str(fault))
    s = found.segments
    segments = Segments(s.start + cloud.origin, s.end + cloud.origin, s.count, s.radius)
    placed = replace(found, segments=segments, joint=found.joint + cloud.origin)
    about = {"source": source, "settings": settings.model_dump()}
    export_structure(placed, folder / "structure.json", about=about)
    return placed


def _summary_of_structure(structure: Structure) -> str:
    if not len(structure):
        return f"structure empty: {structure.reason}"
    pieces = structure.graph().number_of_edges()
    return f"structure {len(structure)} bars, {len(structure.joint)} joints, {pieces} pieces of bars between joints"


def point_spacing(points: Array) -> float:
    """Median distance of a point of ``(N, 3)`` to its fourth neighbour, metres.

    The fourth: along a bar a point has two neighbours on either side, so this is two steps. Unlike the distance to
    the nearest, it hardly depends on whether points are spread evenly or at random, nor on near-duplicates.
    """
    asked = points[np.linspace(0, len(points) - 1, min(len(points), 5000)).astype(int)]
    distance = cKDTree(points).query(asked, k=min(5, len(points)))[0][:, -1]
    return float(np.median(distance))


def tube_radius(points: Array, thinned: bool = False) -> float:
    """The dx of a cloud ``(N, 3)``, metres: the larger of its point spacing and the width of its bars.

    Not less than the spacing (`point_spacing`), for then a tube would hold too few points to show a line. Not less
    than the width, for then each bar would come out as several. The width is twice the root mean square distance of
    points to the axis of their own surroundings, in spheres of the smallest radius at which surroundings look
    straight: 30 % of the spheres have a standard deviation across that is less than 30 % of that along. Where no
    radius up to a tenth of the cloud's diagonal does that, bars are too close together to be told apart before they
    are found, and the spacing decides. The spacing of a ``thinned`` cloud is that of its voxels, and tells nothing of
    its bars: there the radius at which surroundings look straightest decides, if they do to some degree.
    """
    spacing = point_spacing(points)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    radius, straightest, across = 2 * spacing, STRAIGHT_THINNED, 0.0
    while radius <= diagonal / 10:
        thin = voxel_grid(points, radius / 8)  # enough points for a sphere, few enough to be quick
        centres = thin[np.linspace(0, len(thin) - 1, min(len(thin), 500)).astype(int)]
        spheres = [thin[index] for index in cKDTree(thin).query_ball_point(centres, radius) if len(index) >= 8]
        if len(spheres) >= len(centres) / 2:
            variance = np.linalg.eigvalsh([np.cov(sphere.T) for sphere in spheres]).clip(0)
            straightness = 1 - np.sqrt(variance[:, 1] / variance[:, 2])
            bound = np.quantile(straightness, 0.7)
            if bound >= straightest:
                width = float(np.median(2 * np.sqrt(variance[:, 0] + variance[:, 1])[straightness >= bound]))
                if bound >= STRAIGHT:
                    return max(spacing, width)
                straightest, across = float(bound), width
        radius *= math.sqrt(2)
    return max(spacing, across) if thinned and across else min(spacing, diagonal / 4)


def _check_length(name: str, value: float | None, cloud: Cloud) -> None:
    if value is None:
        return
    diagonal = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    # Finer than this, voxels could not be numbered.
    if not 1e-9 * diagonal <= value <= diagonal:
        raise SettingsError(f"{name} = {value}: expected a length above 0 and at most the cloud's {diagonal:.3g} m")


def _size(cloud: Cloud) -> int:
    return len(cloud) if cloud.count is None else int(cloud.count.sum())


def _summary_of_cloud(name: str, cloud: Cloud, filtered: int, voxel: float, dx: float) -> list[str]:
    dropped = f"{cloud.dropped_duplicates} duplicates and {cloud.dropped_invalid} invalid ones dropped"
    apart = f"{point_spacing(cloud.points):.3g} m apart"
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
        those = length[[other == group for other in groups]]
        name = group.replace("_", " ")
        lines.append(f"          {name:16}{len(those):9d}{those.sum():10.1f}{those.max(initial=0):11.1f}")
    for k in range(min(3, len(segments))):
        ends = (f"({', '.join(f'{v:.2f}' for v in end[k])})" for end in (segments.start, segments.end))
        lines.append(f"longest   {length[k]:.2f} m from {' to '.join(ends)}" if k == 0 else
                     f"          {length[k]:.2f} m from {' to '.join(ends)}")  # fmt: skip
    return lines
