"""The search for the surfaces of a whole cloud, however densely each is sampled."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.types import Array
from steelnb.points.scan_lines import line_directions, share_of_lattice, share_of_rows
from steelnb.points.surfaces import NEAR, Surfaces
from steelnb.points.voxel_map import VoxelMap

COARSER, DENSE_MIN, CLEAR_VOXELS = (2, 4), 4, 3
"""See `surfaces_of`: wider cells, in multiples of the edge; number of points in a voxel of dense steel, or this part
of the usual one; and distance of what is sparse from it, in voxels, since range noise spreads points around a bar."""
RINGS, NEW_RINGS_MIN, BELOW_MAX, CONTINUED = (8, 16, 32), 0.02, 0.02, 6.4
"""Cells in which ground is sought that was scanned in rings, in multiples of the edge; minimum share of it that is new;
maximum share of the points below it; and how many times farther than other surfaces it continues past its cells."""
STEPS, GROUND_STEPS = 3, 9
"""Maximum number of cells by which a surface continues, and by which ground does, which is seen in strips and patches.
A member may continue a wall or a deck in its plane."""
RINGS_MAX, ROWS_MIN, LINE_CELLS = 0.8, 0.97, 2.5
"""Maximum share of the lines of rings in four directions, .4 to .6 for ground and 1 for a lattice; minimum share of
those on a wall in one direction; and radius, in cells, in which a direction is measured."""


def surfaces_of(voxels: VoxelMap, ridge: Array, cell_m: float) -> Surfaces:
    """The surfaces of a cloud: in its ridges, and in wider cells in what is sparse and off dense steel. Ground that is
    sampled more sparsely than the steel has gaps, and its points lie along many lines. Level surfaces are sought in the
    whole cloud, too: if its density varies, ground may be as dense as steel elsewhere. Towers of few points have faces
    with the look of walls, but no floors; a wall that was scanned in rows has lines in one direction. The lowest
    surface may have been scanned in rings: then its lines have all directions. All continue to their rims."""
    found, thin, weight = Surfaces.found_in(ridge, cell_m), voxels.means(), voxels.weights()
    ordered = np.sort(weight)
    usual = ordered[np.searchsorted(np.cumsum(ordered), weight.sum() / 2)]  # half of the points lie in fuller voxels
    label, is_dense = found.label_of(thin), weight >= min(DENSE_MIN, usual / DENSE_MIN)
    steel = thin[is_dense & (label < 0)]
    is_sparse = ~is_dense
    if len(steel):
        distance = cKDTree(steel).query(thin[is_sparse], distance_upper_bound=CLEAR_VOXELS * voxels.voxel_m)[0]
        is_sparse[is_sparse] = np.isinf(distance)

    def is_level_or_in_rows(wide: Surfaces) -> NDArray[np.bool_]:
        rows = _lines_off(wide, ~wide.is_level, found, thin, LINE_CELLS * cell_m, share_of_rows)
        return wide.is_level | (rows >= ROWS_MIN)

    def is_ground_in_rings(wide: Surfaces) -> NDArray[np.bool_]:
        return _lines_off(wide, _is_ground(wide, thin), found, thin, LINE_CELLS * cell_m, share_of_lattice) <= RINGS_MAX

    near_m = NEAR * cell_m
    for wider in COARSER:
        label = label if wider == COARSER[0] else found.label_of(thin)
        found = found.extended(thin[is_sparse | (label >= 0)], wider * cell_m, near_m)
        found = found.extended(thin, wider * cell_m, near_m, is_level_or_in_rows)
    for wider in RINGS:
        found = found.extended(thin, wider * cell_m, near_m, is_ground_in_rings, NEW_RINGS_MIN)
    # Last, since what is sought in wider cells must be new.
    is_in_rings = found.cell_m > COARSER[-1] * cell_m
    found = replace(found, reach_m=np.where(is_in_rings, CONTINUED, 1.0) * found.reach_m)
    return found.grown(thin, np.where(_is_ground(found, thin), GROUND_STEPS, STEPS))


def _lines_off(
    wide: Surfaces,
    chosen: NDArray[np.bool_],
    known: Surfaces,
    points: Array,
    radius_m: float,
    share: Callable[[Array], float],
) -> Array:
    """A share of the lines ``(S,)`` along which the ``points (N, 3)`` on each ``chosen (S,)`` surface lie, without
    points on known surfaces; NaN for the other surfaces."""
    found = np.full(len(wide), np.nan)
    if not chosen.any():
        return found
    label, cells_of = np.where(known.label_of(points) < 0, wide.label_of(points), -1), wide.cells
    for k in np.flatnonzero(chosen).tolist():
        cells = cells_of[k]
        normal = np.linalg.svd(cells - cells.mean(axis=0), full_matrices=False)[2][2]
        found[k] = share(line_directions(points[label == k], normal, radius_m))
    return found


def _is_ground(surfaces: Surfaces, points: Array) -> NDArray[np.bool_]:
    """Whether each surface is level and the lowest ``(S,)``: at most `BELOW_MAX` of the ``points (N, 3)`` lie below it,
    by more than twice its band."""
    is_ground, cells_of, height = surfaces.is_level, surfaces.cells, points[:, 2]
    for k in np.flatnonzero(is_ground).tolist():
        cells = cells_of[k]
        bound = cells[:, 2] - 2 * surfaces.band_m
        below, unsure = height < bound.min(), (height >= bound.min()) & (height < bound.max())
        count, most = np.count_nonzero(below), np.count_nonzero(below | unsure)
        if count / len(points) <= BELOW_MAX < most / len(points):
            nearest = cKDTree(cells[:, :2]).query(points[unsure, :2])[1]
            count += np.count_nonzero(height[unsure] < bound[nearest])
        is_ground[k] = count / len(points) <= BELOW_MAX
    return is_ground
