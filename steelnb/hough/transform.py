"""The iterative Hough transform: its directions, the votes of one of them, the line fit, and the loop, compiled.

Source: Dalitz, Schramke, Jeltsch, "Iterative Hough Transform for Line Detection in 3D Point Clouds", Image Processing
On Line 7 (2017), 184–196: equations (2), (3) and (7), and Algorithm 1.

The published program stores the votes of all directions and searches all of them in every round. Here they are not
stored. Removing points can only lower votes, so the last maximum of a direction is an upper bound of its current one.
The directions are in a heap sorted by that bound. Only the top one is voted again, until the top is up to date. The
lines are identical.
"""

from functools import lru_cache
from heapq import heapify, heapreplace

import numpy as np

from steelnb.core.checks import checked_integer
from steelnb.core.kernels import njit
from steelnb.core.types import Array
from steelnb.points.moments import moments_about_mean, principal_axis

# In single precision, as in the published program: ties between directions depend on their order and last bits.
_TAU = np.float32(1.61803399)
_NORM = np.sqrt(np.float32(1) + _TAU * _TAU)
_V = float(np.float32(1) / _NORM)
_T = float(_TAU / _NORM)

_CORNERS = (
    (-_V, _T, 0.0), (_V, _T, 0.0), (0.0, _V, -_T), (0.0, _V, _T), (-_T, 0.0, -_V), (_T, 0.0, -_V),
    (-_T, 0.0, _V), (_T, 0.0, _V), (0.0, -_V, -_T), (0.0, -_V, _T), (-_V, -_T, 0.0), (_V, -_T, 0.0),
)  # fmt: skip
_TRIANGLES = (
    (0, 1, 2), (0, 1, 3), (0, 2, 4), (0, 4, 6), (0, 3, 6), (1, 2, 5), (1, 3, 7), (1, 5, 7), (2, 4, 8), (2, 5, 8),
    (3, 6, 9), (3, 7, 9), (4, 8, 10), (8, 10, 11), (5, 8, 11), (5, 7, 11), (7, 9, 11), (9, 10, 11), (6, 9, 10),
    (4, 6, 10),
)  # fmt: skip


@lru_cache(maxsize=8)
def directions(granularity: int) -> Array:
    """Unit vectors ``(5 * 4**granularity + 1, 3)`` that cover the half sphere evenly, one of each opposite pair.

    ``granularity`` 4 gives 1281 directions about 4° apart, 6 gives 20481 about 1° apart. They are in the order of the
    published program, which breaks ties by this order. Raises `InputError` for a granularity outside 0–6.
    """
    checked_integer(granularity, "granularity", 0, 6)
    vertices = [np.array(corner) for corner in _CORNERS]
    triangles = list(_TRIANGLES)
    for _ in range(granularity):
        middle: dict[frozenset[int], int] = {}
        finer = []
        for a, b, c in triangles:
            edges = [frozenset(edge) for edge in ((a, b), (b, c), (c, a))]
            for edge in (edge for edge in edges if edge not in middle):
                middle[edge] = len(vertices)
                x, y, z = total = np.sum([vertices[i] for i in edge], axis=0)
                vertices.append(total / np.sqrt(x * x + y * y + z * z))
            d, e, f = (middle[edge] for edge in edges)
            finer += [(a, d, f), (d, b, e), (f, e, c), (f, d, e)]
        triangles = finer
    sphere = np.array(vertices)
    x, y, z = sphere.T
    upper = (z > 0) | ((z == 0) & ((x > 0) | ((x == 0) & (y != -1))))
    result = sphere[upper]
    result.setflags(write=False)
    return result


BLOCK = 256
"""Number of cells of the vote image whose maximum is computed at once."""


