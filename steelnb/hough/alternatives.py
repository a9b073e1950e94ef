"""Points → `Segments`, by the methods that the report compares (its section 1.1), and the refinement that all share.

Open3D and scikit-learn are imported by the methods that use them, since the imports take seconds.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from steelnb.core.checks import checked_choice, checked_integer, checked_number
from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.open3d import import_open3d
from steelnb.core.rng import stream
from steelnb.core.types import Array, IntArray, Lines, Segments
from steelnb.hough.lines import default_dx, detect_lines, distinct_points
from steelnb.hough.near_segments import nearest_bar
from steelnb.hough.segments import counts_near, cut_and_sort, filter_pieces, merge
from steelnb.hough.transform import drop, fit_line, fit_near_line
from steelnb.settings import HoughSettings

POINTS_MIN, MERGE_DISTANCE_M, LENGTH_MIN_M = 15, 0.12, 0.3
"""Minimum number of points, maximum distance of merged pieces, and minimum length of a bar. Shared by all methods for a
fair comparison. Chosen for the Hough transform on development seeds 11 to 16."""
GRANULARITY, PCA_RATIO, EXCLUDE_DX = 3, 0.9, 1.25
"""Of the Hough transform, its directions; of a bar, the minimum share of the variance along it; and within how many dx
of a bar points are left out in the second pass."""
SORTING = HoughSettings()
"""A bar has no larger gap and no larger root mean square radius (``dx_m``) than the defaults of the Hough transform."""
ASSIGN_DX = 1.2
"""Maximum distance of a bar's points from its axis, in dx. It exceeds 1 since lines miss the edges of wide sections."""
END_MARGIN_M = 0.05
"""A bar also takes points up to this far past its ends."""
OWN_SHARE_MIN = 0.33
"""Minimum share of the points within twice `ASSIGN_DX` of a bar that belong to it. Chords between two bars at a joint
fall below it. It rejects half of all wrong segments and one in a hundred correct ones (seeds 11 to 16)."""
ROUNDS = 3
"""Rounds of assignment and refit; after three the axes no longer move."""


