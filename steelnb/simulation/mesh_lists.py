"""Meshes as PyBullet takes them: in parts that it holds, and without its leak. It keeps a reference to the list of
vertices and to each vertex in it for good (bullet3#2898), 1 MiB a flight."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from steelnb.core.types import Array, IntArray

VERTICES_MAX, TRIANGLES_MAX = 131_072, 174_762
"""PyBullet's shared memory holds no larger mesh: 2¹⁷ vertices and 2¹⁹ indices."""
_rows: list[list[float]] = []
"""Reused for all meshes, so that memory is bounded by the largest."""
_lock = threading.Lock()


def mesh_parts(vertices: Array, triangles: IntArray) -> Iterator[tuple[Array, IntArray]]:
    """A mesh of vertices ``(V, 3)`` and triangles ``(T, 3)``, in parts that PyBullet holds."""
    if len(vertices) <= VERTICES_MAX and len(triangles) <= TRIANGLES_MAX:
        yield vertices, triangles
        return
    for begin in range(0, len(triangles), VERTICES_MAX // 3):
        corner = vertices[triangles[begin : begin + VERTICES_MAX // 3]].reshape(-1, 3)
        yield corner, np.arange(len(corner)).reshape(-1, 3)


@contextmanager
def mesh_lists(vertices: Array, triangles: IntArray) -> Iterator[dict[str, list]]:
    """The arguments ``vertices`` and ``indices`` of ``createCollisionShape``, for a mesh of vertices ``(V, 3)`` and
    triangles ``(T, 3)``. They are emptied at the end."""
    with _lock:
        _rows.extend([] for _ in range(len(vertices) - len(_rows)))
        for kept, row in zip(_rows, vertices.tolist(), strict=False):
            kept[:] = row
        lists: dict[str, list] = {"vertices": _rows[: len(vertices)], "indices": triangles.ravel().tolist()}
        yield lists
        for each in lists.values():
            each.clear()
