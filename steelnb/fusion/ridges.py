"""Ridges in the weights of a voxel map: the voxels along bars, without the range noise around them, and without the
surfaces, where lines in any direction would pass for bars."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.core.kernels import njit
from steelnb.core.types import Array
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.neighbours import advance, columns_of, gather
from steelnb.points.surface_search import surfaces_of
from steelnb.points.surfaces import Surfaces
from steelnb.points.voxel_kernels import offsets_within

TUBE_M, VOXEL_M = 0.06, 0.04
"""Radius of the tube that contains a bar's points, and edge of the voxels that accumulate the scans. These and the
other lengths and shares of reconstruction were tuned with ``starling2`` on ``zigzag`` and ``loops`` flights around the
tower ``tapered`` and one with flanges of 160 mm."""
RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M = 0.15, 0.2, 0.08
"""See `ridge_points`."""
CELL, CELL_VOXELS = 2.5, 1.5
"""Edge of the cells in which surfaces are sought, in multiples of `VOXEL_M`, and its minimum in voxels of the map."""


@dataclass(frozen=True, eq=False)
class Ridges:
    """The ridges of a voxel map: ``points (R, 3)``, metres, thinned to a few in a tube's radius, and the
    ``surfaces`` of the map, in which no bars are sought."""

    voxels: VoxelMap
    points: Array
    surfaces: Surfaces

    @classmethod
    def of(cls, voxels: VoxelMap, sum_m: float = 0.0) -> "Ridges":
        """Those of a map; ``sum_m`` as in `ridge_points`."""
        points = voxel_grid(
            ridge_points(voxels, RIDGE_RADIUS_M, RIDGE_SHARE, CONTRACT_M, sum_m=sum_m), TUBE_M / math.sqrt(3)
        )
        return cls(voxels, points, surfaces_of(voxels, points, max(CELL * VOXEL_M, CELL_VOXELS * voxels.voxel_m)))

    @property
    def off_surfaces(self) -> Array:
        """The points that lie on no surface ``(N, 3)``."""
        return self.points[self.surfaces.label_of(self.points) < 0]


def ridge_points(
    voxels: VoxelMap,
    radius_m: float,
    share_min: float,
    contract_m: float,
    hidden: NDArray[np.bool_] | None = None,
    sum_m: float = 0.0,
) -> Array:
    """Points on ridges ``(R, 3)``, metres, in the frame of the map.

    Range noise spreads the points of a bar along the rays, into voxels of little weight. So a voxel is kept if it
    has at least ``share_min`` of the largest weight within ``radius_m``. Its mean is then moved, once, to the weighted
    mean of the kept voxels within ``contract_m``. Voxels in the mask ``hidden (V,)`` are ignored.

    ``sum_m``: radius in which weights are summed first. In sparse clouds, and in those thinned by a voxel filter, most
    voxels have one point, so that only their neighbours tell a bar from the noise around it.
    """
    key, mean, weight, voxel_m = voxels.keys(), voxels.means(), voxels.weights(), voxels.voxel_m
    if hidden is not None:
        weight[hidden] = 0.0
    order = np.argsort(key, kind="stable")  # the same on every processor: keys differ, and it has no vector code
    key, mean, weight = key[order], mean[order], weight[order]
    if sum_m > 0.0:
        weight = _summed(key, weight, columns_of(offsets_within(sum_m, voxel_m)))
    is_ridge = _ridge(key, weight, columns_of(offsets_within(radius_m, voxel_m)), share_min)
    around = columns_of(offsets_within(contract_m + math.sqrt(3) * voxel_m, voxel_m))
    contracted = _contract(key[is_ridge], mean[is_ridge], weight[is_ridge], around, contract_m)
    return np.asarray(contracted[np.argsort(order[is_ridge], kind="stable")])  # in the order of the map


@njit(cache=True, nogil=True)
def _summed(key, weight, around):  # type: ignore[no-untyped-def]
    """Sum of the weights of the voxels around each voxel; their keys are sorted."""
    total = np.zeros(len(key))
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    for n in range(len(key)):
        advance(key, n, around, first, last)
        for k in range(gather(key, n, around, first, last, at, others)):
            total[n] += weight[others[k]]
    return total


@njit(cache=True, nogil=True)
def _ridge(key, weight, around, share_min):  # type: ignore[no-untyped-def]
    """Mask of the voxels that are kept."""
    is_ridge = weight > 0.0
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    for n in range(len(key)):
        if not is_ridge[n]:
            continue
        bound = weight[n] / share_min
        advance(key, n, around, first, last)
        for c in range(len(first)):
            for k in range(first[c], last[c]):
                is_ridge[n] &= weight[k] <= bound
    return is_ridge


@njit(cache=True, nogil=True)
def _contract(key, mean, weight, around, radius):  # type: ignore[no-untyped-def]
    """Weighted means of the voxels within a radius of each voxel."""
    contracted = mean.copy()
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    for n in range(len(key)):
        advance(key, n, around, first, last)
        total = x = y = z = 0.0
        for k in range(gather(key, n, around, first, last, at, others)):
            other = others[k]
            dx, dy, dz = mean[other, 0] - mean[n, 0], mean[other, 1] - mean[n, 1], mean[other, 2] - mean[n, 2]
            if dx * dx + dy * dy + dz * dz <= radius * radius:
                w = weight[other]
                total += w
                x += w * mean[other, 0]
                y += w * mean[other, 1]
                z += w * mean[other, 2]
        contracted[n, 0], contracted[n, 1], contracted[n, 2] = x / total, y / total, z / total
    return contracted
