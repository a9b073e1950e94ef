"""Bars proposed from a voxel map: ridges of weight, lines in blocks of them, pieces merged in line."""

import math

import numpy as np

from steelnb.fusion.merging import merge_pieces
from steelnb.fusion.regions import is_lattice, linear_share
from steelnb.fusion.ridges import ridge_points
from steelnb.fusion.scales import Scales
from steelnb.hough.blocks import SHADOW, segment_structure, within
from steelnb.hough.long_bars import long_bars
from steelnb.points import VoxelMap, voxel_grid
from steelnb.settings import StructureSettings
from steelnb.types import Segments

RIDGE_SHARE = 0.2
"""Least weight of a voxel on a ridge, as a share of the largest around it. Chosen with `fusion.scales.Scales`."""
LINEAR_SHARE_MIN, BLURRED_SHARE_MIN = 0.5, 0.25
"""Least share of the length of all lines outside planar and volumetric regions (`regions.linear_share`: at most 0.02 in
shapes without bars, at least 0.75 on towers scanned closely); and that of a map which an adjustment is to sharpen: with
errors of range, mount and clock, 0.48 in the first map of a flight, the least of seeds 11 to 14."""
GRIDS = 4
"""Grids of blocks in which bars are proposed. On flights eight find no more."""


def find_bars(
    voxels: VoxelMap,
    settings: StructureSettings,
    grids: int = GRIDS,
    coarse: bool = False,
    rise_m: float = math.inf,
    linear_min: float = LINEAR_SHARE_MIN,
) -> tuple[Segments, str]:
    """Bars of a voxel map, their axes in the middle of their points, strongest first; or none, and the reason.

    ``grids``: grids of blocks, 1 to 8 (`segment_structure`). ``coarse``: bars may be only a few tubes apart.
    ``rise_m``: bars that rise by more across a stronger one are no copies of it (`fusion.merging`). ``linear_min``:
    least share of lines outside planar and volumetric regions.
    """
    tube, votes, s = settings.tube_m, settings.min_votes, Scales.at(settings.tube_m)
    points = voxel_grid(ridge_points(voxels, s.ridge_radius_m, RIDGE_SHARE, s.contract_m), tube / math.sqrt(3))
    if len(points) < votes or not np.linalg.norm(np.ptp(points, axis=0)) > 2 * s.length_min_m:
        return Segments.empty(), f"{len(points)} points on ridges: too few or too close together for a bar"
    lines = segment_structure(points, tube, votes, s.length_min_m / tube, grids)
    bars = _with_struts(voxels, lines, settings, grids, rise_m)
    # A bar inside a lattice looks volumetric, but not most of a structure; unless the cloud is so coarse that all its
    # bars are near others: then braces claim the points of the legs, unless long bars come first.
    if len(bars) and linear_share(points, bars, 2 * tube) < linear_min:
        if not (coarse and is_lattice(points, lines, tube, votes, s.length_min_m / tube)):
            return Segments.empty(), f"most of {len(bars)} lines lie in planar or volumetric regions"
        long = long_bars(voxels.means(), tube, votes)
        left = points[~within(points, long, SHADOW * tube)]
        lines = segment_structure(left, tube, votes, s.length_min_m / tube, grids) if len(left) else Segments.empty()
        lines = Segments.joined((long, lines))
        bars = _with_struts(voxels, lines, settings, grids, rise_m)
    return bars, "" if len(bars) else f"none of {len(points)} points on ridges lie along a line"


def _with_struts(voxels: VoxelMap, lines: Segments, settings: StructureSettings, grids: int, rise_m: float) -> Segments:
    """Bars of the lines of a voxel map, and the short ones between them."""
    gap_m, tube = Scales.at(settings.tube_m).gap_max_m, settings.tube_m
    bars = merge_pieces(lines, gap_m, settings.copy_distance_m, tube, rise_m=rise_m)
    if not len(bars):
        return bars
    more = find_struts(voxels, bars, settings, Scales.at(tube).strut_hide_m, grids)
    return merge_pieces(Segments.joined((bars, more)), gap_m, settings.copy_distance_m, tube, rise_m=rise_m)


def find_struts(
    voxels: VoxelMap, bars: Segments, settings: StructureSettings, hide_m: float, grids: int = GRIDS
) -> Segments:
    """Short bars between the ``bars`` of a voxel map.

    A short bar between long ones is weak beside them, and its ends lie within their tubes: it is found in what they
    leave, the voxels further than ``hide_m`` from all of them.
    """
    tube, votes, s = settings.tube_m, settings.min_votes, Scales.at(settings.tube_m)
    hidden = within(voxels.means(), bars, hide_m)
    left = ridge_points(voxels, s.ridge_radius_m, RIDGE_SHARE, s.strut_contract_m, hidden)
    left = voxel_grid(left, s.strut_tube_m / math.sqrt(3))
    if len(left) < votes:
        return Segments.empty()
    more = segment_structure(left, s.strut_tube_m, votes, s.strut_length_min_m / s.strut_tube_m, grids)
    return more.take(_between_bars(more, bars, s.reach_m, tube))


def _between_bars(some: Segments, bars: Segments, lead_m: float, aside_m: float) -> np.ndarray:
    """Mask of the segments that come within ``aside_m`` of a bar at both ends, extended by up to ``lead_m``."""
    step = np.arange(0, lead_m + 1e-9, 0.03)[:, None, None]
    led = np.stack([some.start - step * some.direction, some.end + step * some.direction])
    near = within(led.reshape(-1, 3), bars, aside_m).reshape(led.shape[:3])
    return np.asarray(near.any(axis=1).all(axis=0))
