"""Registration target: an indexed cloud, and the search for correspondences in it, again only where needed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.points import VoxelShapes
from steelnb.points.covariances import PlaneCovariances, neighbour_covariances, normals
from steelnb.points.inputs import checked_cloud
from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k
from steelnb.types import Array, IntArray

KEPT = 3
"""Neighbours of each source point that are kept from one step to the next."""


@dataclass(frozen=True)
class Pairs:
    """Correspondences of N source points as the pose changes.

    ``match (N,)`` holds positions in the target's points, −1 for none within the limit; ``update(T_target_source)``
    refills it.
    """

    match: IntArray
    update: Callable[[Array], object]


@dataclass(frozen=True)
class Target:
    """A cloud: its k-d tree and, in the order of the tree, normals ``(M, 3)`` and covariances ``(M, 6)`` in m².

    Normals serve the error ``plane``, covariances ``gicp``; those not needed may be of length zero. ``filled``
    computes covariances as pairs need them.
    """

    tree: KdTree
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 6)))
    filled: PlaneCovariances | VoxelShapes | None = None

    @classmethod
    def with_planes(cls, tree: KdTree, neighbours: int) -> "Target":
        """Covariances of GICP, from the nearest ``neighbours`` points around each."""
        planes = PlaneCovariances.of(tree, neighbours)
        return cls(tree, covariance=planes.value, filled=planes)

    @classmethod
    def of_voxels(cls, tree: KdTree, shapes: VoxelShapes) -> "Target":
        """The shapes of voxels, in the order of the tree, as covariances."""
        return cls(tree, covariance=shapes.value, filled=shapes)

    @property
    def point(self) -> Array:
        """Points ``(M, 3)`` in metres, in the target frame."""
        return self.tree.point

    def pairs(self, source: Array, limit_m: float) -> Pairs:
        """Nearest point of each source point ``(N, 3)``: exact, and searched again only where it may have changed."""
        n = len(source)
        match, state = np.full(n, -1), (np.full((n, KEPT), -1), np.full(n, -1.0), np.zeros((n, 3)))

        def update(T: Array) -> None:
            correspond_points(self.tree, source, T, limit_m, match, *state)
            if self.filled:
                self.filled.fill(match)

        return Pairs(match, update)


def make_target(points: Array, error: str, neighbours: int = 20) -> Target:
    """Index a cloud ``(M, 3)`` in metres, with normals and covariances only where the error needs them.

    ``error`` is ``point``, ``plane`` or ``gicp``; ``neighbours`` points around each give its normal or covariance.
    Raises `InputError`.
    """
    tree = build_kdtree(finite(points, "target"))
    if error == "gicp":
        return Target.with_planes(tree, neighbours)
    if error == "plane":
        return Target(tree, normals(neighbour_covariances(tree.point, neighbours, tree)))
    return Target(tree)


def finite(points: Array, name: str) -> Array:
    """The finite points of a cloud ``(N, 3)`` or image ``(H, W, 3)``. Raises `InputError`."""
    points = checked_cloud(points, name).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{name}: no finite point, expected a cloud (N, 3)")
    return np.ascontiguousarray(points)


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
