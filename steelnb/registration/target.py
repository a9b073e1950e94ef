"""What a scan is registered to: an indexed cloud or a voxel map, and how each finds the pairs."""

from dataclasses import dataclass, field

import numpy as np

from steelnb.datatypes import Array, IntArray
from steelnb.errors import EmptyCloudError
from steelnb.mapping import VoxelGrid, VoxelMap
from steelnb.preprocess.covariances import neighbour_covariances, normals, regularised
from steelnb.preprocess.kdtree import KdTree, build_kdtree
from steelnb.registration.correspond import correspond_points, correspond_voxels

KEPT = 3
"""How many neighbours of a point are kept from one step to the next."""


@dataclass(frozen=True)
class Target:
    """A cloud: its k-d tree and, in the order of the tree, normals ``(M, 3)`` and covariances ``(M, 6)``.

    Normals serve the error ``plane``, covariances ``gicp``; what is not needed may be of length zero.
    """

    tree: KdTree
    normal: Array
    covariance: Array

    @property
    def point(self) -> Array:
        """Points ``(M, 3)`` that the pairs refer to."""
        return self.tree.point

    def pairs(self, source: Array, limit_m: float) -> "TreePairs":
        """A search for the nearest point of each source point."""
        n = len(source)
        near = np.full((n, KEPT), -1)
        return TreePairs(self.tree, source, limit_m, np.full(n, -1), near, np.full(n, -1.0), np.zeros((n, 3)))


@dataclass(frozen=True)
class VoxelTarget:
    """A voxel map as it is, without copies: a point is paired with the distribution of a voxel around it (VGICP).

    ``covariance (capacity, 6)`` by slot, m². Thin voxels want a floor; put it on the source's covariances, where an
    isotropic one does the same. Valid until the map's next `insert`.
    """

    grid: VoxelGrid
    covariance: Array
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def point(self) -> Array:
        """Means of the voxels ``(capacity, 3)`` that the pairs refer to."""
        return self.grid.mean

    def pairs(self, source: Array, limit_m: float) -> "VoxelPairs":
        """A search for the nearest voxel mean around each source point."""
        n = len(source)
        return VoxelPairs(self.grid, source, limit_m, np.full(n, -1), np.full(n, -1), np.full((n, 9), -1))


@dataclass(frozen=True)
class TreePairs:
    """Nearest neighbours as the pose moves: exact, and searched again only where they may have changed."""

    tree: KdTree
    source: Array
    limit_m: float
    match: IntArray
    near: IntArray
    beyond: Array
    searched_from: Array

    def update(self, T_target_source: Array) -> None:
        """Refill ``match (N,)``: positions in the target's points, −1 for none near."""
        correspond_points(
            self.tree, self.source, T_target_source, self.limit_m, self.match, self.near, self.beyond,
            self.searched_from,
        )  # fmt: skip


@dataclass(frozen=True)
class VoxelPairs:
    """Voxels around each source point as the pose moves."""

    grid: VoxelGrid
    source: Array
    limit_m: float
    match: IntArray
    octant: IntArray
    around: IntArray

    def update(self, T_target_source: Array) -> None:
        """Refill ``match (N,)``: slots of the map, −1 for none near."""
        correspond_voxels(self.grid, self.source, T_target_source, self.limit_m, self.match, self.octant, self.around)


def make_target(points: Array, error: str, neighbours: int = 20) -> Target:
    """Index a cloud ``(M, 3)`` for registration; normals and covariances only where the error needs them.

    Raises `EmptyCloudError`.
    """
    tree = build_kdtree(finite(points, "target"))
    normal, covariance = np.zeros((0, 3)), np.zeros((0, 6))
    if error != "point":
        covariance = neighbour_covariances(tree.point, neighbours, tree)
    if error == "plane":
        normal, covariance = normals(covariance), np.zeros((0, 6))
    if error == "gicp":
        covariance = regularised(covariance)
    return Target(tree, normal, covariance)


def voxel_target(voxels: VoxelMap) -> VoxelTarget:
    """The target of VGICP; the map's `update_shapes` must have been called for what was inserted."""
    if not len(voxels):
        raise EmptyCloudError("target: an empty voxel map, expected one with points")
    return VoxelTarget(*voxels.grid())


def finite(points: Array, name: str) -> Array:
    """The finite points of a cloud ``(N, 3)`` or image ``(H, W, 3)``. Raises `EmptyCloudError`."""
    points = np.asarray(points, dtype=np.float64)
    if points.size and (points.ndim < 2 or points.shape[-1] != 3):
        raise EmptyCloudError(f"{name}: an array of shape {points.shape}, expected a cloud (N, 3)")
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise EmptyCloudError(f"{name}: no finite point, expected a cloud (N, 3)")
    return np.ascontiguousarray(points)
