"""`steelnb segment CLOUD`: point cloud of a structure → its bars, as a table, a picture and a summary."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name, new_folder
from steelnb.core.types import Array, Segments
from steelnb.fusion.bars import LENGTH_MIN_M, TUBE_M
from steelnb.fusion.cloud_bars import CloudBars, bars_of_cloud, default_tube
from steelnb.hough.lines import spacing
from steelnb.hough.whole_structure import MIN_VOTES
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.structures import write_segments
from steelnb.plots.draw import figure_bars
from steelnb.plots.scene3d import figure_cloud
from steelnb.points import voxel_grid
from steelnb.points.surfaces import Surface
from steelnb.settings import read_options

SURFACES_SHOWN = 5
VOXELS_FEW = 10
"""If a cloud, or what voxels leave of it, has fewer points than this many bars need, the message blames that."""
VOXELS_MAX = 12
"""Maximum radius of a tube, in voxels: the time of the search grows with its cube."""
FINEST = 1e-5
"""Minimum ``dx`` and voxel, as a share of the cloud's diagonal."""
FLAT_M = 0.1
"""Maximum root mean square distance of a flat surface from its plane."""
EXPLAINED_MIN = 0.5
"""The user is warned if bars explain a smaller share than this of the points that lie on no surface."""

APART = "look like parts of trees or vehicles, as most points around them are on no bar"


@dataclass(frozen=True, eq=False)
class SegmentReport:
    """``segments`` in the coordinates of the file, the longest first, with their ``freedom (B,)`` and ``width_m (B,)``
    (`CloudBars`).

    Shares of the file's distinct points: ``explained``, within a tube or half the width of a bar, of those that
    lie on no surface; ``on_surfaces``. ``dx_m``: radius of the tube; ``summary`` and ``warnings``: lines of text.
    """

    segments: Segments
    freedom: Array
    width_m: Array
    voxel_m: float
    dx_m: float
    explained: float
    on_surfaces: float
    summary: tuple[str, ...]
    warnings: tuple[str, ...]


def segment_file(
    path: Path | str,
    output: Path | str,
    *,
    voxel_m: float | None = None,
    dx_m: float | None = None,
    min_votes: int | None = None,
    scene: bool = False,
    on_stage: Callable[[str], None] | None = None,
    unit: str | None = None,
    columns: Sequence[str] | None = None,
) -> SegmentReport:
    """Find the bars in the cloud of a file and write ``segments.csv`` and ``segments.png`` to the folder ``output``;
    with ``scene``, also the interactive ``segments.html``.

    Ground, walls and other surfaces are recognised and left out (`steelnb.fusion.cloud_bars`). ``dx_m`` is the radius
    of the tube that holds a bar's points (default: `bars_of_cloud`), ``voxel_m`` the edge of the voxel filter (default:
    two thirds of dx). ``min_votes`` is the minimum number of voxels of a bar, and the minimum by which those in its
    tube exceed those around it. ``on_stage`` is told what goes on. ``unit`` and ``columns``: as for `read_cloud`, by
    default those of a ``recording.toml`` beside the file.

    Raises the errors of `read_cloud`, `InputError` and `OutputError`; nothing is written then.
    """
    path, began = Path(path), time.perf_counter()
    min_votes = MIN_VOTES if min_votes is None else min_votes
    if min_votes < 2:
        raise InputError(f"min_votes = {min_votes}: expected at least 2")
    with new_folder(output) as folder:
        stated = read_options(path.parent, unit=unit, columns=columns)
        cloud = read_cloud(path, unit=stated.unit, columns=stated.columns)
        _check_length("voxel_m", voxel_m, cloud)
        _check_length("dx_m", dx_m, cloud)
        if voxel_m is not None and voxel_m < (least_m := (dx_m or default_tube(cloud.points)) / VOXELS_MAX):
            raise InputError(f"voxel_m = {voxel_m}: expected at least {least_m:.2g} m, a twelfth of the tube (--dx)")
        apart_m = spacing(cloud.points)
        found = bars_of_cloud(cloud.points, dx_m, voxel_m, min_votes, on_stage)
        found = found.take(np.argsort(-found.bars.length, kind="stable"))
        bars, off, dx = found.bars, found.surface < 0, found.tube_m
        explained = float(found.within(1.0).mean()) if off.any() else 0.0
        segments = bars.moved(cloud.origin)
        more = {"width_m": found.width_m.round(3), "freedom": found.freedom.round(2)}
        write_segments(segments, folder / "segments.csv", more=more)
        title = f"{display_name(path)}: {len(bars)} bars, {bars.length.sum():.1f} m"
        figure_bars(cloud.points, bars, title, ~off, found.freedom).savefig(folder / "segments.png", dpi=150)
        if scene:
            figure_cloud(cloud.points, bars, ~off).write_html(folder / "segments.html", include_plotlyjs=True)
    voxel, least = found.voxel_m, found.narrowest_m
    slim = f", {least:.2g} m for slim members" if least < dx else ""
    on_surfaces = float(1 - off.mean())
    bar_share = explained * (1 - on_surfaces)
    largest = sorted(found.surfaces, key=lambda surface: -surface.area_m2)
    surfaces = [f"surface   {_name(each)}, {each.area_m2:.0f} m²: {each.points} points left out" for each in largest]
    if len(surfaces) > SURFACES_SHOWN:
        surfaces[SURFACES_SHOWN:] = [f"surface   and {len(surfaces) - SURFACES_SHOWN} more"]
    summary = (
        f"read      {display_name(path)}: {cloud.facts['read']}, {len(cloud)} points ({cloud.duplicates} duplicates "
        f"and {cloud.invalid} invalid ones dropped)",
        f"cloud     {' × '.join(f'{size:.3g}' for size in cloud.extent_m)} m, points {apart_m:.3g} m apart; unit "
        f"{cloud.facts['unit']}" + (f"; viewpoint {cloud.facts['viewpoint']}" if "viewpoint" in cloud.facts else ""),
        f"settings  voxel {voxel:.3g} m, dx {dx:.3g} m{slim}: members closer than {2 * least:.2g} m to each other are "
        f"one, and those shorter than {(2 + LENGTH_MIN_M / TUBE_M) * least:.2g} m are not found",
        *surfaces,
        f"found     {len(bars)} bars, {bars.length.sum():.1f} m in all, the longest "
        f"{bars.length.max(initial=0):.1f} m, in {time.perf_counter() - began:.1f} s",
        *([f"left out  {found.apart} lines that {APART}"] if found.apart else []),
        f"points    {100 * bar_share:.0f} % on bars, {100 * on_surfaces:.0f} % on surfaces, "
        f"{100 * (1 - bar_share - on_surfaces):.0f} % on neither",
        f"written   {output}/: segments.csv, segments.png" + (", segments.html" if scene else ""),
    )
    warnings = _warnings(found, explained, cloud, min_votes)
    return SegmentReport(
        segments, found.freedom, found.width_m, voxel, dx, explained, on_surfaces, summary, warnings
    )  # fmt: skip


