"""`steelnb segment CLOUD`: point cloud of a structure → its bars, as a table, a picture and a summary."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name, new_folder
from steelnb.core.types import Array, Segments
from steelnb.fusion.cloud_bars import CloudBars, bars_of_cloud
from steelnb.hough.tubes import COST
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.structures import write_segments
from steelnb.plots.draw import figure_bars
from steelnb.plots.scene3d import figure_cloud
from steelnb.points.surfaces import Surface
from steelnb.settings import read_options

SURFACES_SHOWN = 5
POINTS_FEW = 50
"""If a cloud has fewer points, the message blames that."""
FINEST = 1e-5
"""Minimum ``dx``, as a share of the cloud's diagonal."""
FLAT_M = 0.1
"""Maximum root mean square distance of a flat surface from its plane."""
EXPLAINED_MIN = 0.5
"""The user is warned if bars explain a smaller share than this of the points that lie on no surface."""

APART = "look like parts of trees or vehicles, as most points around them are on no bar"


@dataclass(frozen=True, eq=False)
class SegmentReport:
    """``segments`` in the coordinates of the file, the longest first, with their ``confidence (B,)`` and ``width_m
    (B,)`` (`CloudBars`).

    Shares of the file's distinct points: ``explained``, within a tube or half the width of a bar, of those that
    lie on no surface; ``on_surfaces``. ``dx_m``: radius of the tube; ``summary`` and ``warnings``: lines of text.
    """

    segments: Segments
    confidence: Array
    width_m: Array
    dx_m: float
    explained: float
    on_surfaces: float
    summary: tuple[str, ...]
    warnings: tuple[str, ...]


def segment_file(
    path: Path | str,
    output: Path | str,
    *,
    dx_m: float | None = None,
    confidence: float | None = None,
    keep_all: bool = False,
    scene: bool = False,
    on_stage: Callable[[str], None] | None = None,
    unit: str | None = None,
    columns: Sequence[str] | None = None,
) -> SegmentReport:
    """Find the bars in the cloud of a file and write ``segments.csv`` and ``segments.png`` to the folder ``output``;
    with ``scene``, also the interactive ``segments.html``.

    Ground, walls and other surfaces are recognised and left out (`steelnb.fusion.cloud_bars`). ``dx_m`` is the radius
    of the tube that holds a bar's points, and ``confidence`` what a bar must gain, nats; defaults are those of
    `bars_of_cloud`. With ``keep_all``, bars of no structure, and short ones that end at no other, are kept and drawn
    thin. ``on_stage`` is told what goes on. ``unit`` and ``columns``: as for `read_cloud`, by default those of a
    ``recording.toml`` beside the file.

    Raises the errors of `read_cloud`, `InputError` and `OutputError`; nothing is written then.
    """
    path, began = Path(path), time.perf_counter()
    cost = COST if confidence is None else confidence
    if not cost > 0:
        raise InputError(f"confidence = {confidence}: expected a number above 0")
    with new_folder(output) as folder:
        stated = read_options(path.parent, unit=unit, columns=columns)
        cloud = read_cloud(path, unit=stated.unit, columns=stated.columns)
        diagonal_m = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
        if dx_m is not None and not FINEST * diagonal_m <= dx_m <= diagonal_m:
            bounds = f"from {FINEST * diagonal_m:.1g} to the cloud's {diagonal_m:.3g} m"
            raise InputError(f"dx_m = {dx_m}: expected a length above 0, {bounds}")
        found = bars_of_cloud(cloud.points, dx_m, cost, on_stage, keep_all)
        bars, off, dx = found.bars, found.surface < 0, found.tube_m
        explained = float(found.within(1.0).mean()) if off.any() else 0.0
        segments = bars.moved(cloud.origin)
        more = {"width_m": found.width_m.round(3), "confidence": found.confidence.round(1)}
        write_segments(segments, folder / "segments.csv", more=more)
        title = f"{display_name(path)}: {len(bars)} bars, {bars.length.sum():.1f} m"
        figure_bars(cloud.points, bars, title, ~off, found.is_sure).savefig(folder / "segments.png", dpi=150)
        if scene:
            figure_cloud(cloud.points, bars, ~off).write_html(folder / "segments.html", include_plotlyjs=True)
    on_surfaces = float(1 - off.mean())
    bar_share = explained * (1 - on_surfaces)
    largest = sorted(found.surfaces, key=lambda surface: -surface.area_m2)
    surfaces = [f"surface   {_name(each)}, {each.area_m2:.0f} m²: {each.points} points left out" for each in largest]
    if len(surfaces) > SURFACES_SHOWN:
        surfaces[SURFACES_SHOWN:] = [f"surface   and {len(surfaces) - SURFACES_SHOWN} more"]
    summary = (
        f"read      {display_name(path)}: {cloud.facts['read']}, {len(cloud)} points ({cloud.duplicates} duplicates "
        f"and {cloud.invalid} invalid ones dropped)",
        f"cloud     {' × '.join(f'{size:.3g}' for size in cloud.extent_m)} m, points {found.apart_m:.3g} m apart; unit "
        f"{cloud.facts['unit']}" + (f"; viewpoint {cloud.facts['viewpoint']}" if "viewpoint" in cloud.facts else ""),
        f"settings  dx {dx:.3g} m: members closer than {2 * dx:.2g} m to each other are one, and one wider than "
        f"{4 * dx:.2g} m is several (--dx)",
        *surfaces,
        f"found     {len(bars)} bars, {bars.length.sum():.1f} m in all, the longest "
        f"{bars.length.max(initial=0):.1f} m, in {time.perf_counter() - began:.1f} s",
        *([f"{'unsure' if keep_all else 'left out':10}{found.apart} lines that {APART}"] if found.apart else []),
        f"points    {100 * bar_share:.0f} % on bars, {100 * on_surfaces:.0f} % on surfaces, "
        f"{100 * (1 - bar_share - on_surfaces):.0f} % on neither",
        f"written   {output}/: segments.csv, segments.png" + (", segments.html" if scene else ""),
    )
    warnings = _warnings(found, cost, explained, cloud)
    return SegmentReport(segments, found.confidence, found.width_m, dx, explained, on_surfaces, summary, warnings)


def _name(surface: Surface) -> str:
    kind = "curved" if surface.rms_m > FLAT_M else "level" if surface.is_level else "upright"
    if kind == "level":
        return f"level at {surface.centre[2]:.1f} m"
    return f"{kind} around ({', '.join(f'{x:.1f}' for x in surface.centre)}) m"


def _warnings(found: CloudBars, cost: float, explained: float, cloud: Cloud) -> tuple[str, ...]:
    lines = list[str]()
    if not len(found.bars):
        why = (
            f"no line gains {cost:g} nats in a tube of {found.tube_m:.2g} m (--confidence, --dx), except short ones"
            " that end at no other (--all)"
        )
        if len(found.steel) == 0:
            why = "all points lie on surfaces"
        elif found.apart:
            why = f"the {found.apart} lines {APART} (--all keeps them)"
        elif len(cloud) < POINTS_FEW:
            why = f"the cloud has only {len(cloud)} points"
        elif len(found.steel) < POINTS_FEW:
            why = f"only {len(found.steel)} points lie on no surface"
        lines.append(f"no bar found: {why}")
    elif explained < EXPLAINED_MIN:
        lines.append(
            f"bars explain {100 * explained:.0f} % of the {len(found.steel)} points that lie on no surface: is this a"
            " structure of bars, and is the tube as wide as one of them (--dx)?"
        )
    return tuple(lines)
