"""Points → `Segments`, by the methods that the report compares (its section 1.1).

Open3D and scikit-learn are imported by the methods that use them, since the imports take seconds.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from steelnb.core.checks import check_sequence, checked_choice, checked_integer, checked_number
from steelnb.core.errors import InputError
from steelnb.core.kernels import njit
from steelnb.core.open3d import import_open3d
from steelnb.core.rng import stream
from steelnb.core.types import Array, Lines, Segments
from steelnb.hough.alternatives.refine import POINTS_MIN, bars_of_groups, bars_of_lines, in_passes, refine
from steelnb.hough.lines import default_dx, detect_lines, distinct_points
from steelnb.hough.transform import drop, fit_near_line

PLANES_MAX, NEIGHBOURS_MIN, VARIANCE_FLOOR_M2 = 30, 10, 1e-5
"""Maximum number of RANSAC planes; minimum number of points within dx of a DBSCAN core point, itself included; minimum
variance of a mixture component along any axis."""
GRANULARITY = 3
"""Granularity of `detect_lines`. Directions 8° apart suffice, since the lines are then fitted to their points."""
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
        if name in LISTS:
            check_sequence(value, name, "integers")
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
"""The options that a method has beside those that all have: whole numbers above 0."""
LISTS = ("components",)
"""Options that are lists of such numbers."""


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
