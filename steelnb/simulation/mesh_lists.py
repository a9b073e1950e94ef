"""Meshes as PyBullet takes them, without its leak: it keeps a reference to the list of vertices and to each vertex in
it for good (bullet3#2898), 1 MiB a flight."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray

VERTICES_MAX, TRIANGLES_MAX = 131_072, 174_762
"""PyBullet's shared memory holds no larger mesh: 2¹⁷ vertices and 2¹⁹ indices."""
_rows: list[list[float]] = []
"""Reused for all meshes, so that memory is bounded by the largest."""
_lock = threading.Lock()


@contextmanager
def mesh_lists(vertices: Array, triangles: IntArray) -> Iterator[dict[str, list]]:
    """The arguments ``vertices`` and ``indices`` of ``createCollisionShape``, for a mesh of vertices ``(V, 3)`` and
    triangles ``(T, 3)``. They are emptied at the end. Raises `InputError` for a mesh that is larger than
    PyBullet takes."""
    for name, count, most in (("vertices", len(vertices), VERTICES_MAX), ("triangles", len(triangles), TRIANGLES_MAX)):
        if count > most:
            raise InputError(f"tower: {count} {name}; expected at most {most} for a flight, so fewer or longer members")
    with _lock:
        _rows.extend([] for _ in range(len(vertices) - len(_rows)))
        for kept, row in zip(_rows, vertices.tolist(), strict=False):
            kept[:] = row
        lists: dict[str, list] = {"vertices": _rows[: len(vertices)], "indices": triangles.ravel().tolist()}
        yield lists
        for each in lists.values():
            each.clear()
