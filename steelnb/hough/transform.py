"""Compiled parts of the iterative Hough transform: the lazy maximum, the line fit, the loop.

Source: Dalitz, Schramke, Jeltsch, "Iterative Hough Transform for Line Detection in 3D Point Clouds", Image Processing
On Line 7 (2017), 184–196: equations (2), (3) and (7), and Algorithm 1.

The published program keeps a vote volume of all directions and searches all of it in every round. Here, no volume is
kept. Removing points can only lower votes, so the maximum that a direction had is an upper bound of what it has: one
(bound, cell) pair for each direction is kept in a heap, and only the direction on top is voted again, until the one on
top is up to date. Where points lie close together, the first bounds come from cubes of points instead of points: most
directions are then not voted before the strongest lines have taken their points away. The lines are the same.
"""

import numpy as np
from numba import njit

from steelnb.hough.votes import BLOCK, CUBE, bound_votes, far_apart, group, vote
from steelnb.points.moments import moments_about_mean, principal_axis

GAIN = 3
"""The first bounds come from cubes where these are so many times fewer than the points."""


@njit(cache=True)
def sift_down(heap, key, start):
    """Restore the heap below ``start``: larger key first, then smaller direction."""
    n = len(heap)
    item = heap[start]
    hole = start
    while True:
        child = 2 * hole + 1
        if child >= n:
            break
        right = child + 1
        if right < n and (
            key[heap[right]] > key[heap[child]] or (key[heap[right]] == key[heap[child]] and heap[right] < heap[child])
        ):
            child = right
        if key[heap[child]] > key[item] or (key[heap[child]] == key[item] and heap[child] < item):
            heap[hole] = heap[child]
            hole = child
        else:
            break
    heap[hole] = item


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
    """Algorithm 1: find the strongest line, fit it, remove its points, again. Returns (lines, votes counted).

    ``px, py, pz`` are overwritten. Lines go to the rows of ``anchor``, ``direction`` and ``counts``, the number of its
    line to ``label`` of each point, which is −1 on entry.
    """
    n = len(px)
    n_directions = len(sphere)
    image = np.zeros((columns + 4) * (columns + 4) + BLOCK, np.int32)
    index = np.empty(n, np.int32)
    fresh = np.full(n_directions, -1)
    inverse_dx = 1.0 / dx
    # Fits sum over the points in the order given; votes, which no order changes, over copies of them far apart.
    original, chosen = np.arange(n), np.empty(n, np.int64)
    voter = far_apart(n)
    vx, vy, vz = px[voter], py[voter], pz[voter]
    gone = np.zeros(n, np.uint8)
    votes_cast = 0
    cx, cy, cz, weight = group(vx, vy, vz, half, CUBE * dx)
    grouped = GAIN * len(cx) <= n
    key = np.empty(n_directions, np.int64)  # larger votes first, then the smaller cell; then the smaller direction
    heap = np.arange(n_directions)
    for j in range(n_directions):
        bx, by, bz = sphere[j, 0], sphere[j, 1], sphere[j, 2]
        cell = np.int64(0)
        if grouped:
            best = bound_votes(cx, cy, cz, weight, bx, by, bz, box, half, inverse_dx, columns, image, index)
            votes_cast += len(cx)
        else:
            best, cell = vote(vx, vy, vz, bx, by, bz, box, half, inverse_dx, columns, image, index)
            fresh[j] = 0
            votes_cast += n
        key[j] = (np.int64(best) << 32) - cell
    for start in range(n_directions // 2 - 1, -1, -1):
        sift_down(heap, key, start)

    found = 0
    round_number = 0
    floor = min_votes // 2 if skip_weak else 1
    while n > 1 and found < max_lines:
        top = heap[0]
        while fresh[top] != round_number:
            best, cell = vote(
                vx[:n], vy[:n], vz[:n], sphere[top, 0], sphere[top, 1], sphere[top, 2], box, half, inverse_dx, columns,
                image, index[:n],
            )  # fmt: skip
            votes_cast += n
            fresh[top] = round_number
            key[top] = (np.int64(best) << 32) - cell
            sift_down(heap, key, 0)
            top = heap[0]
        votes = (key[top] + (np.int64(1) << 31)) >> 32
        if votes < floor:
            break
        cell = (votes << 32) - key[top]
        x = (cell // columns) * dx - half
        y = (cell % columns) * dx - half
        bx, by, bz = sphere[top, 0], sphere[top, 1], sphere[top, 2]
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
        drop(gone, vx[:n], vy[:n], vz[:n], voter)
        n = drop(gone, px[:n], py[:n], pz[:n], original)
        found += 0 if weak else 1
        round_number += 1
    return found, votes_cast
