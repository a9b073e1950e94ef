"""The default cell width dx of the Hough transform, and the check of its points."""

import numpy as np
from scipy.spatial import cKDTree

from steelnb.errors import InputError
from steelnb.points.inputs import checked_cloud
from steelnb.types import Array

DX_MIN_M, DX_PER_SPACING, SAMPLE = 0.07, 1.2, 5000


def default_dx(points: Array) -> float:
    """Default ``dx`` of lines and segments for finite ``points (N, 3)``, metres. Raises `InputError`.

    It is 1.2 times the median spacing of the points, at least 7 cm, which holds a bar of a tower with its noise, and at
    most half the diagonal of the cloud.
    """
    points, low, high = distinct_points(points)
    return min(max(DX_PER_SPACING * spacing(points), DX_MIN_M), float(np.linalg.norm(high - low)) / 2)


def spacing(points: Array) -> float:
    """Median distance of the points ``(N, 3)`` to their nearest neighbours, metres, of at most `SAMPLE` points."""
    sample = points[np.linspace(0, len(points) - 1, min(len(points), SAMPLE)).astype(int)]
    return float(np.median(cKDTree(points).query(sample, k=min(2, len(points)))[0][:, -1]))


def distinct_points(points: Array) -> tuple[Array, Array, Array]:
    """``points (N, 3)`` as float64, and the corners ``(3,)`` of their bounding box.

    Raises `InputError` for another shape, points that are not finite, and fewer than two distinct points.
    """
    points = checked_cloud(points)
    if points.ndim != 2:
        raise InputError(f"points of shape {points.shape}: expected (N, 3)")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise InputError(f"cloud with {np.count_nonzero(~finite)} of {len(points)} points not finite; drop them")
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    if len(points) < 2 or (low == high).all():
        size = {0: "0 points", 1: "1 point"}.get(len(points), f"{len(points)} identical points")
        raise InputError(f"cloud of {size}: expected at least two distinct points")
    return points, low, high
