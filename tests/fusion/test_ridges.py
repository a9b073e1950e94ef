"""The ridge filter against its definition, voxel by voxel."""

import numpy as np

from steelnb.fusion.bars import ridge_points
from steelnb.points import VoxelMap
from tests import naive

VOXEL, RADIUS, SHARE, CONTRACT = 0.05, 0.17, 0.3, 0.09


def haze(seed: int) -> VoxelMap:
    rng = np.random.default_rng(seed)
    line = np.linspace([-1.0, -0.5, 0.2], [0.9, 0.7, 0.5], 4000) + 0.04 * rng.standard_normal((4000, 3))
    voxels = VoxelMap(VOXEL)
    voxels.insert(np.concatenate([line, rng.uniform(-1, 1, (300, 3))]), rng.uniform(0.5, 2.0, 4300))
    return voxels


def test_ridges_are_those_of_the_definition() -> None:
    voxels = haze(1)
    mean, weight = voxels.means(), voxels.weights()
    found = ridge_points(voxels, RADIUS, SHARE, CONTRACT)
    expected = naive.ridge_points(mean, weight, VOXEL, RADIUS, SHARE, CONTRACT)
    assert 50 < len(found) < 0.8 * len(voxels)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_array_equal(voxels.weights(), weight)
