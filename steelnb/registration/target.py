"""Registration target: an indexed cloud, and the cached search for correspondences in it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from steelnb.core.checks import check_coordinates, checked_choice, checked_cloud
from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points import VoxelMap
from steelnb.points.covariances import NEIGHBOURS, PlaneCovariances, neighbour_covariances, normals
from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k
from steelnb.points.voxel_map import SearchState

CACHED = 3
"""Number of neighbours of each source point that are cached between iterations."""


Search = Callable[[Array], IntArray]
"""Pose ``T_target_source (4, 4)`` → index ``(N,)`` of the target point of each source point, −1 if none is within the
limit. Each call overwrites and returns the same array."""


class AnyTarget(Protocol):
    """What the solver registers to: points ``(M, 3)`` with normals and covariances, and a search for pairs in them."""

    @property
    def point(self) -> Array: ...
    @property
    def normal(self) -> Array: ...
    @property
    def covariance(self) -> Array: ...
    def search(self, source: Array, limit_m: float) -> Search: ...


@dataclass(frozen=True, eq=False)
class Target:
    """A cloud: its k-d tree and, in the order of the tree, normals ``(M, 3)`` and covariances ``(M, 6)`` in m².

    The error ``plane`` needs the normals, ``gicp`` the covariances; an array that is not needed has length zero.
    ``filled`` computes the covariances on demand.
    """

    tree: KdTree
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 6)))
    filled: PlaneCovariances | None = None

    @classmethod
    def with_planes(cls, tree: KdTree) -> "Target":
        """A target with GICP's covariances, computed from the nearest neighbours of each point."""
        planes = PlaneCovariances(tree, NEIGHBOURS)
        return cls(tree, covariance=planes.value, filled=planes)

    @property
    def point(self) -> Array:
        """Points ``(M, 3)`` in metres, in the target frame."""
        return self.tree.point

    def search(self, source: Array, limit_m: float) -> Search:
        """Nearest neighbours of source points ``(N, 3)`` within ``limit_m``: exact, but searched only when needed."""
        n = len(source)
        match, state = np.full(n, -1), (np.full((n, CACHED), -1), np.full(n, -1.0), np.zeros((n, 3)))

        def search(T: Array) -> IntArray:
            correspond_points(self.tree, source, T, limit_m, match, *state)
            if self.filled:
                self.filled.fill(match)
            return match

        return search


class VoxelTarget:
    """The means of a voxel map's voxels, which need no tree, and the covariances around them if a ``floor_m2`` for
    their variances is given (`VoxelMap.shapes`). Valid until the next insertion."""

    def __init__(self, voxels: VoxelMap, floor_m2: float | None = None) -> None:
        self.voxels, self.floor_m2 = voxels, floor_m2
        self.point, self.normal, self.covariance = voxels.means(copy=False), np.zeros((0, 3)), np.zeros((0, 6))

    def search(self, source: Array, limit_m: float) -> Search:
        """Nearest means of source points ``(N, 3)`` within ``limit_m``: exact, but searched only when needed; in the
        map's tree, if it has one."""
        match, state = np.full(len(source), -1), SearchState.of(len(source))
        tree = self.voxels.tree
        in_tree = Target(tree).search(source, limit_m) if tree else None
        slot_of = np.append(tree.order, -1) if tree else match

        def search(T: Array) -> IntArray:
            if in_tree:
                np.take(slot_of, in_tree(T), out=match, mode="wrap")  # the last for -1
            else:
                self.voxels.correspond(source, T, limit_m, match, state)
            if self.floor_m2 is not None:
                self.covariance = self.voxels.shapes(match, self.floor_m2)
            return match

        return search


def make_target(points: Array, error: str) -> Target:
    """Index a cloud ``(M, 3)`` in metres, with the normals or covariances that the error needs.

    ``error`` is ``point``, ``plane`` or ``gicp``. Normals and covariances are estimated from the nearest neighbours.
    Raises `InputError`.
    """
    checked_choice(error, "error", ("point", "plane", "gicp"))
    tree = build_kdtree(finite(points, "target"))
    if error == "gicp":
        return Target.with_planes(tree)
    return Target(tree, normals(neighbour_covariances(tree.point, tree=tree))) if error == "plane" else Target(tree)


def finite(points: Array, name: str) -> Array:
    """The finite points of a cloud ``(N, 3)`` or image ``(H, W, 3)``. Raises `InputError`."""
    points = checked_cloud(points, name).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{name}: no finite point, expected a cloud (N, 3)")
    check_coordinates(points, name)
    return np.ascontiguousarray(points)


@njit(cache=True)
def correspond_points(tree, source, T, limit, match, neighbours, others_min, searched_from):
    """Write the index in the tree of the nearest target point of each source point under T to ``match (N,)``.

    It is −1 if none is within ``limit``. Returns the number of searches. The result is exact, but a point is searched
    for only if its nearest neighbour may have changed, after Greenspan and Godin, 3DIM 2001. ``neighbours (N, K)``
    caches the K nearest of the last search, padded with −1. All other points were at least ``others_min (N,)`` away
    from ``searched_from (N, 3)``. If the point has moved by m since, the nearest of the K is still the nearest of all
    while it is closer than others_min − m. A negative ``others_min`` forces a search.
    """
    node_of, node_distance, distance = np.empty(64, np.int64), np.empty((64, 4)), np.empty(neighbours.shape[1])
    k_most, searches = neighbours.shape[1], 0
    point = tree.point
    search_max = limit * 1.05 + 1e-12  # slightly beyond, so that points without a pair are not searched for every time
    for i in range(len(source)):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        search_limit = search_max * search_max
        if others_min[i] >= 0.0:
            best, cached_min, cached_max, count = -1, np.inf, 0.0, 0
            for c in range(k_most):
                k = neighbours[i, c]
                if k < 0:
                    break
                dx, dy, dz = point[k, 0] - qx, point[k, 1] - qy, point[k, 2] - qz
                d = dx * dx + dy * dy + dz * dz
                count += 1
                cached_max = max(cached_max, d)
                if d < cached_min:
                    best, cached_min = k, d
            dx, dy, dz = qx - searched_from[i, 0], qy - searched_from[i, 1], qz - searched_from[i, 2]
            unchanged_within = others_min[i] - math.sqrt(dx * dx + dy * dy + dz * dz)
            if unchanged_within > 0.0 and (
                cached_min < unchanged_within * unchanged_within or unchanged_within > limit
            ):
                match[i] = best if cached_min <= limit * limit else -1
                continue
            if count == k_most:
                search_limit = min(search_limit, cached_max * (1.0 + 1e-9) + 1e-300)
        count = nearest_k(tree, qx, qy, qz, k_most, search_limit, neighbours[i], distance, node_of, node_distance)
        for c in range(count, k_most):
            neighbours[i, c] = -1
        match[i] = neighbours[i, 0] if count > 0 and distance[0] <= limit * limit else -1
        others_min[i] = math.sqrt(distance[k_most - 1]) if count == k_most else search_max
        searched_from[i, 0], searched_from[i, 1], searched_from[i, 2] = qx, qy, qz
        searches += 1
    return searches
