"""Features of an organised scan: LOAM's edges and planes by smoothness.

Source: Zhang and Singh, "LOAM: Lidar odometry and mapping in real-time" (RSS 2014), section V.A. Rows of the image are
its scan lines. A lattice has few corners and hardly any wall: what its smoothness finds are silhouettes, which move
around a bar as the view turns.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.types import Array, IntArray

SIDE = 5
"""Points on either side of one, in its scan line, of which its smoothness is computed; as many are not chosen beside
one that was."""
REGIONS = 4
"""Parts of a scan line of which each gives its share of the features."""
SMOOTH = 5e-3
"""Smoothness above which a point may be an edge, and below which it may lie on a plane: as published."""
GRAZING = 4.0
"""A surface is roughly parallel to the ray where the range changes by this many times the way across the ray."""
STEP_M = 0.15
"""Neighbouring ranges further apart than this are of two surfaces."""
RING_GAP_RAD = 1e-3
"""Elevations of a spinning LiDAR further apart than this are of different lasers."""
RING_MAX_RAD = 1e-2
"""A group of elevations wider than this is no laser's: it is cut into lines as high as the gap is 5 times over."""


class Features(NamedTuple):
    """``point (N, 3)`` in the sensor frame, metres; ``plane (N,)``, 1 for a point on a plane and 0 for one on an edge;
    ``rank (N,)``, how many features of its kind in its part of the scan line are sharper, or flatter."""

    point: Array
    plane: IntArray
    rank: IntArray


def loam_features(image: Array, edges: int = 20, planes: int = 40) -> Features:
    """LOAM's features of an organised scan ``(H, W, 3)``, sensor frame, NaN for no return.

    Smoothness is c = ‖Σ (X_i − X_j)‖ / (|S| ‖X_i‖) over the neighbours j of point i in its scan line (equation 1);
    pixels without a return are passed over. Up to ``edges`` of the largest and ``planes`` of the smallest are chosen in
    each of four parts of a line, none beside another one of its surface, none on a surface roughly parallel to the ray
    or at the border of what something nearer hides. LOAM matches scans by the first 2 and 4 of them and builds its map
    of ten times as many.
    """
    found = np.empty((image.shape[0] * REGIONS * (edges + planes), 3))
    plane, rank = np.empty(len(found), np.int64), np.empty(len(found), np.int64)
    count = _loam_features(np.ascontiguousarray(image, dtype=np.float64), edges, planes, found, plane, rank)
    return Features(found[:count], plane[:count], rank[:count])


def scan_lines(points: Array) -> Array:
    """The scan lines ``(H, W, 3)`` of a spinning LiDAR's cloud ``(N, 3)``, sensor frame with z along its axis.

    A line for each laser, which elevations tell apart, from the lowest up; in it the returns by azimuth, then NaN.
    """
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    if not len(points):
        return np.full((0, 0, 3), np.nan)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    order = np.argsort(elevation, kind="stable")
    points, elevation = points[order], elevation[order]
    group = np.cumsum(np.diff(elevation, prepend=elevation[0]) > RING_GAP_RAD)
    low = elevation[np.searchsorted(group, np.arange(group[-1] + 1))]
    wide = np.diff(np.append(low, elevation[-1])) > RING_MAX_RAD
    within = np.where(wide[group], (elevation - low[group]) // (5 * RING_GAP_RAD), 0)
    line = np.cumsum((np.diff(group, prepend=0) > 0) | (np.diff(within, prepend=0) > 0))
    order = np.lexsort((np.arctan2(points[:, 1], points[:, 0]), line))
    points, line = points[order], line[order]
    column = np.arange(len(line)) - np.searchsorted(line, line)
    image = np.full((line[-1] + 1, column.max() + 1, 3), np.nan)
    image[line, column] = points
    return image


@njit(cache=True)
def _loam_features(image, edges, planes, found, plane, rank):
    rows, columns = image.shape[0], image.shape[1]
    column = np.empty(columns, np.int64)
    p, distance = np.empty((columns, 3)), np.empty(columns)
    smoothness, closed = np.empty(columns), np.empty(columns, np.bool_)
    count = 0
    for r in range(rows):
        n = 0
        for c in range(columns):
            x, y, z = image[r, c, 0], image[r, c, 1], image[r, c, 2]
            d = np.sqrt(x * x + y * y + z * z)
            if 0.0 < d < np.inf:
                p[n, 0], p[n, 1], p[n, 2], distance[n], column[n] = x, y, z, d, c
                n += 1
        if n < 2 * SIDE + REGIONS:
            continue
        for k in range(SIDE, n - SIDE):
            x = y = z = 0.0
            for j in range(k - SIDE, k + SIDE + 1):
                x += p[k, 0] - p[j, 0]
                y += p[k, 1] - p[j, 1]
                z += p[k, 2] - p[j, 2]
            smoothness[k] = np.sqrt(x * x + y * y + z * z) / (2 * SIDE * distance[k])
        _close(p, distance, column, n, closed)
        for region in range(REGIONS):
            first = SIDE + (n - 2 * SIDE) * region // REGIONS
            last = SIDE + (n - 2 * SIDE) * (region + 1) // REGIONS
            order = first + np.argsort(smoothness[first:last])
            for kind in range(2):
                most, chosen = (edges, planes)[kind], 0
                for i in range(len(order)):
                    k = order[i] if kind else order[len(order) - 1 - i]
                    if chosen == most or (smoothness[k] >= SMOOTH) == (kind == 1):
                        break
                    if closed[k]:
                        continue
                    found[count, 0], found[count, 1], found[count, 2] = p[k, 0], p[k, 1], p[k, 2]
                    plane[count], rank[count] = kind, chosen
                    count, chosen = count + 1, chosen + 1
                    _close_around(p, k, n, closed)
    return count


@njit(cache=True)
def _close(p, distance, column, n, closed):
    """Mark the points of a scan line that are no features: at occlusions, and on surfaces parallel to the ray."""
    closed[:n] = False
    closed[:SIDE], closed[n - SIDE : n] = True, True
    for k in range(1, n - 1):
        beside = column[k + 1] - column[k] <= SIDE
        if beside and distance[k] - distance[k + 1] > STEP_M:
            closed[max(k - SIDE, 0) : k + 1] = True
        elif beside and distance[k + 1] - distance[k] > STEP_M:
            closed[k + 1 : min(k + 2 + SIDE, n)] = True
        if _grazing(p, distance, k, k - 1) and _grazing(p, distance, k, k + 1):
            closed[k] = True


@njit(cache=True)
def _grazing(p, distance, k, j):
    along = (distance[k] - distance[j]) ** 2
    return along > GRAZING**2 * (_squared(p, k, j) - along)


@njit(cache=True)
def _close_around(p, k, n, closed):
    """Mark a chosen point and those beside it on its surface."""
    closed[k] = True
    for step in (-1, 1):
        for i in range(1, SIDE + 1):
            j = k + step * i
            if j < 0 or j >= n or _squared(p, j, j - step) > STEP_M**2:
                break
            closed[j] = True


@njit(cache=True)
def _squared(p, i, j):
    return (p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2
