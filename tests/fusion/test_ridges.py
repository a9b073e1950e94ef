"""The ridge filter against its definition, voxel by voxel."""

import math

import numpy as np

from steelnb.fusion.ridges import ridge_points
from steelnb.points import VoxelMap

VOXEL, RADIUS, SHARE, CONTRACT = 0.05, 0.17, 0.3, 0.09


def defined(mean: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The slow twin: all voxels beside all others."""
    cube = np.floor(mean / VOXEL).astype(int)
    apart = np.linalg.norm(cube[:, None] - cube[None], axis=2) * VOXEL
    most = np.where(apart <= RADIUS + 1e-9, weight, 0.0).max(axis=1)
    stay = (weight > 0) & (most * SHARE <= weight)
    reach = int((CONTRACT + math.sqrt(3) * VOXEL) / VOXEL) * VOXEL
    assert reach > CONTRACT
    near = (np.linalg.norm(mean[:, None] - mean[None], axis=2) <= CONTRACT) & stay
    share = (near * weight)[stay]
    return share @ mean / share.sum(axis=1, keepdims=True)


def haze(seed: int) -> VoxelMap:
    rng = np.random.default_rng(seed)
    line = np.linspace([-1.0, -0.5, 0.2], [0.9, 0.7, 0.5], 4000) + 0.04 * rng.standard_normal((4000, 3))
    voxels = VoxelMap(VOXEL)
    voxels.insert(np.concatenate([line, rng.uniform(-1, 1, (300, 3))]), rng.uniform(0.5, 2.0, 4300))
    return voxels


def test_ridges_are_those_of_the_definition() -> None:
    voxels = haze(1)
    found = ridge_points(voxels, RADIUS, SHARE, CONTRACT)
    assert 50 < len(found) < 0.8 * len(voxels)
    np.testing.assert_allclose(found, defined(voxels.means(), voxels.weights()), atol=1e-12)


def test_what_is_left_out_counts_for_nothing() -> None:
    voxels = haze(2)
    mean, weight = voxels.means(), voxels.weights()
    out = mean[:, 0] > 0
    found = ridge_points(voxels, RADIUS, SHARE, CONTRACT, out)
    np.testing.assert_allclose(found, defined(mean, np.where(out, 0.0, weight)), atol=1e-12)
    np.testing.assert_array_equal(voxels.weights(), weight)
