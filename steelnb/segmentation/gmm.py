"""Bars by a Gaussian mixture (scikit-learn), whose long components are bars."""

from collections.abc import Sequence

import numpy as np

from steelnb.config import SegmentationSettings
from steelnb.datatypes import Array, Segments
from steelnb.errors import SettingsError
from steelnb.rng import stream
from steelnb.segmentation.bars import bars_of_groups, prepared, refine

VARIANCE_FLOOR_M2 = 1e-5


def segment_by_gmm(
    points: Array,
    settings: SegmentationSettings | None = None,
    seed: int = 0,
    dx: float | None = None,
    components: Sequence[int] = (25, 50, 100),
    sample: int = 3000,
) -> Segments:
    """A mixture for each number of ``components``, the best by the Bayesian information criterion, and the principal
    axis of the points of each component.

    It is fitted to ``sample`` of the points, and then holds all. ``dx``, the distance of a bar's points to its axis, is
    chosen from the points by default.
    """
    points, settings, dx = prepared(points, settings, dx)
    if not components or min(components) < 1 or sample < 2:
        raise SettingsError(f"components = {components}, sample = {sample}: expected numbers from 1, and at least 2")
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
    return refine(points, bars_of_groups(points, label, settings), dx, settings)
