"""Near-side bias: the distance from the visible surfaces of bars to their axes, from the width of the bars in a scan.

A sensor sees the near side of a bar, so its points lie nearer than the axis, from every direction. When the view turns,
they move around the bar, and a registration mistakes this for a motion of the drone. If they are moved away from the
sensor by the right length, they lie around the axis, whatever the direction of view.

Over all directions of view, the pixels lie mean(F) / (2 mean(w)) before the centroid of a section, where w is its width
and F the area between its front and its back. By Cauchy's formula, mean(w) is the perimeter of the hull over pi
(Santaló, Integral Geometry and Geometric Probability, 2nd ed. 2004, I.1). For an equal-leg angle section of flange b
and thickness b/12, as rolled ones have, that is 0.1145 b, and the mean width of the pixels 1.138 b, so the length is
0.10 times the width in the scans. The factor would be 0.045 without thickness, and pi/8 = 0.39 for a round tube.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.covariances import neighbour_covariances, normals
from steelnb.points.ranges import STEP_M, ranges_ahead

SHARE_OF_WIDTH = 0.10
WIDTH_MAX_M = 0.4
"""Wider surfaces are not bars."""


class NearSide:
    """Running estimate of the bias from organised scans; zero before the first one and for unorganised clouds."""

    def __init__(self) -> None:
        self._sum_m, self._pixels = 0.0, 0

    @property
    def shift_m(self) -> float:
        """Near-side bias, metres, by which points are to be moved away from the sensor: a share of the mean apparent
        width of bars over all pixels so far."""
        return SHARE_OF_WIDTH * (self._sum_m / self._pixels if self._pixels else 0.0)

    def shifted(self, points: Array, sensor: Array) -> Array:
        """Points ``(N, 3)`` moved away from the sensor's position ``(3,)`` by the shift."""
        ray = points - sensor
        distance = np.linalg.norm(ray, axis=1, keepdims=True)
        return np.asarray(points + self.shift_m * ray / np.maximum(distance, 1e-9))

    def update(self, image: Array) -> None:
        """Add the widths in an organised scan ``(H, W, 3)``, sensor frame."""
        if image.ndim == 3 and min(image.shape[:2]) > 2:
            total, pixels = apparent_width(strip_widths(np.ascontiguousarray(image, dtype=np.float64)))
            self._sum_m += total
            self._pixels += pixels


@njit(cache=True)
def strip_widths(image):
    """Width of the strip around each pixel ``(H, W)`` of an organised scan ``(H, W, 3)``, metres, 0 where unknown.

    If a row crosses a strip of width w over the length h, and a column over v, then 1/w² = 1/h² + 1/v², whatever the
    strip's direction. A run ends at a missing return or where neighbouring ranges differ by more than 0.15 m.
    """
    rows, columns = image.shape[0], image.shape[1]
    distance = ranges_ahead(image)  # NaN if not in front of the sensor, where slopes are undefined
    along_row, along_column = np.zeros((rows, columns)), np.zeros((rows, columns))
    measure_runs(image, distance, 1, along_row)
    measure_runs(image.transpose(1, 0, 2), distance.T, 2, along_column.T)
    for r in range(rows):
        for c in range(columns):
            h, v = along_row[r, c], along_column[r, c]
            along_row[r, c] = h * v / np.sqrt(h * h + v * v) if h > 0.0 and v > 0.0 else 0.0
    return along_row


@njit(cache=True)
def apparent_width(width):
    """(sum, count) of the `strip_widths` up to `WIDTH_MAX_M`."""
    total, count = 0.0, 0
    for w in width.flat:
        if 0.0 < w < WIDTH_MAX_M:
            total += w
            count += 1
    return total, count


@njit(cache=True)
def measure_runs(image, distance, across, length):
    """Length of the run of returns around each pixel of a line, metres, 0 for none, written to ``length (L, K)``.

    ``across`` is the coordinate that grows along a line. The pitch of a run comes from its first and last point, so a
    lone pixel has none.
    """
    lines, pixels = distance.shape
    for i in range(lines):
        first = 0
        for k in range(1, pixels + 1):
            if k < pixels and abs(distance[i, k] - distance[i, k - 1]) <= STEP_M:
                continue
            if distance[i, first] == distance[i, first] and k - 1 > first:
                a, b = image[i, first], image[i, k - 1]
                pitch = abs(b[across] / b[0] - a[across] / a[0]) * 0.5 * (a[0] + b[0]) / (k - 1 - first)
                for j in range(first, k):
                    length[i, j] = (k - first) * pitch
            first = k


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
    i, j = upper = np.triu_indices(3)
    return np.asarray(PLANE_M2 * (np.eye(3)[upper] - normal[:, i] * normal[:, j]))
