"""Compiled parts of the iterative Hough transform: the vote of one direction, the line fit, the loop.

Source: Dalitz, Schramke, Jeltsch, "Iterative Hough Transform for Line Detection in 3D Point Clouds", Image Processing
On Line 7 (2017), 184–196: equations (2), (3) and (7), and Algorithm 1.

The published program keeps a vote volume of all directions and searches all of it in every round. Here, no volume is
kept. Removing points can only lower votes, so the maximum that a direction had is an upper bound of what it has. The
directions wait in a heap by that bound, and only the one on top is voted again, until the one on top is up to date. The
lines are the same.
"""

from heapq import heapify, heapreplace

import numpy as np
from numba import njit

from steelnb.points.moments import moments_about_mean, principal_axis

BLOCK = 256
"""Cells of the vote image whose maximum is taken at once."""


@njit(cache=True)
def vote(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, image, index):
    """Votes of one direction (equation 2): (largest count, first cell that has it).

    ``box (3,)`` holds half the extents of the cloud, which is centred on its bounding box.
    ``image ((columns + 4)² + BLOCK)`` holds zeros on entry and on return; ``index`` is scratch as long as the points.
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
    # Neighbours mostly vote for one cell, and each vote waits for the one before to be stored: so four take turns that
    # lie far apart. The index is unsigned, since a signed one costs a test whether it counts from the end.
    part = n // 4
    for i in range(part):
        image[np.uint32(index[i])] += 1
        image[np.uint32(index[i + part])] += 1
        image[np.uint32(index[i + 2 * part])] += 1
        image[np.uint32(index[i + 3 * part])] += 1
    for i in range(4 * part, n):
        image[np.uint32(index[i])] += 1
    # The reference drops votes past the last cell, which only a corner of the cloud can cast.
    cells = columns * columns
    image[cells : (columns + 2) * (columns + 2)] = 0
    # The columns that the bounding box can reach, and one more on either side for rounding.
    reach = abs(ax) * box[0] + abs(ay) * box[1] + abs(az) * box[2]
    begin, end = max(int(shift - reach) - 1, 0) * columns, min((int(shift + reach) + 3) * columns, cells)
    best = np.int32(0)
    if end - begin <= 8 * n:  # then a scan of the image, which vectorises, is quicker than a visit to each point's cell
        cell = np.int64(begin)
        for first in range(begin, end, BLOCK):
            block = image[first : first + BLOCK]
            most = np.int32(0)
            for k in range(BLOCK):
                most = max(most, block[k])
            if most > best:
                best, cell = most, np.int64(first)
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
    """Orthogonal least squares line through ``count`` chosen points: (spread along, spread across, mean, direction).

    The spreads are sums of squared distances to the mean along the line, and to the line.
    """
    mx, my, mz, m = moments_about_mean(px, py, pz, chosen, count)
    along, across, ux, uy, uz = principal_axis(m[4], m[5], m[6], m[7], m[8], m[9])
    return along, across, mx, my, mz, ux, uy, uz


@njit(cache=True)
def points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen):
    """Write the indices of the points within ``distance`` of a line (equation 7) to ``chosen``; return their count.

    ``chosen`` is as long as the points and holds yes or no for each of them first: so, the loop that computes
    vectorises, and the one that collects has no branch.
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
    """Fit the points near a line, collect those near the fit, and fit again: (fitted, count, anchor, direction).

    ``count`` points are left in ``chosen``. Not ``fitted`` where they are fewer than ``min_points`` or all identical.
    """
    count = points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen)
    along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
    if along > 0.0:
        count = points_near_line(px, py, pz, ax, ay, az, ux, uy, uz, distance, chosen)
        if count >= min_points:
            along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
    return along > 0.0 and count >= min_points, count, ax, ay, az, ux, uy, uz


@njit(cache=True)
def drop(gone, px, py, pz, original):
    """Move the points whose original index is not ``gone`` to the front, in their order; returns their number."""
    kept = 0
    for i in range(len(px)):
        stays = 1 - int(gone[original[i]])
        px[kept], py[kept], pz[kept], original[kept] = px[i], py[i], pz[i], original[i]
        kept += stays
    return kept


@njit(cache=True, nogil=True)
def iterate(
    px, py, pz, sphere, box, half, dx, columns, min_votes, max_lines, skip_weak, anchor, direction, counts, label
):
    """Algorithm 1: find the strongest line, fit it, remove its points, again. Returns the number of lines.

    ``px, py, pz`` are overwritten. Lines go to the rows of ``anchor``, ``direction`` and ``counts``, the number of its
    line to ``label`` of each point, which is −1 on entry.
    """
    n = len(px)
    image = np.zeros((columns + 4) * (columns + 4) + BLOCK, np.int32)
    index = np.empty(n, np.int32)
    inverse_dx = 1.0 / dx
    original, chosen = np.arange(n), np.empty(n, np.int64)
    gone = np.zeros(n, np.uint8)
    # (−votes, cell, direction) of the strongest cell of each direction: more votes come first, then the smaller cell,
    # then the smaller direction. A direction is up to date as of the round in which it was last voted.
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
        # Take the points out, keeping the order of the rest. A weak line's points go too, without a label.
        for k in range(count):
            gone[original[chosen[k]]] = 1
            label[original[chosen[k]]] = -1 if weak else found
        n = drop(gone, px[:n], py[:n], pz[:n], original)
        found += 0 if weak else 1
        round_number += 1
    return found
