"""Compiled vote image of one direction: exact from points, or an upper bound from cubes of points.

Source: as `steelnb.hough.transform`; equation (2).
"""

import math

import numpy as np
from numba import njit

from steelnb.points.voxel_kernels import EMPTY, find, pack, put

BLOCK = 256
"""Cells of the vote image whose maximum is taken at once."""
CUBE = 0.999 / math.sqrt(3.0)
"""Edge in dx of the cubes of the first bounds: their diagonal is dx, less what rounding may add."""


@njit(cache=True)
def far_apart(n):
    """The numbers 0 to n − 1 in an order that puts neighbours far apart: steps of about n over the golden ratio.

    A scan lists its points side by side, so most vote for the cell that the one before voted for, and each increment
    would have to wait for the last one to be stored. In this order, it does not.
    """
    step = max(int(0.618 * n), 1)
    while math.gcd(step, n) != 1:
        step += 1
    order = np.empty(n, np.int64)
    k = 0
    for i in range(n):
        order[i] = k
        k = (k + step) % n
    return order


@njit(cache=True, inline="always")
def project(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, offset, index):
    """Write the cell of each point in the vote image of a direction (equation 2), plus an offset, to ``index``.

    ``box (3,)`` holds half the extents of the cloud, which is centred on its bounding box. Returns (begin, end) of the
    cells in the columns that the bounding box can reach, and one more on either side for rounding.
    """
    beta = 1.0 / (1.0 + bz)
    ax, ay, az = (1.0 - beta * bx * bx) * inverse_dx, -beta * bx * by * inverse_dx, -bx * inverse_dx
    cx, cy, cz = -beta * bx * by * inverse_dx, (1.0 - beta * by * by) * inverse_dx, -by * inverse_dx
    shift = half * inverse_dx + 0.5
    moved = shift + offset
    for i in range(len(px)):
        column = np.int32(ax * px[i] + ay * py[i] + az * pz[i] + moved)
        row = np.int32(cx * px[i] + cy * py[i] + cz * pz[i] + moved)
        index[i] = column * columns + row
    reach = abs(ax) * box[0] + abs(ay) * box[1] + abs(az) * box[2]
    return max(int(shift - reach) - 1, 0) * columns, min((int(shift + reach) + 3) * columns, columns * columns)


@njit(cache=True)
def vote(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, image, index):
    """Votes of one direction: (largest count, first cell that has it).

    ``image ((columns + 4)² + BLOCK)`` holds zeros on entry and on return; ``index`` is scratch as long as the points.
    """
    n = len(px)
    begin, end = project(px, py, pz, bx, by, bz, box, half, inverse_dx, columns, 0.0, index)
    for i in range(n):
        image[np.uint32(index[i])] += 1  # unsigned: a signed index costs a test whether it counts from the end
    # The reference drops votes past the last cell, which only a corner of the cloud can cast.
    cells = columns * columns
    image[cells : (columns + 2) * (columns + 2)] = 0
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
def group(px, py, pz, half, edge):
    """Occupied cubes of an edge: centres and numbers of points, in the order of their first points."""
    n = len(px)
    size = 4
    while size < 2 * n:
        size *= 2
    table_key, table_slot = np.full(size, EMPTY), np.zeros(size, np.int64)
    x, y, z, weight = np.empty(n), np.empty(n), np.empty(n), np.zeros(n, np.int32)
    cubes = 0
    for i in range(n):
        a, b, c = int((px[i] + half) / edge), int((py[i] + half) / edge), int((pz[i] + half) / edge)
        key = pack(a, b, c)
        slot = find(key, table_key, table_slot)
        if slot < 0:
            slot = cubes
            put(key, slot, table_key, table_slot)
            x[slot], y[slot], z[slot] = (a + 0.5) * edge - half, (b + 0.5) * edge - half, (c + 0.5) * edge - half
            cubes += 1
        weight[slot] += 1
    return x[:cubes], y[:cubes], z[:cubes], weight[:cubes]


@njit(cache=True)
def bound_votes(cx, cy, cz, weight, bx, by, bz, box, half, inverse_dx, columns, image, index):
    """Upper bound of the votes of any cell of a direction, from cubes with a diagonal of at most dx.

    A cube's points lie within dx/2 of its centre, so they vote for two columns and two rows at the most: four cells,
    of which the last is counted here. The most that a cell can have is then the sum over it and its three successors.
    """
    n = len(cx)
    begin, end = project(cx, cy, cz, bx, by, bz, box, half, inverse_dx, columns, 0.5, index)
    for i in range(n):
        image[np.uint32(index[i])] += weight[i]
    best = np.int32(0)
    here, right = image[begin:end], image[begin + 1 : end + 1]
    above, across = image[begin + columns : end + columns], image[begin + columns + 1 : end + columns + 1]
    for k in range(len(here)):
        best = max(best, here[k] + right[k] + above[k] + across[k])
    image[begin : end + 3 * columns + 4] = 0
    return best
