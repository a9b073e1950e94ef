"""LOAM's edge and planar features of an organised scan.

Source: Zhang and Singh, "LOAM: Lidar odometry and mapping in real-time" (RSS 2014), section V.A. The rows of the image
are the scan lines. A lattice has few corners and hardly any wall: most edges found on it are silhouettes, which move
around a bar with the viewpoint.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.ranges import STEP_M

SIDE = 5
"""Neighbours on either side of a point, in its scan line, that enter its smoothness. As many neighbours of a chosen
feature are excluded."""
REGIONS = 4
"""Number of subregions of a scan line; each contributes an equal share of the features."""
SMOOTH = 5e-3
"""Smoothness threshold, as published: edge points are above it, planar points below."""
GRAZING = 4.0
"""A surface is roughly parallel to the ray if the range changes by more than this many times the step across it."""
RING_GAP_RAD = 1e-3
"""Gap in elevation between two lasers of a spinning LiDAR."""
RING_MAX_RAD = 1e-2
"""Largest spread in elevation of one laser. Wider groups are split into lines of 5 × `RING_GAP_RAD`."""


class LoamFeatures(NamedTuple):
    """``point (N, 3)`` in the sensor frame, metres; ``plane (N,)``, 1 for a planar point and 0 for an edge point;
    ``rank (N,)``, its place among the features of its kind in its subregion, 0 for the sharpest or flattest."""

    point: Array
    plane: IntArray
    rank: IntArray


def loam_features(image: Array, edges: int = 20, planes: int = 40) -> LoamFeatures:
    """LOAM's features of an organised scan ``(H, W, 3)``, sensor frame, metres, NaN for no return.

    The smoothness of point i is c = ‖Σ (X_i − X_j)‖ / (|S| ‖X_i‖) over its neighbours j in the scan line (equation 1);
    pixels without a return are skipped. Each of the four subregions of a line contributes up to ``edges`` points of
    largest and ``planes`` points of smallest smoothness. Neighbours of a chosen point on the same surface, points on
    surfaces roughly parallel to the ray, and occluded boundaries are excluded. LOAM matches consecutive scans by the
    first 2 edge and 4 planar points of each subregion, and matches ten times as many to its map.
    """
    point = np.empty((image.shape[0] * REGIONS * (edges + planes), 3))
    plane, rank = np.empty(len(point), np.int64), np.empty(len(point), np.int64)
    count = _loam_features(np.ascontiguousarray(image, dtype=np.float64), edges, planes, point, plane, rank)
    return LoamFeatures(point[:count], plane[:count], rank[:count])


def scan_lines(points: Array) -> Array:
    """Scan lines ``(H, W, 3)`` of a spinning LiDAR's cloud ``(N, 3)``, metres, sensor frame with z along its axis.

    Row h holds the returns of one laser, sorted by azimuth and padded with NaN. Lasers are told apart by elevation and
    sorted from the lowest to the highest. Returns that are zero or not finite are dropped.
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
    part = np.where(wide[group], (elevation - low[group]) // (5 * RING_GAP_RAD), 0)
    line = np.cumsum((np.diff(group, prepend=0) > 0) | (np.diff(part, prepend=0) > 0))
    order = np.lexsort((np.arctan2(points[:, 1], points[:, 0]), line))
    points, line = points[order], line[order]
    column = np.arange(len(line)) - np.searchsorted(line, line)
    image = np.full((line[-1] + 1, column.max() + 1, 3), np.nan)
    image[line, column] = points
    return image


@njit(cache=True)
def _loam_features(image, edges, planes, point, plane, rank):
    rows, columns = image.shape[0], image.shape[1]
    column = np.empty(columns, np.int64)
    p, distance = np.empty((columns, 3)), np.empty(columns)
    smoothness, excluded = np.empty(columns), np.empty(columns, np.bool_)
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
        _exclude_unreliable(p, distance, column, n, excluded)
        for region in range(REGIONS):
            first = SIDE + (n - 2 * SIDE) * region // REGIONS
            last = SIDE + (n - 2 * SIDE) * (region + 1) // REGIONS
            order = first + np.argsort(smoothness[first:last])
            for kind in range(2):
                limit, chosen = (edges, planes)[kind], 0
                for i in range(len(order)):
                    k = order[i] if kind else order[len(order) - 1 - i]
                    if chosen == limit or (smoothness[k] >= SMOOTH) == (kind == 1):
                        break
                    if excluded[k]:
                        continue
                    point[count, 0], point[count, 1], point[count, 2] = p[k, 0], p[k, 1], p[k, 2]
                    plane[count], rank[count] = kind, chosen
                    count, chosen = count + 1, chosen + 1
                    _exclude_neighbours(p, k, n, excluded)
    return count


@njit(cache=True)
def _exclude_unreliable(p, distance, column, n, excluded):
    """Mark the points at the ends of a scan line, at occlusions, and on surfaces roughly parallel to the ray."""
    excluded[:n] = False
    excluded[:SIDE], excluded[n - SIDE : n] = True, True
    for k in range(1, n - 1):
        adjacent = column[k + 1] - column[k] <= SIDE
        if adjacent and distance[k] - distance[k + 1] > STEP_M:
            excluded[max(k - SIDE, 0) : k + 1] = True
        elif adjacent and distance[k + 1] - distance[k] > STEP_M:
            excluded[k + 1 : min(k + 2 + SIDE, n)] = True
        if _grazing(p, distance, k, k - 1) and _grazing(p, distance, k, k + 1):
            excluded[k] = True


@njit(cache=True)
def _grazing(p, distance, k, j):
    along = (distance[k] - distance[j]) ** 2
    return along > GRAZING**2 * (_squared_distance(p, k, j) - along)


@njit(cache=True)
def _exclude_neighbours(p, k, n, excluded):
    """Mark a chosen point and its neighbours on the same surface."""
    excluded[k] = True
    for step in (-1, 1):
        for i in range(1, SIDE + 1):
            j = k + step * i
            if j < 0 or j >= n or _squared_distance(p, j, j - step) > STEP_M**2:
                break
            excluded[j] = True


@njit(cache=True)
def _squared_distance(p, i, j):
    return (p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2