def bars_of_groups(points: Array, label: IntArray, points_min: int = POINTS_MIN) -> Segments:
    """Bars along the principal axes of groups of points ``(N, 3)``, cut at gaps, merged and filtered.

    ``label (N,)`` is the group of each point, counted from 0, or −1 for none.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    groups = [np.flatnonzero(label == g) for g in range(int(label.max(initial=-1)) + 1)]
    fits = np.array([fit_line(px, py, pz, group, len(group)) for group in groups]).reshape(-1, 8)
    count = np.array([len(group) for group in groups], dtype=np.int64)
    return bars_of_lines(points, Lines(fits[:, 2:5], fits[:, 5:], count, label), points_min)


def bars_of_lines(points: Array, lines: Lines, points_min: int = POINTS_MIN) -> Segments:
    """Bars along lines, cut at gaps, merged and filtered."""
    return cut_and_sort(
        points, lines, SORTING.gap_max_m, points_min, PCA_RATIO, SORTING.dx_m, 0.0, LENGTH_MIN_M, MERGE_DISTANCE_M,
    )  # fmt: skip


def in_passes(find: Callable[[Array], Segments], points: Array, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """Bars found in the points, and bars found in a second pass over the points that are on none of the first.

    A line across many bars takes points of each before it is dropped; the second pass can use those points again.
    """
    first = find(points)
    remaining = points[nearest_bar(points, first, EXCLUDE_DX * dx, dx) < 0]
    if len(remaining) < points_min or np.linalg.norm(np.ptp(remaining, axis=0)) <= 2 * dx:
        return first
    return Segments.joined((first, find(remaining)))


def refine(points: Array, bars: Segments, dx: float, points_min: int = POINTS_MIN) -> Segments:
    """Refit each bar to all points ``(N, 3)`` that are nearest to its axis, and merge collinear bars, `ROUNDS` times.

    A detected bar may cover half of the true width or two thirds of the length. At the end, bars that fail the bounds
    or own too few of the points around them are dropped.
    """
    px, py, pz = np.ascontiguousarray(points.T)
    for round_ in range(ROUNDS):
        final = round_ == ROUNDS - 1
        label = nearest_bar(points, bars, ASSIGN_DX * dx, END_MARGIN_M)
        order = np.argsort(label, kind="stable")
        begin = np.searchsorted(label[order], np.arange(len(bars) + 1))
        piece = np.column_stack([begin[:-1], begin[1:]])
        piece = piece[np.diff(piece, axis=1).ravel() >= 2]
        if not final:
            # Join the pieces of a partly occluded bar: its axis is now known well enough to bridge wider gaps.
            order, piece = merge(px, py, pz, order, piece, MERGE_DISTANCE_M, 2 * SORTING.gap_max_m)
        bounds = (PCA_RATIO, SORTING.dx_m, 0.0, LENGTH_MIN_M) if final else (0.0, np.inf, 0.0, 0.0)
        bars = Segments(*filter_pieces(px, py, pz, order, piece, *bounds))
    around = counts_near(px, py, pz, bars.start, bars.direction, bars.length, 2 * ASSIGN_DX * dx)
    return bars.take((bars.count >= points_min) & (bars.count >= OWN_SHARE_MIN * around))


PLANES_MAX, NEIGHBOURS_MIN, VARIANCE_FLOOR_M2 = 30, 10, 1e-5
"""Maximum number of RANSAC planes; minimum number of points within dx of a DBSCAN core point, itself included; minimum
variance of a mixture component along any axis."""
SAMPLE_M, DRAWS = 0.5, 50
"""RANSAC draws the second point of a line within `SAMPLE_M` of the first, in up to `DRAWS` draws. Two random points
of 10,000 are seldom on the same bar."""
FAILURES = 3
"""RANSAC stops after this many lines in a row with too few points."""


def find_bars_by(
    method: str, points: Array, seed: int = 0, dx: float | None = None, points_min: int = POINTS_MIN, **options: Any
) -> Segments:
    """Find bars by a method of `FINDERS`; the refinement is the same for all methods.

    Parameters
    ----------
    points: ``(N, 3)`` in metres, any frame, finite.
    seed: for methods that draw random numbers.
    dx: distance of a bar's points from its axis, metres; default `default_dx`.
    points_min: minimum number of points of a bar.
    options: further arguments of the method.

    Raises `InputError` as `steelnb.hough.detect_lines`.
    """
    checked_choice(method, "method", FINDERS)
    points, _, _ = distinct_points(points)
    dx = default_dx(points) if dx is None else checked_number(dx, "dx", above=0)
    seed, points_min = checked_integer(seed, "seed", 0), checked_integer(points_min, "points_min", 2)
    for name, value in options.items():
        checked_choice(name, f"option of {method}", OPTIONS.get(method, ()))
        if name == "components":
            options[name] = tuple(checked_integer(each, f"{name}[{k}]", 1) for k, each in enumerate(value))
            if not value:
                raise InputError(f"{name} = {value!r}: expected at least one number")
        else:
            options[name] = checked_integer(value, name, 1)
    return refine(points, FINDERS[method](points, seed, dx, points_min, **options), dx, points_min)


def _hough(points: Array, seed: int, dx: float, points_min: int) -> Segments:
    """Hough lines with at least ``points_min`` votes, in two passes."""

    def find(subset: Array) -> Segments:
        lines = detect_lines(subset, dx, points_min, None, GRANULARITY, skip_weak=True)
        return bars_of_lines(subset, lines, points_min)

    return in_passes(find, points, dx, points_min)


def _ransac_lines(points: Array, seed: int, dx: float, points_min: int, trials: int = 300) -> Segments:
    """RANSAC lines: of ``trials`` lines through two points, take the one with the most inliers, remove them, repeat.

    Inliers lie within ``dx``. Source: Fischler and Bolles, "Random Sample Consensus", Communications of the ACM 24
    (1981), 381–395. Compiled here, since a scan needs some 30,000 trials: scikit-learn's RANSAC fits regressions,
    Open3D's only planes, and those of scikit-image and pyRANSAC-3D loop in Python.
    """
    random = stream(seed, "ransac-lines")

    def find(subset: Array) -> Segments:
        px, py, pz = np.ascontiguousarray(subset.T)
        lines = Lines(*_draw_lines(px, py, pz, random, dx, trials, points_min))
        return bars_of_lines(subset, lines, points_min)

    return in_passes(find, points, dx, points_min)


def _ransac_planes(points: Array, seed: int, dx: float, points_min: int, trials: int = 500) -> Segments:
    """RANSAC planes: of ``trials`` planes, take the one with the most points within ``dx``, remove them, repeat."""
    open3d = import_open3d()
    open3d.utility.random.seed(int(stream(seed, "ransac-planes").integers(2**31)))
    label = np.full(len(points), -1, dtype=np.int64)
    for plane in range(PLANES_MAX):
        remaining = np.flatnonzero(label < 0)
        if len(remaining) < max(points_min, 3):
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[remaining]))
        # With probability 1 all trials run; otherwise their number depends on the threads.
        _, inside = cloud.segment_plane(dx, ransac_n=3, num_iterations=trials, probability=1.0)
        if len(inside) < points_min:
            break
        label[remaining[np.asarray(inside)]] = plane
    return bars_of_groups(points, label, points_min)


def _dbscan(points: Array, seed: int, dx: float, points_min: int) -> Segments:
    """Clusters of points with at least `NEIGHBOURS_MIN` points within ``dx``, and the principal axis of each.

    Source: Ester et al., "A Density-Based Algorithm for Discovering Clusters", KDD 1996.
    """
    open3d = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=dx, min_points=NEIGHBOURS_MIN), dtype=np.int64)
    return bars_of_groups(points, label, points_min)


def _gmm(
    points: Array,
    seed: int,
    dx: float,
    points_min: int,
    components: Sequence[int] = (25, 50, 100),
    sample: int = 3000,
) -> Segments:
    """Gaussian mixture with the number of ``components`` that minimises the Bayesian information criterion.

    The bars are the principal axes of the components. The mixtures are fitted to ``sample`` random points; the best one
    then assigns all points to its components.
    """
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    random = stream(seed, "gmm")
    subset = points if len(points) <= sample else points[np.sort(random.choice(len(points), sample, replace=False))]
    state = int(random.integers(2**31))
    with threadpool_limits(1):  # else rounding depends on the threads
        mixtures = [
            GaussianMixture(n, random_state=state, reg_covar=VARIANCE_FLOOR_M2, max_iter=200).fit(subset)
            for n in sorted({min(n, len(subset)) for n in components})
        ]
        best = min(mixtures, key=lambda mixture: mixture.bic(subset))
        label = best.predict(points).astype(np.int64)
    return bars_of_groups(points, label, points_min)


FINDERS: dict[str, Callable[..., Segments]] = {
    "ransac-planes": _ransac_planes,
    "ransac-lines": _ransac_lines,
    "dbscan": _dbscan,
    "gmm": _gmm,
    "hough": _hough,
}
"""The methods by their names in tables and figures."""
OPTIONS = {"ransac-planes": ("trials",), "ransac-lines": ("trials",), "gmm": ("components", "sample")}
"""The options that a method has beside those that all have: whole numbers above 0; ``components`` is a list of them."""


@njit(cache=True)
def _draw_lines(px, py, pz, random, dx, trials, points_min):
    """The loop of `_ransac_lines`: (anchor, direction, count, label) as in `Lines`."""
    n = len(px)
    label = np.full(n, -1, np.int64)
    anchor, direction = np.zeros((n // points_min + 1, 3)), np.zeros((n // points_min + 1, 3))
    count = np.zeros(n // points_min + 1, np.int64)
    px, py, pz, original = px.copy(), py.copy(), pz.copy(), np.arange(n)
    chosen, removed = np.empty(n, np.int64), np.zeros(n, np.uint8)
    found = failures = 0
    while n >= points_min and failures < FAILURES:
        inliers_max, line = 0, np.zeros(6)
        for _ in range(trials):
            i = int(random.random() * n)
            for _ in range(DRAWS):
                j = int(random.random() * n)
                x, y, z = px[j] - px[i], py[j] - py[i], pz[j] - pz[i]
                length = np.sqrt(x * x + y * y + z * z)
                if dx < length <= SAMPLE_M:
                    break
            else:
                continue
            x, y, z = x / length, y / length, z / length
            inliers = _count_inliers(px, py, pz, n, px[i], py[i], pz[i], x, y, z, dx)
            if inliers > inliers_max:
                inliers_max = inliers
                line[:] = px[i], py[i], pz[i], x, y, z
        fitted, size, ax, ay, az, ux, uy, uz = fit_near_line(
            px[:n], py[:n], pz[:n], line[0], line[1], line[2], line[3], line[4], line[5], dx, points_min, chosen
        )
        if inliers_max < points_min or not fitted:
            failures += 1
            continue
        failures = 0
        anchor[found, 0], anchor[found, 1], anchor[found, 2] = ax, ay, az
        direction[found, 0], direction[found, 1], direction[found, 2] = ux, uy, uz
        count[found] = size
        for k in range(size):
            removed[original[chosen[k]]] = 1
            label[original[chosen[k]]] = found
        n = drop(removed, px[:n], py[:n], pz[:n], original)
        found += 1
    return anchor[:found], direction[:found], count[:found], label


@njit(cache=True)
def _count_inliers(px, py, pz, n, ax, ay, az, ux, uy, uz, distance):
    count = 0
    limit = distance * distance
    for i in range(n):
        x, y, z = px[i] - ax, py[i] - ay, pz[i] - az
        t = ux * x + uy * y + uz * z
        count += x * x + y * y + z * z - t * t <= limit
    return count
