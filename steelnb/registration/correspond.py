"""Compiled correspondence search: nearest points of a cloud, searched for again only where needed."""

import math

import numpy as np
from numba import njit

from steelnb.points.kdtree import nearest_k


@njit(cache=True)
def correspond_points(tree, source, T, limit, match, near, beyond, searched_from):
    """Nearest target point of each source point under T, exactly, searching only where it may have changed.

    ``match (N,)`` becomes its position in the tree, or −1 where there is none within the limit. ``near (N, K)`` holds
    the K nearest when last searched, padded with −1; all others were at least ``beyond (N,)`` away from
    ``searched_from (N, 3)``. A point that has moved by m since keeps the nearest of its K while that is nearer than
    beyond − m (after Greenspan and Godin, 3DIM 2001). A negative ``beyond`` asks for a search. Returns the number of
    searches.
    """
    node_of, reach, distance = np.empty(64, np.int64), np.empty((64, 4)), np.empty(near.shape[1])
    k_most, searches = near.shape[1], 0
    point = tree.point
    farthest = limit * 1.05 + 1e-12  # a little further, so that points beyond the limit need no search at every step
    for i in range(len(source)):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        within = farthest * farthest
        if beyond[i] >= 0.0:
            best, least, most, count = -1, np.inf, 0.0, 0
            for c in range(k_most):
                k = near[i, c]
                if k < 0:
                    break
                dx, dy, dz = point[k, 0] - qx, point[k, 1] - qy, point[k, 2] - qz
                d = dx * dx + dy * dy + dz * dz
                count += 1
                most = max(most, d)
                if d < least:
                    best, least = k, d
            dx, dy, dz = qx - searched_from[i, 0], qy - searched_from[i, 1], qz - searched_from[i, 2]
            safe = beyond[i] - math.sqrt(dx * dx + dy * dy + dz * dz)
            if safe > 0.0 and (least < safe * safe or safe > limit):
                match[i] = best if least <= limit * limit else -1
                continue
            if count == k_most:
                within = min(within, most * (1.0 + 1e-9) + 1e-300)
        count = nearest_k(tree, qx, qy, qz, k_most, within, near[i], distance, node_of, reach)
        for c in range(count, k_most):
            near[i, c] = -1
        match[i] = near[i, 0] if count > 0 and distance[0] <= limit * limit else -1
        beyond[i] = math.sqrt(distance[k_most - 1]) if count == k_most else farthest
        searched_from[i, 0], searched_from[i, 1], searched_from[i, 2] = qx, qy, qz
        searches += 1
    return searches
