"""Bars proposed from a voxel map: ridges of weight, lines in blocks of them, pieces merged in line."""

import math

import numpy as np

from steelnb.fusion.joints import REACH_M
from steelnb.fusion.merging import COPY_M, GAP_MAX_M, merge_pieces
from steelnb.fusion.ridges import ridge_points
from steelnb.hough.blocks import MIN_VOTES, segment_structure, within
from steelnb.points import VoxelMap, voxel_grid
from steelnb.types import Segments

TUBE_M, VOXEL_M = 0.06, 0.04
"""Radius of the tube about a bar that holds its points, and edge of the voxels that accumulate the scans. These and the
other lengths and shares of reconstruction were chosen together on simulated flights of the preset ``starling2`` with
the development seeds 11 and 12, ``zigzag`` and ``loops``, over the tower ``tapered`` and one with wider legs (flanges
of 160 mm)."""
RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M = 0.15, 0.2, 0.08
"""A voxel stays if its weight is at least this share of the largest within the radius, and contracts to the mean within
the last."""
LENGTH_MIN_M = 0.3
"""Shortest bar."""
STRUT_TUBE_M, STRUT_LENGTH_MIN_M, STRUT_HIDE_M, STRUT_CONTRACT_M = 0.04, 0.18, 0.045, 0.05
"""Struts, short bars between two others, have a tube, a least length and a contraction of their own, and lie further
than ``STRUT_HIDE_M`` from all bars."""
GRIDS = 4
"""Grids of blocks in which bars are proposed. On flights eight find no more."""


def find_bars(voxels: VoxelMap, grids: int = GRIDS, rise_m: float = math.inf) -> tuple[Segments, str]:
    """Bars of a voxel map, their axes in the middle of their points, strongest first; or none, and the reason.

    ``grids``: grids of blocks, 1 to 8 (`segment_structure`). ``rise_m``: bars that rise by more across a stronger one
    are no copies of it (`fusion.merging`).
    """
    points = voxel_grid(ridge_points(voxels, RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M), TUBE_M / math.sqrt(3))
    if len(points) < MIN_VOTES or not np.linalg.norm(np.ptp(points, axis=0)) > 2 * LENGTH_MIN_M:
        return Segments.empty(), f"{len(points)} points on ridges: too few or too close together for a bar"
    lines = segment_structure(points, TUBE_M, MIN_VOTES, LENGTH_MIN_M / TUBE_M, grids)
    bars = merge_pieces(lines, GAP_MAX_M, COPY_M, TUBE_M, rise_m=rise_m)
    if not len(bars):
        return bars, f"none of {len(points)} points on ridges lie along a line"
    more = find_struts(voxels, bars, STRUT_HIDE_M, grids)
    return merge_pieces(Segments.joined((bars, more)), GAP_MAX_M, COPY_M, TUBE_M, rise_m=rise_m), ""


def find_struts(voxels: VoxelMap, bars: Segments, hide_m: float, grids: int = GRIDS) -> Segments:
    """Short bars between the ``bars`` of a voxel map.

    A short bar between long ones is weak beside them, and its ends lie within their tubes: it is found in what they
    leave, the voxels further than ``hide_m`` from all of them.
    """
    hidden = within(voxels.means(), bars, hide_m)
    left = ridge_points(voxels, RIDGE_RADIUS_M, RIDGE_SHARE, STRUT_CONTRACT_M, hidden)
    left = voxel_grid(left, STRUT_TUBE_M / math.sqrt(3))
    if len(left) < MIN_VOTES:
        return Segments.empty()
    more = segment_structure(left, STRUT_TUBE_M, MIN_VOTES, STRUT_LENGTH_MIN_M / STRUT_TUBE_M, grids)
    return more.take(_between_bars(more, bars, REACH_M, TUBE_M))


def _between_bars(some: Segments, bars: Segments, lead_m: float, aside_m: float) -> np.ndarray:
    """Mask of the segments that come within ``aside_m`` of a bar at both ends, extended by up to ``lead_m``."""
    step = np.arange(0, lead_m + 1e-9, 0.03)[:, None, None]
    led = np.stack([some.start - step * some.direction, some.end + step * some.direction])
    near = within(led.reshape(-1, 3), bars, aside_m).reshape(led.shape[:3])
    return np.asarray(near.any(axis=1).all(axis=0))
