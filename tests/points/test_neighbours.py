"""The sweep through sorted keys against a look-up of each offset."""

import numpy as np
import pytest

from steelnb.points import VoxelMap
from steelnb.points.kdtree import advance, columns_of, gather
from steelnb.points.voxel_map import offsets_within


@pytest.mark.kernels
@pytest.mark.parametrize(("radius_m", "every"), [(0.2, 1), (0.35, 3), (0.05, 1)])
def test_neighbours_are_found_nearest_first_for_all_voxels_or_some(radius_m: float, every: int) -> None:
    voxels = VoxelMap(0.1)
    voxels.insert(np.random.default_rng(1).normal(scale=(0.3, 0.3, 0.1), size=(300, 3)))
    key, offsets = np.sort(voxels.keys()), offsets_within(radius_m, 0.1)
    columns, place = columns_of(offsets), {k: n for n, k in enumerate(key.tolist())}
    first, last = np.zeros(len(columns.low), np.int64), np.zeros(len(columns.low), np.int64)
    at, found = np.full(len(offsets), -1), np.empty(len(offsets), np.int64)
    for n in range(0, len(key), every):
        expected = [place[k] for k in (key[n] + offsets).tolist() if k in place]
        assert advance(key, n, columns, first, last) == len(expected)
        assert found[: gather(key, n, columns, first, last, at, found)].tolist() == expected
