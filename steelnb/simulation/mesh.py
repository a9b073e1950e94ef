"""A triangle mesh in place of the members of a list: what scans see and the drone touches."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.geometry import points_along
from steelnb.core.types import Array, IntArray

GROUND, ON_PLATE = -1, -2
"""Used in place of a member's index: the ground, and a steel plate, which is not a bar. Constants of kernels (njit)."""
TOUCH_M = 1e-5
"""Tolerance within which surfaces touch and a ray hits an edge; float32 cannot resolve smaller distances."""
NEAR_M = 0.1
"""A triangle belongs to the nearest member, if its middle is this near to points on the axis, half as far apart."""
APART_MAX = 0.25
"""The boxes of mesh and members may differ by this share of their diagonal: railings stand out, other units do not."""


def read_mesh(path: str, axes: Array) -> tuple[Array, IntArray, IntArray]:
    """Vertices ``(V, 3)`` and triangles ``(T, 3)`` of an STL or PLY file, in metres and the world frame, and the member
    of each triangle ``(T,)``, or `ON_PLATE`. ``axes (M, 2, 3)``: the members.

    Slivers lower than `TOUCH_M` are dropped: rays there hit the triangles beside them, which are that tolerant. Raises
    `InputError`.
    """
    form = "an STL or PLY file of triangles"
    if Path(path).suffix.lower() not in (".stl", ".ply"):
        raise InputError(f"tower.mesh = {path!r}: expected FILE.stl or FILE.ply")
    with reading(path, form):
        import trimesh

        mesh = trimesh.load_mesh(path, process=False)
        corner = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces, np.int64).reshape(-1, 3)]
    if not np.isfinite(corner).all():
        raise InputError(f"{path}: corners that are not finite; expected {form}")
    corner = corner[_height(corner) > TOUCH_M]
    if not len(corner):
        raise InputError(f"{path}: no triangles; expected {form}")
    _check_place(path, corner.reshape(-1, 3), axes.reshape(-1, 3))
    vertices, triangles = np.unique(corner.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, triangles.reshape(-1, 3), _owners(corner.mean(axis=1), axes)


def _check_place(path: str, corner: Array, ends: Array) -> None:
    """Raise `InputError` unless a mesh of corners ``(N, 3)`` is where the members are, which have ``ends (M, 3)``."""
    box, expected = (np.array([points.min(axis=0), points.max(axis=0)]) for points in (corner, ends))
    if np.abs(box - expected).max() > APART_MAX * np.linalg.norm(expected[1] - expected[0]):
        seen, wanted = (" to ".join(str(tuple(map(float, each.round(1)))) for each in both) for both in (box, expected))
        raise InputError(
            f"{path}: from {seen}; the members are from {wanted}: expected a mesh in metres, world frame, z up"
        )


def _height(corner: Array) -> Array:
    """The least height of triangles ``(T, 3, 3)``, metres."""
    side = np.roll(corner, -1, axis=1) - corner
    double_area = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
    longest = np.linalg.norm(side, axis=2).max(axis=1)
    return np.divide(double_area, longest, out=np.zeros(len(corner)), where=longest > 0)


def _owners(middle: Array, axes: Array) -> IntArray:
    """The member near each of the points ``(T, 3)``, or `ON_PLATE`."""
    points, member = points_along(axes[:, 0], axes[:, 1], NEAR_M / 2)
    distance, nearest = cKDTree(points).query(middle)
    return np.where(distance <= NEAR_M, member[nearest], ON_PLATE)
