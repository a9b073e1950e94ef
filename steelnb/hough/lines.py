"""Lines of a point cloud: the checks around the compiled iterative Hough transform."""

import math

import numpy as np

from steelnb.datatypes import Array, Lines
from steelnb.errors import DegenerateCloudError, EmptyCloudError, SettingsError
from steelnb.hough.directions import directions
from steelnb.hough.kernels import iterate

MAX_CELLS = 1 << 26
"""Largest vote image: 64 million cells of 4 bytes, 256 MiB."""


def detect_lines(
    points: Array,
    dx: float | None = None,
    min_votes: int = 2,
    max_lines: int | None = None,
    granularity: int = 4,
    skip_weak: bool = False,
) -> Lines:
    """Find lines by the iterative 3D Hough transform (Dalitz, Schramke, Jeltsch, IPOL 7, 2017, Algorithm 1).

    Parameters
    ----------
    points: ``(N, 3)`` metres, finite.
    dx: cell width of the vote image and radius of a line in metres; by default 1/64 of the bounding box's diagonal.
    min_votes: a line with fewer points ends the search, or is passed over where ``skip_weak``.
    max_lines: how many lines to return at the most; by default all.
    granularity: subdivisions of the icosahedron, 0–6: 1281 directions for 4, 20481 for 6.

    Returns `Lines`, strongest first in the order found; anchors are the means of their points. Raises
    `EmptyCloudError`, `DegenerateCloudError` (fewer than two distinct points), `SettingsError`.
    """
    points = checked_points(points)
    low, high = points.min(axis=0), points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    if diagonal == 0.0:
        raise DegenerateCloudError(f"cloud of {len(points)} points: all identical, expected two distinct points")
    dx = diagonal / 64 if dx is None else dx
    if not 0 < dx < diagonal:
        raise SettingsError(f"dx = {dx}: expected a length above 0 and below the cloud's diagonal, {diagonal:.3g} m")
    if granularity not in range(7):
        raise SettingsError(f"granularity = {granularity}: expected an integer from 0 to 6")
    if min_votes < 2 or (max_lines is not None and max_lines < 1):
        raise SettingsError(f"min_votes = {min_votes}, max_lines = {max_lines}: expected at least 2 and at least 1")
    centre = (low + high) / 2.0
    px, py, pz = np.ascontiguousarray((points - centre).T)
    half = float(max(np.linalg.norm(high - centre), np.linalg.norm(low - centre)))
    if 2 * half / dx >= math.isqrt(MAX_CELLS) + 0.5:
        fits = 2 * half / math.isqrt(MAX_CELLS)
        unit = 10.0 ** (math.floor(math.log10(fits)) - 2)  # of the third digit, which is rounded up
        fits = math.ceil(fits / unit) * unit
        raise SettingsError(f"dx = {dx}: the vote image would pass {MAX_CELLS} cells; a dx of {fits:.3g} m would fit")
    columns = int(2 * half / dx + 0.5)

    most = min(len(points) // 2, max_lines or len(points))
    anchor, direction, count = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros(most, np.int64)
    label = np.full(len(points), -1, np.int64)
    found, _ = iterate(
        px, py, pz, directions(granularity), high - centre, half, dx, columns, min_votes, most, skip_weak,
        anchor, direction, count, label,
    )  # fmt: skip
    return Lines(anchor[:found] + centre, direction[:found], count[:found], label)


def checked_points(points: Array) -> Array:
    """``points`` as ``(N, 3)`` float64. Raises `EmptyCloudError` or, with under two points, `DegenerateCloudError`."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingsError(f"points of shape {points.shape}: expected (N, 3)")
    if not len(points):
        raise EmptyCloudError("cloud of 0 points: expected at least two")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise EmptyCloudError(f"cloud with {np.count_nonzero(~finite)} of {len(points)} points not finite; drop them")
    if len(points) < 2:
        raise DegenerateCloudError("cloud of 1 point: expected at least two")
    return points
