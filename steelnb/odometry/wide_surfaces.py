"""Surfaces in a scan that are too wide for bars: ground, walls and decks.

No axis lies behind them, so they have no near-side bias. And the map's points on them lie where the sensor has sampled
them, so a pair determines the pose only along the normal. Along the surface it would keep the scan where it was
predicted.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.types import Array, IntArray
from steelnb.odometry.near_side import WIDTH_MAX_M, strip_widths
from steelnb.points.covariances import UPPER, neighbour_covariances, normals

SHARE_MIN = 0.3
"""Minimum share of a scan's points on such surfaces. Plates, and bars that touch in the image, have up to 0.27 with the
report's sensor, 0.01 with ``starling2``."""
BESIDE_M, ASIDE_M, TURN_RAD = 2.0, 0.04, 0.03
"""Points this near to one on a surface are on it too if they are this near to its plane, whose normal may be wrong by
an angle: between two bars, or far away, the width of a surface is not seen."""
PLANE_M2 = 1.0
"""Variance within a surface, as in GICP's plane-to-plane model."""


def pixels_on_surfaces(points: Array, used: IntArray) -> NDArray[np.bool_]:
    """Mask of the pixels of an organised scan ``(H, W, 3)``, sensor frame, on surfaces wider than `WIDTH_MAX_M`.

    ``used (K,)``: index of the points that count, such as those of `world_points`. The mask is false everywhere if
    fewer than `SHARE_MIN` of them lie on such surfaces, and for a cloud without order ``(N, 3)``.
    """
    none = np.zeros(points.shape[:-1], dtype=bool)
    if points.ndim < 3 or min(none.shape) < 3:
        return none
    wide = strip_widths(np.ascontiguousarray(points, dtype=np.float64)) >= WIDTH_MAX_M
    return wide if len(used) and wide.ravel()[used].mean() >= SHARE_MIN else none


def parted(bars: Array, surfaces: Array) -> tuple[Array, Array, Array]:
    """Filtered points ``(N, 3)`` off and ``(M, 3)`` on wide surfaces, with those of the first that lie beside a surface
    (`BESIDE_M`) moved to the second; and the unit normals ``(M, 3)`` of the second."""
    normal = normals(neighbour_covariances(surfaces))
    distance, near = cKDTree(surfaces).query(bars, distance_upper_bound=BESIDE_M)
    found = np.flatnonzero(np.isfinite(distance))
    aside = np.einsum("ni,ni->n", bars[found] - surfaces[near[found]], normal[near[found]])
    beside = found[np.abs(aside) < ASIDE_M + TURN_RAD * distance[found]]
    return (
        np.delete(bars, beside, axis=0),
        np.concatenate([surfaces, bars[beside]]),
        np.concatenate([normal, normal[near[beside]]]),
    )


def within_plane(normal: Array) -> Array:
    """Covariances ``(M, 6)`` of `PLANE_M2` within the planes of unit normals ``(M, 3)``: upper triangles, m²."""
    i, j = UPPER
    return np.asarray(PLANE_M2 * (np.eye(3)[UPPER] - normal[:, i] * normal[:, j]))
