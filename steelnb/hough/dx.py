"""The cell width dx of the Hough transform, from the widths of the bars and the spacing of the points in a cloud."""

import math

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.points.inputs import checked_cloud
from steelnb.points.moments import NO_MOMENTS, add_moments, add_point, covariance, principal_axis, store
from steelnb.types import Array

PROBES = 60
RADII = 2.0 * 1.25 ** np.arange(13)
"""Radii of the balls around a probe, in point spacings: 2 to 29."""
LINEARITY = 0.8
"""Least share of the variance in a ball that lies along its axis: a ball of a bar, not of clutter."""
SPREADS, SPACINGS = 1.4, 1.2
"""dx in root mean square distances to the axis, and in point spacings. Chosen on the development seeds 11 to 16."""


def suggest_dx(points: Array) -> float:
    """Radius in metres of a tube that holds the points of one bar: the default ``dx`` of lines and segments.

    The larger of 1.4 times the root mean square distance of points to the axis of their bar, which covers section
    width and range noise, and 1.2 times the point spacing. The first is the median over balls around 60 points, each
    of the radius at which its points are most linear: smaller balls see the section as a blob, larger ones see other
    bars. Source: Demantké et al., "Dimensionality based scale selection in 3D lidar point clouds", ISPRS 2011.

    ``points (N, 3)`` finite, in metres. Raises `InputError`.
    """
    points, low, high = distinct_points(points)
    diagonal = float(np.linalg.norm(high - low))
    points = points[np.argsort(points[:, 2], kind="stable")]  # so that the points near a probe are one slice
    px, py, pz = np.ascontiguousarray(points.T)
    probes = np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)
    spacing = float(np.median(_nearest(px, py, pz, probes)))
    spread = _spread(px, py, pz, probes, np.minimum(RADII * spacing, diagonal))
    like_a_line = spread[:, 0] >= LINEARITY
    # A cloud without a line: the spacing alone decides.
    width = SPREADS * float(np.median(spread[like_a_line, 1])) if like_a_line.any() else 0.0
    return min(max(width, SPACINGS * spacing, 1e-6 * diagonal), diagonal / 2)


def distinct_points(points: Array) -> tuple[Array, Array, Array]:
    """``points`` as ``(N, 3)`` float64, finite and not all identical, and the corners ``(3,)`` of their bounding box.

    Raises `InputError` (shape), `InputError` (no points, or some not finite), `InputError`.
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


@njit(cache=True)
def _nearest(px, py, pz, probes):
    """Distance of each probe to the nearest point that is not at the same place."""
    result = np.zeros(len(probes))
    for k in range(len(probes)):
        i = probes[k]
        least = np.inf
        for step in (-1, 1):
            j = i + step
            while 0 <= j < len(px):
                z = pz[j] - pz[i]
                if z * z >= least:
                    break
                x, y = px[j] - px[i], py[j] - py[i]
                squared = x * x + y * y + z * z
                if 0.0 < squared < least:
                    least = squared
                j += step
        result[k] = math.sqrt(least)
    return result


@njit(cache=True)
def _spread(px, py, pz, probes, radii):
    """Share of the variance along the axis, and root mean square distance to the axis in metres, ``(probes, 2)``: of
    the ball around each probe in which the first is largest."""
    result = np.zeros((len(probes), 2))
    shells = len(radii)
    limit = radii * radii
    for k in range(len(probes)):
        i = probes[k]
        m = np.zeros((shells, 10))
        first = np.searchsorted(pz, pz[i] - radii[-1])
        for j in range(first, np.searchsorted(pz, pz[i] + radii[-1])):
            x, y, z = px[j] - px[i], py[j] - py[i], pz[j] - pz[i]
            squared = x * x + y * y + z * z
            if squared <= limit[-1]:
                s = 0
                while squared > limit[s]:
                    s += 1
                store(add_point(m[s], 1.0, x, y, z), m[s])
        total = NO_MOMENTS
        for s in range(shells):
            total = add_moments(total, m[s], 0.0, 0.0, 0.0)
            if total[0] >= 10:
                xx, xy, xz, yy, yz, zz = covariance(total)
                along, across, _, _, _ = principal_axis(xx, xy, xz, yy, yz, zz)
                if along > result[k, 0] * (along + across):
                    result[k, 0], result[k, 1] = along / (along + across), math.sqrt(across)
    return result
