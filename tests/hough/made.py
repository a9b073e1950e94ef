"""Points of straight bars, and how far found segments are from them."""

import numpy as np

from steelnb.core.types import Segments


def strip(start, end, n=600, noise_m=0.005, seed=0, wide_m=0.0):
    """Points on a line from start to end with Gaussian noise, and spread over ``wide_m`` along y."""
    rng = np.random.default_rng(seed)
    start, end = np.array(start, float), np.array(end, float)
    points = start + rng.uniform(size=(n, 1)) * (end - start) + rng.normal(scale=noise_m, size=(n, 3))
    points[:, 1] += rng.uniform(-wide_m / 2, wide_m / 2, n)
    return points


def ends_off_m(found: Segments, axes: np.ndarray) -> np.ndarray:
    """Distance of the farther end of the nearest segment from each of the ``axes (M, 2, 3)``, either end first."""
    ends = np.stack([found.start, found.end], axis=1)[:, None]
    farther = [np.linalg.norm(each - axes, axis=3).max(axis=2) for each in (ends, ends[:, :, ::-1])]
    return np.min(farther, axis=0).min(axis=0)