@njit(cache=True)
def vote(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, image, index):
    """Votes of one direction (equation 2): (largest count, first cell that has it).

    ``box (3,)`` is half the size of the bounding box, on which the cloud is centred.
    ``image ((columns + 4)² + BLOCK)`` must be zero, and is zero on return; ``index (N,)`` is a buffer.
    """
    n = len(px)
    beta = 1.0 / (1.0 + bz)
    ax, ay, az = (1.0 - beta * bx * bx) * inverse_dx, -beta * bx * by * inverse_dx, -bx * inverse_dx
    cx, cy, cz = -beta * bx * by * inverse_dx, (1.0 - beta * by * by) * inverse_dx, -by * inverse_dx
    shift = half * inverse_dx + 0.5
    for i in range(n):
        column = np.int32(ax * px[i] + ay * py[i] + az * pz[i] + shift)
        row = np.int32(cx * px[i] + cy * py[i] + cz * pz[i] + shift)
        index[i] = column * columns + row
    # Four interleaved loops: neighbours mostly vote for the same cell, and a vote waits until the one before is stored.
    # Unsigned indices save numba's test for negative ones.
    part = n // 4
    for i in range(part):
        image[np.uint32(index[i])] += 1
        image[np.uint32(index[i + part])] += 1
        image[np.uint32(index[i + 2 * part])] += 1
        image[np.uint32(index[i + 3 * part])] += 1
    for i in range(4 * part, n):
        image[np.uint32(index[i])] += 1
    # As in the published program, votes past the last cell are dropped; only a corner of the cloud can cast them.
    cells = columns * columns
    image[cells : (columns + 2) * (columns + 2)] = 0
    # The columns that the bounding box can vote for, and one more on either side for rounding.
    extent = abs(ax) * box[0] + abs(ay) * box[1] + abs(az) * box[2]
    begin, end = max(int(shift - extent) - 1, 0) * columns, min((int(shift + extent) + 3) * columns, cells)
    best = np.int32(0)
    if end - begin <= 8 * n:  # a scan of the image vectorises, a visit to each point's cell does not
        cell = np.int64(begin)
        for first in range(begin, end, BLOCK):
            block = image[first : first + BLOCK]
            block_max = np.int32(0)
            for k in range(BLOCK):
                block_max = max(block_max, block[k])
            if block_max > best:
                best, cell = block_max, np.int64(first)
        while best > 0 and image[cell] != best:
            cell += 1
        image[begin:end] = 0
    else:
        cell = np.int64(cells)
        for i in range(n):
            count = image[np.uint32(index[i])]
            if count > best or (count == best and index[i] < cell):
                best, cell = count, np.int64(index[i])
        for i in range(n):
            image[np.uint32(index[i])] = 0
    return best, cell


@njit(cache=True)
def fit_line(px, py, pz, chosen, count):
    """Orthogonal least squares line through the points ``chosen[:count]``: (along, across, mean, direction).

    ``along`` is the sum of squared distances from the mean along the line, ``across`` that of distances from the line.
    """
    mx, my, mz, m = moments_about_mean(px, py, pz, chosen, count)
    along, across, ux, uy, uz = principal_axis(m[4], m[5], m[6], m[7], m[8], m[9])
    return along, across, mx, my, mz, ux, uy, uz


@njit(cache=True)
def points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen):
    """Write the indices of the points within ``distance`` of a line (equation 7) to ``chosen (N,)``.

    Returns their number. ``chosen`` first holds a flag for each point: the first loop then vectorises, and the second
    has no branch.
    """
    limit = distance * distance
    for i in range(len(px)):
        x, y, z = px[i] - ax, py[i] - ay, pz[i] - az
        t = ux * x + uy * y + uz * z
        dx, dy, dz = x - t * ux, y - t * uy, z - t * uz
        chosen[i] = dx * dx + dy * dy + dz * dz <= limit
    count = 0
    for i in range(len(px)):
        near = chosen[i]
        chosen[count] = i
        count += near
    return count


