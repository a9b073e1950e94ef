"""From a voxel map to the ridges of its weight: where bars run, without the haze around them."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.mapping import VoxelMap
from steelnb.mapping.kernels import find, pack


def ridge_points(
    voxels: VoxelMap, radius_m: float, share_min: float, contract_m: float, leave: NDArray[np.bool_] | None = None
) -> Array:
    """Points on ridges ``(R, 3)``.

    A voxel stays if it has at least ``share_min`` of the largest weight within ``radius_m`` of it: range noise spreads
    a bar's points along the rays, and what it leaves there is weak beside the bar itself. Those that stay then move to
    the weighted mean of their kind within ``contract_m``, once. Voxels to ``leave`` out ``(V,)`` count for nothing.
    """
    grid, _ = voxels.grid()
    mean, weight = voxels.means(), voxels.weights()
    if leave is not None:
        weight[leave] = 0.0
    index = np.floor(mean / grid.voxel_m).astype(np.int64)
    stay = _ridge(index, weight, _offsets(radius_m, grid.voxel_m), share_min, grid.key, grid.slot)
    kept = np.where(stay, weight, 0.0)
    near = _offsets(contract_m + math.sqrt(3) * grid.voxel_m, grid.voxel_m)
    moved = _contract(index, mean, kept, near, contract_m, grid.key, grid.slot)
    return np.asarray(moved[stay])


def _offsets(radius_m: float, voxel_m: float) -> np.ndarray:
    """Steps ``(K, 3)`` to the voxels whose middles lie within a radius, nearest first."""
    reach = int(radius_m / voxel_m)
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(steps, axis=1)
    order = np.argsort(distance, kind="stable")
    return steps[order][distance[order] * voxel_m <= radius_m + 1e-9]


@njit(cache=True)
def _ridge(index, weight, offsets, share_min, table_key, table_slot):  # type: ignore[no-untyped-def]
    stay = weight > 0.0
    for n in range(len(weight)):
        if not stay[n]:
            continue
        bound = weight[n] / share_min
        for k in range(1, len(offsets)):
            other = find(
                pack(index[n, 0] + offsets[k, 0], index[n, 1] + offsets[k, 1], index[n, 2] + offsets[k, 2]),
                table_key, table_slot,
            )  # fmt: skip
            if other >= 0 and weight[other] > bound:
                stay[n] = False
                break
    return stay


@njit(cache=True)
def _contract(index, mean, kept, offsets, radius, table_key, table_slot):  # type: ignore[no-untyped-def]
    moved = mean.copy()
    for n in range(len(kept)):
        if kept[n] == 0.0:
            continue
        total = x = y = z = 0.0
        for k in range(len(offsets)):
            other = find(
                pack(index[n, 0] + offsets[k, 0], index[n, 1] + offsets[k, 1], index[n, 2] + offsets[k, 2]),
                table_key, table_slot,
            )  # fmt: skip
            if other < 0 or kept[other] == 0.0:
                continue
            dx, dy, dz = mean[other, 0] - mean[n, 0], mean[other, 1] - mean[n, 1], mean[other, 2] - mean[n, 2]
            if dx * dx + dy * dy + dz * dz <= radius * radius:
                w = kept[other]
                total += w
                x += w * mean[other, 0]
                y += w * mean[other, 1]
                z += w * mean[other, 2]
        moved[n, 0], moved[n, 1], moved[n, 2] = x / total, y / total, z / total
    return moved
