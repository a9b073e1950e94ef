"""Which points of a scan lie on which bar: bars own voxels, and voxels tell points."""

import math

import numpy as np
from numba import njit

from steelnb.mapping.kernels import find, pack


@njit(cache=True)
def world(points, T, range_max, floor):  # type: ignore[no-untyped-def]
    """Points ``(N, 3)`` of a scan in the world frame and their weights, 1/range²; no NaN, nothing below the floor."""
    placed, weight = np.empty((len(points), 3)), np.empty(len(points))
    n = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y + z * z
        if not 0.0 < square <= range_max * range_max:  # NaN too
            continue
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if height < floor:
            continue
        placed[n, 0] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        placed[n, 1] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        placed[n, 2] = height
        weight[n] = 1.0 / square
        n += 1
    return placed[:n], weight[:n]


@njit(cache=True)
def owners(start, direction, length, mean, radius, margin):  # type: ignore[no-untyped-def]
    """The bar of each voxel: the nearest within ``radius``, or −1 where another is nearly as near (``margin``)."""
    owner = np.full(len(mean), -1, np.int64)
    # Bars by the cells of a coarse grid that they come near: counted first, then written.
    low, high, size = np.empty(3), np.empty(3), np.empty(3, np.int64)
    for k in range(3):
        end = start[:, k] + length * direction[:, k]
        low[k] = min(start[:, k].min(), end.min()) - 2.0 * radius
        high[k] = max(start[:, k].max(), end.max()) + 2.0 * radius
    edge = max(4.0 * radius, (high - low).max() / 256)
    for k in range(3):
        size[k] = int((high[k] - low[k]) / edge) + 1
    first = np.zeros(size[0] * size[1] * size[2] + 1, np.int64)
    listed = np.empty(0, np.int32)
    for write in range(2):
        last = np.full(len(first) - 1, -1, np.int64)
        for b in range(len(length)):
            steps = int(length[b] / radius) + 1
            for k in range(steps + 1):
                at = start[b] + length[b] * k / steps * direction[b] - low
                # Between two steps a bar's tube reaches no further than 1.5 radii from either.
                for i in range(int((at[0] - 1.5 * radius) / edge), int((at[0] + 1.5 * radius) / edge) + 1):
                    for j in range(int((at[1] - 1.5 * radius) / edge), int((at[1] + 1.5 * radius) / edge) + 1):
                        for m in range(int((at[2] - 1.5 * radius) / edge), int((at[2] + 1.5 * radius) / edge) + 1):
                            cell = (i * size[1] + j) * size[2] + m
                            if last[cell] != b:
                                last[cell] = b
                                if write:
                                    listed[first[cell]] = b
                                first[cell] += 1
        if write == 0:
            total = 0
            for cell in range(len(first)):
                first[cell], total = total, total + first[cell]
            listed = np.empty(total, np.int32)
    for n in range(len(mean)):
        i, j, m = (mean[n, 0] - low[0]) / edge, (mean[n, 1] - low[1]) / edge, (mean[n, 2] - low[2]) / edge
        if not (0.0 <= i < size[0] and 0.0 <= j < size[1] and 0.0 <= m < size[2]):
            continue
        cell = (int(i) * size[1] + int(j)) * size[2] + int(m)
        nearest = second = np.inf
        for k in range(first[cell - 1] if cell else 0, first[cell]):
            b = listed[k]
            x, y, z = mean[n, 0] - start[b, 0], mean[n, 1] - start[b, 1], mean[n, 2] - start[b, 2]
            t = x * direction[b, 0] + y * direction[b, 1] + z * direction[b, 2]
            t = min(max(t, 0.0), length[b])
            x, y, z = x - t * direction[b, 0], y - t * direction[b, 1], z - t * direction[b, 2]
            distance = math.sqrt(x * x + y * y + z * z)
            if distance < nearest:
                nearest, second = distance, nearest
                owner[n] = b
            elif distance < second:
                second = distance
        if nearest > radius or second - nearest < margin:
            owner[n] = -1
    return owner


@njit(cache=True)
def on_bars(points, T_map, T, range_max, floor, owner, voxel, table_key, table_slot):  # type: ignore[no-untyped-def]
    """Points of a scan that lie on bars, at the pose ``T``, and their bars; found at the pose ``T_map`` of the map."""
    placed, bar = np.empty((len(points), 3)), np.empty(len(points), np.int64)
    n = 0
    inverse = 1.0 / voxel
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        if not 0.0 < x * x + y * y + z * z <= range_max * range_max:  # NaN too
            continue
        height = T_map[2, 0] * x + T_map[2, 1] * y + T_map[2, 2] * z + T_map[2, 3]
        if height < floor:
            continue
        i = np.int64(np.floor((T_map[0, 0] * x + T_map[0, 1] * y + T_map[0, 2] * z + T_map[0, 3]) * inverse))
        j = np.int64(np.floor((T_map[1, 0] * x + T_map[1, 1] * y + T_map[1, 2] * z + T_map[1, 3]) * inverse))
        slot = find(pack(i, j, np.int64(np.floor(height * inverse))), table_key, table_slot)
        if slot < 0 or owner[slot] < 0:
            continue
        for k in range(3):
            placed[n, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
        bar[n] = owner[slot]
        n += 1
    return placed[:n], bar[:n]
