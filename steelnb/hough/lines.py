"""Lines of a point cloud by the iterative 3D Hough transform."""

import math

import numpy as np
from scipy.spatial import cKDTree

from steelnb.core.checks import check_coordinates, checked_cloud, checked_integer, checked_number
from steelnb.core.errors import InputError
from steelnb.core.types import Array, Lines
from steelnb.hough.transform import directions, iterate

DX_MIN_M, DX_PER_SPACING, SAMPLE = 0.07, 1.2, 5000
"""Minimum of the default dx, its ratio to the point spacing, and number of points that are sampled for the spacing."""
MAX_CELLS = 1 << 26
"""Maximum size of the vote image: 64 million cells of 4 bytes, 256 MiB."""


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
    184–196, Algorithm 1: take the cell with the most votes, fit a line by orthogonal least squares to the points within
    ``dx`` of it, remove them, repeat. With the same ``dx``, the lines equal those of the published program.

    Parameters
    ----------
    points: ``(N, 3)`` in metres, any frame, finite.
    dx: cell width of the vote image and maximum distance of a point from its line, metres; default `default_dx`. The
        published program uses 1/64 of the diagonal of the bounding box.
    min_votes: minimum number of points of a line. A weaker line ends the search, as in the published program.
    max_lines: maximum number of lines; by default no limit.
    granularity: subdivisions of the icosahedron, 0–6: 1281 directions for 4, 20481 for 6.
    skip_weak: drop weak lines together with their points and go on.

    Returns `Lines` in the frame of the points, strongest first. Anchors are the means of the points of each line.
    Raises `InputError` for points that are not finite, fewer than two distinct points, and settings out of range.

    >>> import numpy as np
    >>> post = np.linspace([0, 0, 0], [0, 0, 5], 100)
    >>> beam = np.linspace([0.5, 0, 5], [3.5, 0, 5], 60)
    >>> lines = detect_lines(np.concatenate([post, beam]), dx=0.1, min_votes=20)
    >>> lines.count.tolist(), np.abs(lines.direction).round(3).tolist()
    ([100, 60], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    """
    points, low, high = distinct_points(points)
    diagonal = float(np.linalg.norm(high - low))
    dx = default_dx(points) if dx is None else checked_number(dx, "dx", above=0)
    if not dx < diagonal:
        raise InputError(f"dx = {dx}: expected a positive length below the cloud's diagonal, {diagonal:.3g} m")
    granularity = checked_integer(granularity, "granularity", 0, 6)
    min_votes = checked_integer(min_votes, "min_votes", 2)
    max_lines = None if max_lines is None else checked_integer(max_lines, "max_lines", 1)
    centre = (low + high) / 2.0
    px, py, pz = np.ascontiguousarray((points - centre).T)
    half = float(max(np.linalg.norm(high - centre), np.linalg.norm(low - centre)))
    if 2 * half / dx >= math.isqrt(MAX_CELLS) + 0.5:
        dx_min = 1.005 * 2 * half / math.isqrt(MAX_CELLS)  # more than rounding to three digits may take away
        raise InputError(f"dx = {dx}: the vote image would exceed {MAX_CELLS} cells; expected at least {dx_min:.3g} m")
    columns = int(2 * half / dx + 0.5)

    anchor, direction, count, label = iterate(
        px, py, pz, directions(granularity), high - centre, half, dx, columns, min_votes, max_lines or len(points),
        skip_weak,
    )  # fmt: skip
    return Lines(anchor + centre, direction, count, label)


def default_dx(points: Array) -> float:
    """Default ``dx`` of lines and segments for finite ``points (N, 3)``, metres. Raises `InputError`.

    It is 1.2 times the median spacing of the points, but at least 7 cm, enough for a tower's bar with its noise, and at
    most half the diagonal of the cloud.
    """
    points, low, high = distinct_points(points)
    return min(max(DX_PER_SPACING * spacing(points), DX_MIN_M), float(np.linalg.norm(high - low)) / 2)


def spacing(points: Array, neighbour: int = 1) -> float:
    """Median distance of at most `SAMPLE` of the points ``(N, 3)`` to their nearest neighbours, or to the second
    nearest, and so on; metres."""
    sample = points[np.linspace(0, len(points) - 1, min(len(points), SAMPLE)).astype(int)]
    tree = cKDTree(points, leafsize=64, balanced_tree=False, compact_nodes=False)  # fast to build, for few queries
    return float(np.median(tree.query(sample, k=[min(1 + neighbour, len(points))])[0][:, 0]))


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
    check_coordinates(points, "points")
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    if len(points) < 2 or (low == high).all():
        raise InputError(f"cloud of {len(points)} points, all alike: expected at least two distinct points")
    return points, low, high
