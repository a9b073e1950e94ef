"""Registration target: an indexed cloud, and the search for correspondences in it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from steelnb.errors import InputError
from steelnb.points import VoxelShapes
from steelnb.points.covariances import PlaneCovariances, neighbour_covariances, normals
from steelnb.points.inputs import checked_cloud
from steelnb.points.kdtree import KdTree, build_kdtree
from steelnb.registration.correspond import correspond_points
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
    return (
        Target(tree, normals(neighbour_covariances(tree.point, neighbours, tree))) if error == "plane" else Target(tree)
    )


def finite(points: Array, name: str) -> Array:
    """The finite points of a cloud ``(N, 3)`` or image ``(H, W, 3)``. Raises `InputError`."""
    points = checked_cloud(points, name).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{name}: no finite point, expected a cloud (N, 3)")
    return np.ascontiguousarray(points)
