"""Lines of a point cloud by the iterative 3D Hough transform: arguments and result of the compiled loop."""

import math

import numpy as np

from steelnb.errors import InputError
from steelnb.hough.directions import directions
from steelnb.hough.dx import default_dx, distinct_points
from steelnb.hough.transform import iterate
from steelnb.types import Array, Lines

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
    """Find infinite lines by the iterative 3D Hough transform.

    Source: Dalitz, Schramke, Jeltsch, "Iterative Hough Transform for Line Detection in 3D Point Clouds", IPOL 7 (2017),
    184–196, Algorithm 1: the strongest cell of the vote image, an orthogonal least squares fit to the points within
    ``dx`` of it, their removal, and again. Given the same ``dx``, the lines are those of the published program.

    Parameters
    ----------
    points: ``(N, 3)`` in metres, any frame, finite.
    dx: cell width of the vote image and radius of a line, metres; by default `default_dx`, as in `detect_segments`. The
        published program takes 1/64 of the diagonal of the bounding box.
    min_votes: fewest points of a line. A weaker one ends the search, as in the published program, or is left out with
        its points where ``skip_weak``.
    max_lines: largest number of lines; by default all.
    granularity: subdivisions of the icosahedron, 0–6: 1281 directions for 4, 20481 for 6.

    Returns `Lines` in the frame of the points, in the order found, strongest first; anchors are the means of their
    points. Raises `InputError` for points that are not finite, fewer than two distinct ones, and settings out of range.

    >>> import numpy as np
    >>> post = np.linspace([0, 0, 0], [0, 0, 5], 100)
    >>> beam = np.linspace([0.5, 0, 5], [3.5, 0, 5], 60)
    >>> lines = detect_lines(np.concatenate([post, beam]), dx=0.1, min_votes=20)
    >>> lines.count.tolist(), np.abs(lines.direction).round(3).tolist()
    ([100, 60], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    """
    points, low, high = distinct_points(points)
    diagonal = float(np.linalg.norm(high - low))
    dx = default_dx(points) if dx is None else dx
    if not 0 < dx < diagonal:
        raise InputError(f"dx = {dx}: expected a length above 0 and below the cloud's diagonal, {diagonal:.3g} m")
    if granularity not in range(7):
        raise InputError(f"granularity = {granularity}: expected an integer from 0 to 6")
    if min_votes < 2 or (max_lines is not None and max_lines < 1):
        raise InputError(f"min_votes = {min_votes}, max_lines = {max_lines}: expected at least 2 and at least 1")
    centre = (low + high) / 2.0
    px, py, pz = np.ascontiguousarray((points - centre).T)
    half = float(max(np.linalg.norm(high - centre), np.linalg.norm(low - centre)))
    if 2 * half / dx >= math.isqrt(MAX_CELLS) + 0.5:
        fits = 2 * half / math.isqrt(MAX_CELLS)
        unit = 10.0 ** (math.floor(math.log10(fits)) - 2)  # of the third digit, which is rounded up
        fits = math.ceil(fits / unit) * unit
        raise InputError(f"dx = {dx}: the vote image would pass {MAX_CELLS} cells; a dx of {fits:.3g} m would fit")
    columns = int(2 * half / dx + 0.5)

    most = min(len(points) // 2, max_lines or len(points))
    anchor, direction, count = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros(most, np.int64)
    label = np.full(len(points), -1, np.int64)
    found = iterate(
        px, py, pz, directions(granularity), high - centre, half, dx, columns, min_votes, most, skip_weak,
        anchor, direction, count, label,
    )  # fmt: skip
    return Lines(anchor[:found] + centre, direction[:found], count[:found], label)
