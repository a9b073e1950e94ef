"""How wide the bars of a cloud are, as the Hough transform sees them: a dx for a user who gives none."""

import math

import numpy as np
from numba import njit

from steelnb.datatypes import Array
from steelnb.errors import DegenerateCloudError
from steelnb.hough.kernels import principal_axis
from steelnb.hough.lines import checked_points

PROBES = 60
RADII = 2.0 * 1.25 ** np.arange(13)
"""Of the balls around a probe, in point spacings: 2 to 29."""
LINEARITY = 0.8
"""Least share of the variance in a ball that lies along its axis: a ball of a bar, not of clutter."""
SPREADS, SPACINGS = 1.4, 1.2
"""dx in root mean square distances to the axis, and in point spacings. Chosen on the development seeds 11 to 16."""


def suggest_dx(points: Array) -> float:
    """dx, metres, that holds the points of one bar: from the point spacing and from how far points lie off their axis.

    The second is the width of the section and the range noise in one. It is measured in balls around some points, each
    of the radius at which its points look most like a line: smaller balls see the section as a blob, larger ones see
    other bars (Demantké et al., "Dimensionality based scale selection in 3D lidar point clouds", ISPRS 2011).

    ``points (N, 3)`` finite metres. Raises as `detect_lines`.
    """
    points = checked_points(points)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if diagonal == 0.0:
        raise DegenerateCloudError(f"cloud of {len(points)} points: all identical, expected two distinct points")
    points = points[np.argsort(points[:, 2], kind="stable")]  # so that the points near a probe are one slice
    px, py, pz = np.ascontiguousarray(points.T)
    probes = np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)
    spacing = float(np.median(_nearest(px, py, pz, probes)))
    spread = _spread(px, py, pz, probes, np.minimum(RADII * spacing, diagonal))
    like_a_line = spread[:, 0] >= LINEARITY
    # A cloud without a line: the spacing alone decides.
    width = SPREADS * float(np.median(spread[like_a_line, 1])) if like_a_line.any() else 0.0
    return min(max(width, SPACINGS * spacing, 1e-6 * diagonal), diagonal / 2)


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
    """For each probe, of the ball in which its points are most like a line: (share of the variance along the axis,
    root mean square distance to the axis in metres)."""
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
                m[s, 0] += 1
                m[s, 1] += x
                m[s, 2] += y
                m[s, 3] += z
                m[s, 4] += x * x
                m[s, 5] += x * y
                m[s, 6] += x * z
                m[s, 7] += y * y
                m[s, 8] += y * z
                m[s, 9] += z * z
        total = np.zeros(10)
        for s in range(shells):
            total += m[s]
            n = total[0]
            if n >= 10:
                x, y, z = total[1] / n, total[2] / n, total[3] / n
                along, across, _, _, _ = principal_axis(
                    total[4] - n * x * x, total[5] - n * x * y, total[6] - n * x * z, total[7] - n * y * y,
                    total[8] - n * y * z, total[9] - n * z * z,
                )  # fmt: skip
                if along > result[k, 0] * (along + across):
                    result[k, 0], result[k, 1] = along / (along + across), math.sqrt(across / n)
    return result