def _name(surface: Surface) -> str:
    kind = "curved" if surface.rms_m > FLAT_M else "level" if surface.is_level else "upright"
    if kind == "level":
        return f"level at {surface.centre[2]:.1f} m"
    return f"{kind} around ({', '.join(f'{x:.1f}' for x in surface.centre)}) m"


def _warnings(found: CloudBars, explained: float, cloud: Cloud, min_votes: int) -> tuple[str, ...]:
    lines = list[str]()
    if not len(found.bars):
        left = len(voxel_grid(cloud.points, found.voxel_m))
        why = "the points on no surface do not lie along lines"
        if found.all_on_surfaces:
            why = "all points lie on surfaces"
        elif found.apart:
            why = f"the {found.apart} lines look like parts of trees or vehicles: most points around them are on none"
        elif len(cloud) < VOXELS_FEW * min_votes:
            why = f"the cloud has only {len(cloud)} points, and a bar needs {min_votes} voxels along a line"
        elif left < VOXELS_FEW * min_votes:
            why = f"voxels of {found.voxel_m:.3g} m leave {left} of {len(cloud)} points, and a bar needs {min_votes}"
        elif not np.isnan(found.typical_m):
            why = f"no line stands free in tubes of {found.tube_m:.2g} m; narrower ones (--dx) tell close members apart"
        lines.append(f"no bar found: {why}")
    elif explained < EXPLAINED_MIN:
        lines.append(
            f"bars explain {100 * explained:.0f} % of the {len(found.steel)} points that lie on no surface: is this a"
            " structure of bars, and is the tube as wide as one of them (--dx)?"
        )
    return tuple(lines)


def _check_length(name: str, value: float | None, cloud: Cloud) -> None:
    diagonal = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    # The voxels of a finer grid could not be numbered.
    if value is not None and not FINEST * diagonal <= value <= diagonal:
        bounds = f"from {FINEST * diagonal:.1g} to the cloud's {diagonal:.3g} m"
        raise InputError(f"{name} = {value}: expected a length above 0, {bounds}")
