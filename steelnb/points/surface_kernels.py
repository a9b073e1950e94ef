"""Compiled search for the cells of a cloud that lie on surfaces."""

import math

import numpy as np

from steelnb.core.kernels import njit
from steelnb.points.moments import eigen
from steelnb.points.neighbours import advance, gather

DISC = 3.5
"""Radius, in cells, of the disc that points must cover."""
COVERED_MIN = 0.7
"""Minimum share of the disc that is covered. Bars that meet at a joint of a lattice cover less than half of it."""
ASIDE_MAX = 0.3
"""Maximum share of the points around a cell of a surface that are farther from it than those near it."""


@njit(cache=True, nogil=True)
def local_planes(key, mean, cell, reach, around):  # type: ignore[no-untyped-def]
    """Plane through the cells around each cell: a point of it ``(M, 3)``, its normal ``(M, 3)``, and whether it is
    covered ``(M,)`` by those within ``reach`` of it. These alone determine a covered plane: steel stands on ground. The
    keys of the cells are sorted; ``around``: `Columns`."""
    count = len(key)
    point, normal, inner = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    is_covered, full = np.zeros(64, np.bool_), math.pi * DISC * DISC
    for n in range(count):
        if advance(key, n, around, first, last) < COVERED_MIN * full:
            continue
        found = gather(key, n, around, first, last, at, others)
        sx, sy, sz, nx, ny, nz, ux, uy, uz = _plane(mean, n, others[:found])
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        is_covered[:] = False
        near = 0
        for k in range(found):
            x, y, z = mean[others[k], 0] - sx, mean[others[k], 1] - sy, mean[others[k], 2] - sz
            if abs(x * nx + y * ny + z * nz) <= reach:
                others[near] = others[k]
                near += 1
                # Cells of the disc, seen along the normal: 8 x 8 of them.
                i = math.floor((x * ux + y * uy + z * uz) / cell) + 4
                j = math.floor((x * vx + y * vy + z * vz) / cell) + 4
                if 0 <= i < 8 and 0 <= j < 8:
                    is_covered[8 * i + j] = True
        inner[n] = is_covered.sum() >= COVERED_MIN * full and found - near <= ASIDE_MAX * near
        if inner[n] and near < found:
            sx, sy, sz, nx, ny, nz, _, _, _ = _plane(mean, n, others[:near])
        point[n, 0], point[n, 1], point[n, 2] = sx, sy, sz
        normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
    return point, normal, inner


@njit(cache=True, nogil=True)
def _plane(mean, centre, others):  # type: ignore[no-untyped-def]
    """Plane through some of the points, which lie around the ``centre``: their mean, its normal and the direction in
    which they extend farthest."""
    found = len(others)
    sx = sy = sz = 0.0
    for k in range(found):
        sx += mean[others[k], 0] - mean[centre, 0]
        sy += mean[others[k], 1] - mean[centre, 1]
        sz += mean[others[k], 2] - mean[centre, 2]
    sx, sy, sz = mean[centre, 0] + sx / found, mean[centre, 1] + sy / found, mean[centre, 2] + sz / found
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(found):
        x, y, z = mean[others[k], 0] - sx, mean[others[k], 1] - sy, mean[others[k], 2] - sz
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    small, _, large = eigen(xx / found, xy / found, xz / found, yy / found, yz / found, zz / found)
    return sx, sy, sz, small[1], small[2], small[3], large[1], large[2], large[3]
