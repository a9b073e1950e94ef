"""The default cell width dx of the Hough transform, and the check of its points."""

import numpy as np
from scipy.spatial import cKDTree

from steelnb.errors import InputError
from steelnb.points.inputs import checked_cloud
from steelnb.types import Array

DX_MIN_M, SPACINGS, PROBES = 0.07, 1.2, 5000


def default_dx(points: Array) -> float:
    """The default ``dx`` of lines and segments, metres: 1.2 times the median spacing of the points, at least 7 cm,
    which holds a bar of a tower with its noise, and at most half the diagonal of the cloud.

    ``points (N, 3)`` finite, in metres. Raises `InputError`.
    """
    points, low, high = distinct_points(points)
    return min(max(SPACINGS * spacing(points), DX_MIN_M), float(np.linalg.norm(high - low)) / 2)


def spacing(points: Array) -> float:
    """Median distance of a point of ``(N, 3)`` to the nearest other one, metres; of many points, of some thousands."""
    asked = points[np.linspace(0, len(points) - 1, min(len(points), PROBES)).astype(int)]
    return float(np.median(cKDTree(points).query(asked, k=min(2, len(points)))[0][:, -1]))


def distinct_points(points: Array) -> tuple[Array, Array, Array]:
    """``points`` as ``(N, 3)`` float64, finite and not all identical, and the corners ``(3,)`` of their bounding box.

    Raises `InputError` for another shape, no points, points that are not finite, or fewer than two distinct ones.
    """
    points = checked_cloud(points)
    if points.ndim != 2:
        raise InputError(f"points of shape {points.shape}: expected (N, 3)")
    if not len(points):
        raise InputError("cloud of 0 points: expected at least two")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise InputError(f"cloud with {np.count_nonzero(~finite)} of {len(points)} points not finite; drop them")
    if len(points) < 2:
        raise InputError("cloud of 1 point: expected at least two")
    low, high = points.min(axis=0), points.max(axis=0)
    if (low == high).all():
        raise InputError(f"cloud of {len(points)} points: all identical, expected two distinct points")
    return points, low, high