@njit(cache=True)
def fit_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, min_points, chosen):
    """Fit the points near a line, then fit the points near that fit: (fitted, count, anchor, direction).

    The indices of the points are in ``chosen[:count]``. ``fitted`` is false if there are fewer than ``min_points`` or
    all are identical.
    """
    count = points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen)
    along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
    if along > 0.0:
        count = points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen)
        if count >= min_points:
            along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
    return along > 0.0 and count >= min_points, count, ax, ay, az, ux, uy, uz


@njit(cache=True)
def drop(removed, px, py, pz, original):
    """Move the points that are not ``removed`` to the front, keeping their order; returns their number."""
    kept = 0
    for i in range(len(px)):
        stays = 1 - int(removed[original[i]])
        px[kept], py[kept], pz[kept], original[kept] = px[i], py[i], pz[i], original[i]
        kept += stays
    return kept


@njit(cache=True, nogil=True)
def iterate(px, py, pz, sphere, box, half, dx, columns, min_votes, max_lines, skip_weak):
    """Algorithm 1: find the strongest line, fit it, remove its points, repeat. Returns the fields of `Lines`.

    ``px, py, pz`` are overwritten.
    """
    n = len(px)
    max_lines = min(n // 2, max_lines)
    anchor, direction, counts = np.zeros((max_lines, 3)), np.zeros((max_lines, 3)), np.zeros(max_lines, np.int64)
    label = np.full(n, -1, np.int64)
    image = np.zeros((columns + 4) * (columns + 4) + BLOCK, np.int32)
    index = np.empty(n, np.int32)
    inverse_dx = 1.0 / dx
    original, chosen = np.arange(n), np.empty(n, np.int64)
    removed = np.zeros(n, np.uint8)
    # (−votes, cell, direction) of the strongest cell of each direction. Ties go to the smaller cell, then direction.
    heap = [(0, 0, j) for j in range(len(sphere))]
    voted_in = np.zeros(len(sphere), np.int64)
    for j in range(len(sphere)):
        bx, by, bz = sphere[j, 0], sphere[j, 1], sphere[j, 2]
        votes, cell = vote(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, image, index)
        heap[j] = (-np.int64(votes), cell, j)  # type: ignore[assignment]
    heapify(heap)

    found = 0
    round_number = 0
    floor = min_votes // 2 if skip_weak else 1
    while n > 1 and found < max_lines:
        bound, cell, top = heap[0]
        bx, by, bz = sphere[top, 0], sphere[top, 1], sphere[top, 2]
        if voted_in[top] != round_number:
            votes, cell = vote(px[:n], py[:n], pz[:n], bx, by, bz, box, half, inverse_dx, columns, image, index[:n])
            voted_in[top] = round_number
            heapreplace(heap, (-np.int64(votes), cell, top))  # type: ignore[misc]
            continue
        if -bound < floor:
            break
        x = (cell // columns) * dx - half
        y = (cell % columns) * dx - half
        beta = 1.0 / (1.0 + bz)
        ax = x * (1.0 - beta * bx * bx) - y * beta * bx * by
        ay = -x * beta * bx * by + y * (1.0 - beta * by * by)
        az = -x * bx - y * by

        fitted, count, ax, ay, az, ux, uy, uz = fit_near_line(
            px[:n], py[:n], pz[:n], ax, ay, az, bx, by, bz, dx, min_votes, chosen
        )
        weak = not fitted
        if weak and (not skip_weak or count == 0):
            break
        if not weak:
            anchor[found, 0], anchor[found, 1], anchor[found, 2] = ax, ay, az
            direction[found, 0], direction[found, 1], direction[found, 2] = ux, uy, uz
            counts[found] = count
        # The points of a weak line are removed as well, without a label.
        for k in range(count):
            removed[original[chosen[k]]] = 1
            label[original[chosen[k]]] = -1 if weak else found
        n = drop(removed, px[:n], py[:n], pz[:n], original)
        found += 0 if weak else 1
        round_number += 1
    return anchor[:found], direction[:found], counts[:found], label
