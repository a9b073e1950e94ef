"""Bars as groups of points and their principal axes: RANSAC planes, DBSCAN (Open3D), Gaussian mixtures (scikit-learn).

These packages are imported when a method is called, since they take seconds.
"""

from collections.abc import Sequence

import numpy as np

from steelnb.errors import InputError
from steelnb.hough.peers.bars import POINTS_MIN, bars_of_groups, prepared, refine
from steelnb.libraries import import_open3d
from steelnb.rng import stream
from steelnb.types import Array, Segments

VARIANCE_FLOOR_M2 = 1e-5
"""Least variance of a component of a mixture along any axis."""


def segment_by_ransac_planes(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    trials: int = 500,
    planes_max: int = 30,
) -> Segments:
    """The plane with most points within ``dx``, its points taken out, again, up to ``planes_max`` times.

    ``trials`` planes are tried each time. ``dx`` in metres is `default_dx` by default.
    """
    points, dx = prepared(points, dx, points_min)
    if trials < 1 or planes_max < 1:
        raise InputError(f"trials = {trials}, planes_max = {planes_max}: expected at least 1 each")
    open3d = import_open3d()
    open3d.utility.random.seed(int(stream(seed, "ransac-planes").integers(2**31)))
    label = np.full(len(points), -1, dtype=np.int64)
    for plane in range(planes_max):
        left = np.flatnonzero(label < 0)
        if len(left) < max(points_min, 3):
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[left]))
        # With a probability of 1 all trials are made: their number then does not depend on threads.
        _, inside = cloud.segment_plane(dx, ransac_n=3, num_iterations=trials, probability=1.0)
        if len(inside) < points_min:
            break
        label[left[np.asarray(inside)]] = plane
    return refine(points, bars_of_groups(points, label, points_min), dx, points_min)


def segment_by_dbscan(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    neighbours_min: int = 10,
) -> Segments:
    """Clusters of points with at least ``neighbours_min`` others within ``dx``, and the principal axis of each.

    ``dx`` in metres is `default_dx` by default; ``seed`` is not used. Source: Ester et al., "A Density-Based Algorithm
    for Discovering Clusters", KDD 1996, 226–231.
    """
    points, dx = prepared(points, dx, points_min)
    if neighbours_min < 1:
        raise InputError(f"neighbours_min = {neighbours_min}: expected at least 1")
    open3d = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=dx, min_points=neighbours_min), dtype=np.int64)
    return refine(points, bars_of_groups(points, label, points_min), dx, points_min)


def segment_by_gmm(
    points: Array,
    seed: int = 0,
    dx: float | None = None,
    points_min: int = POINTS_MIN,
    components: Sequence[int] = (25, 50, 100),
    sample: int = 3000,
) -> Segments:
    """A mixture for each number of ``components``, the best by the Bayesian information criterion, and the principal
    axis of the points of each component.

    It is fitted to ``sample`` of the points and then assigns all. ``dx``, the distance of a bar's points to its axis in
    metres, is `default_dx` by default.
    """
    points, dx = prepared(points, dx, points_min)
    if not components or min(components) < 1 or sample < 2:
        raise InputError(f"components = {components}, sample = {sample}: expected numbers from 1, and at least 2")
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    random = stream(seed, "gmm")
    some = points if len(points) <= sample else points[np.sort(random.choice(len(points), sample, replace=False))]
    state = int(random.integers(2**31))
    with threadpool_limits(1):  # sums of several threads are rounded in their order
        mixtures = [
            GaussianMixture(n, random_state=state, reg_covar=VARIANCE_FLOOR_M2, max_iter=200).fit(some)
            for n in sorted({min(n, len(some)) for n in components})
        ]
        best = min(mixtures, key=lambda mixture: mixture.bic(some))
        label = best.predict(points).astype(np.int64)
    return refine(points, bars_of_groups(points, label, points_min), dx, points_min)
