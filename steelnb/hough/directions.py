"""Directions of lines: the upper half of a subdivided icosahedron (Jeltsch, Dalitz, Pohle-Froehlich, VISAPP 2016)."""

from functools import lru_cache

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import checked_integer
from steelnb.core.types import Array

# In single precision, as in the published program: ties between directions depend on their order and last bits.
_TAU = np.float32(1.61803399)
_NORM = np.sqrt(np.float32(1) + _TAU * _TAU)
_V = float(np.float32(1) / _NORM)
_T = float(_TAU / _NORM)

_CORNERS = (
    (-_V, _T, 0.0), (_V, _T, 0.0), (0.0, _V, -_T), (0.0, _V, _T), (-_T, 0.0, -_V), (_T, 0.0, -_V),
    (-_T, 0.0, _V), (_T, 0.0, _V), (0.0, -_V, -_T), (0.0, -_V, _T), (-_V, -_T, 0.0), (_V, -_T, 0.0),
)  # fmt: skip
_TRIANGLES = (
    (0, 1, 2), (0, 1, 3), (0, 2, 4), (0, 4, 6), (0, 3, 6), (1, 2, 5), (1, 3, 7), (1, 5, 7), (2, 4, 8), (2, 5, 8),
    (3, 6, 9), (3, 7, 9), (4, 8, 10), (8, 10, 11), (5, 8, 11), (5, 7, 11), (7, 9, 11), (9, 10, 11), (6, 9, 10),
    (4, 6, 10),
)  # fmt: skip


@checks_arguments
@lru_cache(maxsize=8)
def directions(granularity: int) -> Array:
    """Unit vectors ``(5 * 4**granularity + 1, 3)`` that cover the half sphere evenly, one of each opposite pair.

    ``granularity`` 4 gives 1281 directions about 4° apart, 6 gives 20481 about 1° apart. They are in the order of the
    published program, which breaks ties by this order. Raises `InputError` for a granularity outside 0–6.
    """
    checked_integer(granularity, "granularity", 0, 6)
    vertices = [np.array(corner) for corner in _CORNERS]
    triangles = list(_TRIANGLES)
    for _ in range(granularity):
        middle: dict[frozenset[int], int] = {}
        finer = []
        for a, b, c in triangles:
            edges = [frozenset(edge) for edge in ((a, b), (b, c), (c, a))]
            for edge in (edge for edge in edges if edge not in middle):
                middle[edge] = len(vertices)
                x, y, z = total = np.sum([vertices[i] for i in edge], axis=0)
                vertices.append(total / np.sqrt(x * x + y * y + z * z))
            d, e, f = (middle[edge] for edge in edges)
            finer += [(a, d, f), (d, b, e), (f, e, c), (f, d, e)]
        triangles = finer
    sphere = np.array(vertices)
    x, y, z = sphere.T
    upper = (z > 0) | ((z == 0) & ((x > 0) | ((x == 0) & (y != -1))))
    result = sphere[upper]
    result.setflags(write=False)
    return result
