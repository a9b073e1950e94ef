"""Ranges of scans: their noise, and their denoising by the sigma filter."""

import numpy as np
from numba import njit

from steelnb.points.inputs import checked_cloud
from steelnb.types import Array

SIGMA_M, SIGMA_SHARE = 0.01, 0.01
"""Standard deviation of a range to every estimator: 1 cm, and 1 % of the range beyond 1 m, as in data sheets of
Time-of-Flight cameras, that of the Starling 2 among them."""
ALIKE = 4.0
"""Standard deviations by which ranges of one surface may differ: each has its own noise, so nearly three of theirs."""


@njit(cache=True)
def range_sigma_m(range_m):  # type: ignore[no-untyped-def]
    """Standard deviation of a range, metres."""
    return max(SIGMA_M, SIGMA_SHARE * range_m)


@njit(cache=True)
def ranges_ahead(image):  # type: ignore[no-untyped-def]
    """Ranges ``(H, W)`` of an organised scan ``(H, W, 3)``, sensor frame; NaN for no return and for what is not before
    the sensor, such as zeros, by which many drivers mark no return."""
    rows, columns = image.shape[0], image.shape[1]
    distance = np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):
            x, y, z = image[r, c, 0], image[r, c, 1], image[r, c, 2]
            distance[r, c] = np.sqrt(x * x + y * y + z * z) if x > 0.0 else np.nan
    return distance


def smooth_ranges(points: Array, half: int = 1) -> Array:
    """Points ``(H, W, 3)`` of an organised scan in the sensor frame, each moved along its ray; NaN stays NaN. A cloud
    ``(N, 3)``, which has no neighbours, stays as it is.

    Its range becomes the mean of the ranges within ``half`` pixels that differ from it by less than `ALIKE` standard
    deviations: the sigma filter (Lee 1983, Digital image smoothing and the sigma filter). Ranges of a bar are averaged
    along the bar; background beside it does not count. Raises `InputError` for another shape.
    """
    points = checked_cloud(points)
    if points.ndim == 2:
        return points
    return np.asarray(_smooth(np.ascontiguousarray(points), half))


@njit(cache=True)
def _smooth(points, half):
    rows, columns, _ = points.shape
    # NaN compares false with everything, so a border of it needs no bounds.
    distance = np.full((rows + 2 * half, columns + 2 * half), np.nan)
    for i in range(rows):
        for j in range(columns):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            distance[i + half, j + half] = np.sqrt(x * x + y * y + z * z)
    smooth = np.empty_like(points)
    for i in range(rows):
        for j in range(columns):
            middle = distance[i + half, j + half]
            if not 0.0 < middle < np.inf:
                smooth[i, j, :] = points[i, j]
                continue
            bound = ALIKE * range_sigma_m(middle)
            total, count = 0.0, 0.0
            for a in range(2 * half + 1):
                for b in range(2 * half + 1):
                    apart = distance[i + a, j + b] - middle
                    if abs(apart) <= bound:
                        total += apart
                        count += 1.0
            share = 1.0 + total / count / middle
            for k in range(3):
                smooth[i, j, k] = points[i, j, k] * share
    return smooth
