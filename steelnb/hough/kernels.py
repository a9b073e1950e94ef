"""Compiled parts of the iterative Hough transform: the lazy maximum, the line fit, the loop.

Source: Dalitz, Schramke, Jeltsch, "Iterative Hough Transform for Line Detection in 3D Point Clouds", Image Processing
On Line 7 (2017), 184–196: equations (2), (3) and (7), and Algorithm 1.

The published program keeps a vote volume of all directions and searches all of it in every round. Here, no volume is
kept. Removing points can only lower votes, so the maximum that a direction had is an upper bound of what it has: one
(bound, cell) pair for each direction is kept in a heap, and only the direction on top is voted again, until the one on
top is up to date. Where points lie close together, the first bounds come from cubes of points instead of points: most
directions are then not voted before the strongest lines have taken their points away. The lines are the same.
"""

import math

import numpy as np
from numba import njit

from steelnb.hough.votes import BLOCK, CUBE, bound_votes, far_apart, group, vote

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
def principal_axis(xx, xy, xz, yy, yz, zz):
    """Eigenvalues (largest first, then the sum of the others) and leading unit eigenvector of a symmetric 3×3 matrix.

    Cyclic Jacobi rotations on scalars; the component of largest size is positive.
    """
    v00, v01, v02, v10, v11, v12, v20, v21, v22 = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(12):
        off = xy * xy + xz * xz + yz * yz
        if off <= 1e-30 * (xx * xx + yy * yy + zz * zz):
            break
        if xy != 0.0:
            theta = (yy - xx) / (2.0 * xy)
            t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
            c = 1.0 / math.sqrt(t * t + 1.0)
            s = t * c
            xx, yy, xy = xx - t * xy, yy + t * xy, 0.0
            xz, yz = c * xz - s * yz, s * xz + c * yz
            v00, v01 = c * v00 - s * v01, s * v00 + c * v01
            v10, v11 = c * v10 - s * v11, s * v10 + c * v11
            v20, v21 = c * v20 - s * v21, s * v20 + c * v21
        if xz != 0.0:
            theta = (zz - xx) / (2.0 * xz)
            t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
            c = 1.0 / math.sqrt(t * t + 1.0)
            s = t * c
            xx, zz, xz = xx - t * xz, zz + t * xz, 0.0
            xy, yz = c * xy - s * yz, s * xy + c * yz
            v00, v02 = c * v00 - s * v02, s * v00 + c * v02
            v10, v12 = c * v10 - s * v12, s * v10 + c * v12
            v20, v22 = c * v20 - s * v22, s * v20 + c * v22
        if yz != 0.0:
            theta = (zz - yy) / (2.0 * yz)
            t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
            c = 1.0 / math.sqrt(t * t + 1.0)
            s = t * c
            yy, zz, yz = yy - t * yz, zz + t * yz, 0.0
            xy, xz = c * xy - s * xz, s * xy + c * xz
            v01, v02 = c * v01 - s * v02, s * v01 + c * v02
            v11, v12 = c * v11 - s * v12, s * v11 + c * v12
            v21, v22 = c * v21 - s * v22, s * v21 + c * v22
    if xx >= yy and xx >= zz:
        first, rest, ux, uy, uz = xx, yy + zz, v00, v10, v20
    elif yy >= zz:
        first, rest, ux, uy, uz = yy, xx + zz, v01, v11, v21
    else:
        first, rest, ux, uy, uz = zz, xx + yy, v02, v12, v22
    lead = ux
    if abs(uy) > abs(lead):
        lead = uy
    if abs(uz) > abs(lead):
        lead = uz
    sign = -1.0 if lead < 0.0 else 1.0
    return first, max(rest, 0.0), sign * ux, sign * uy, sign * uz


@njit(cache=True)
def fit_line(px, py, pz, chosen, count):
    """Orthogonal least squares through ``count`` chosen points: (spread along, spread across, mean, direction).

    The spreads are sums of squares; the sums run about the mean, in the order of the points.
    """
    mx = my = mz = 0.0
    for k in range(count):
        mx += px[chosen[k]]
        my += py[chosen[k]]
        mz += pz[chosen[k]]
    if count > 0:
        mx /= count
        my /= count
        mz /= count
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(count):
        x, y, z = px[chosen[k]] - mx, py[chosen[k]] - my, pz[chosen[k]] - mz
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    along, across, ux, uy, uz = principal_axis(xx, xy, xz, yy, yz, zz)
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
    key = np.empty(n_directions, np.int64)
    fresh = np.full(n_directions, -1)
    heap = np.arange(n_directions)
    inverse_dx = 1.0 / dx
    # Fits sum over the points in the order given; votes, which no order changes, over copies of them far apart.
    original, chosen = np.arange(n), np.empty(n, np.int64)
    voter = far_apart(n)
    vx, vy, vz = px[voter], py[voter], pz[voter]
    gone = np.zeros(n, np.uint8)
    votes_cast = 0
    cx, cy, cz, weight = group(vx, vy, vz, half, CUBE * dx)
    grouped = GAIN * len(cx) <= n
    for j in range(n_directions):
        bx, by, bz = sphere[j, 0], sphere[j, 1], sphere[j, 2]
        if grouped:
            best = bound_votes(cx, cy, cz, weight, bx, by, bz, box, half, inverse_dx, columns, image, index)
            key[j] = np.int64(best) << 32
            votes_cast += len(cx)
        else:
            best, cell = vote(vx, vy, vz, bx, by, bz, box, half, inverse_dx, columns, image, index)
            # Larger votes first, then the smaller cell; then the smaller direction, by the heap.
            key[j] = (np.int64(best) << 32) - cell
            fresh[j] = 0
            votes_cast += n
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
            key[top] = (np.int64(best) << 32) - cell
            fresh[top] = round_number
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

        count = points_near_line(px[:n], py[:n], pz[:n], ax, ay, az, bx, by, bz, dx, chosen)
        along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
        weak = along == 0.0
        if not weak:
            count = points_near_line(px[:n], py[:n], pz[:n], ax, ay, az, ux, uy, uz, dx, chosen)
            weak = count < min_votes
            if not weak:
                along, _, ax, ay, az, ux, uy, uz = fit_line(px, py, pz, chosen, count)
                weak = along == 0.0
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
        kept = 0
        for i in range(n):
            stays = 1 - int(gone[original[i]])
            px[kept], py[kept], pz[kept], original[kept] = px[i], py[i], pz[i], original[i]
            kept += stays
        kept = 0
        for i in range(n):
            stays = 1 - int(gone[voter[i]])
            vx[kept], vy[kept], vz[kept], voter[kept] = vx[i], vy[i], vz[i], voter[i]
            kept += stays
        n = kept
        found += 0 if weak else 1
        round_number += 1
    return found, votes_cast
