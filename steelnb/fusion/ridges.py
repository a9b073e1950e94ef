"""Ridges of the weight of a voxel map: the voxels along bars, without the range noise around them."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.points import VoxelMap
from steelnb.points.voxel_kernels import EMPTY, pack
from steelnb.types import Array, IntArray


def ridge_points(
    voxels: VoxelMap, radius_m: float, share_min: float, contract_m: float, hidden: NDArray[np.bool_] | None = None
) -> Array:
    """Points on ridges ``(R, 3)``, metres, in the frame of the map.

    Range noise spreads the points of a bar along the rays, into voxels of little weight. So a voxel stays if it has at
    least ``share_min`` of the largest weight within ``radius_m``. The means of these voxels move once to the weighted
    mean of those within ``contract_m``. The voxels in ``hidden (V,)`` have no weight.
    """
    grid = voxels.grid()
    mean, weight = voxels.means(), voxels.weights()
    if hidden is not None:
        weight[hidden] = 0.0
    index = np.floor(mean / grid.voxel_m).astype(np.int64)
    centre = pack(index[:, 0], index[:, 1], index[:, 2])
    order = np.argsort(centre, kind="stable")
    used = np.flatnonzero(grid.key != EMPTY)
    used = used[np.argsort(grid.key[used], kind="stable")]
    key, slot = grid.key[used], grid.slot[used]
    stay = np.zeros(len(weight), dtype=bool)
    columns = _columns(_offsets(radius_m, grid.voxel_m))
    stay[order] = _ridge(centre[order], weight[order], key, weight[slot], *columns[:2], share_min)
    remaining = np.where(stay, weight, 0.0)
    columns = _columns(_offsets(contract_m + math.sqrt(3) * grid.voxel_m, grid.voxel_m))
    contracted = mean.copy()
    contracted[order] = _contract(
        centre[order], mean[order], remaining[order], key, mean[slot], remaining[slot], *columns, contract_m
    )  # fmt: skip
    return np.asarray(contracted[stay])


def _offsets(radius_m: float, voxel_m: float) -> IntArray:
    """Offsets ``(K, 3)`` of the voxels whose centres lie within a radius, in voxels, nearest first."""
    reach = int(radius_m / voxel_m)
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(steps, axis=1)
    order = np.argsort(distance, kind="stable")
    return np.asarray(steps[order][distance[order] * voxel_m <= radius_m + 1e-9], dtype=np.int64)


def _columns(steps: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Offsets ``(K, 3)`` grouped by columns along z, in which the keys (`pack`) of voxels are consecutive.

    For each of C columns, nearest first: key of its middle relative to the centre ``(C,)``, its half-height in voxels
    ``(C,)``, and the indices of its voxels in ``steps`` ``(C, 2 · height + 1)``.
    """
    level = steps[steps[:, 2] == 0]
    height = np.array([steps[(steps[:, :2] == at[:2]).all(axis=1), 2].max() for at in level])
    index_of = {tuple(step): k for k, step in enumerate(steps.tolist())}
    rank = np.zeros((len(level), 2 * int(height.max()) + 1), dtype=np.int64)
    for c, (i, j, _) in enumerate(level.tolist()):
        for k in range(-int(height[c]), int(height[c]) + 1):
            rank[c, k + height[c]] = index_of[i, j, k]
    return pack(level[:, 0], level[:, 1], level[:, 2]) - pack(0, 0, 0), height, rank


@njit(cache=True)
def _onward(key, p, low):  # type: ignore[no-untyped-def]
    """The first index from ``p`` on whose key is not below ``low``."""
    while p < len(key) and key[p] < low:
        p += 1
    return p


@njit(cache=True, nogil=True)
def _ridge(centre, weight, key, heavy, column, height, share_min):  # type: ignore[no-untyped-def]
    """Mask of the centres that stay. Centres and voxels are both sorted by key, so the columns advance with the
    centres, and memory is read in order."""
    stay = weight > 0.0
    at = np.zeros(len(column), np.int64)
    for n in range(len(centre)):
        if not stay[n]:
            continue
        bound = weight[n] / share_min
        for c in range(len(column)):
            low, high = centre[n] + column[c] - height[c], centre[n] + column[c] + height[c]
            p = at[c] = _onward(key, at[c], low)
            while p < len(key) and key[p] <= high:
                if heavy[p] > bound:
                    stay[n] = False
                    break
                p += 1
            if not stay[n]:
                break
    return stay


@njit(cache=True, nogil=True)
def _contract(centre, mean, remaining, key, others, weight, column, height, rank, radius):  # type: ignore[no-untyped-def]
    contracted = mean.copy()
    at = np.zeros(len(column), np.int64)
    found = np.empty(rank.max() + 1, np.int64)
    for n in range(len(centre)):
        if remaining[n] == 0.0:
            continue
        found[:] = -1
        for c in range(len(column)):
            low, high = centre[n] + column[c] - height[c], centre[n] + column[c] + height[c]
            p = at[c] = _onward(key, at[c], low)
            while p < len(key) and key[p] <= high:
                found[rank[c, key[p] - low]] = p
                p += 1
        total = x = y = z = 0.0
        for k in range(len(found)):  # nearest first, so that the sum does not depend on the keys
            p = found[k]
            if p < 0 or weight[p] == 0.0:
                continue
            dx, dy, dz = others[p, 0] - mean[n, 0], others[p, 1] - mean[n, 1], others[p, 2] - mean[n, 2]
            if dx * dx + dy * dy + dz * dz <= radius * radius:
                w = weight[p]
                total += w
                x += w * others[p, 0]
                y += w * others[p, 1]
                z += w * others[p, 2]
        contracted[n, 0], contracted[n, 1], contracted[n, 2] = x / total, y / total, z / total
    return contracted
