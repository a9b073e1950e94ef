import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.points import VoxelMap, voxel_grid, voxel_map
from steelnb.points.voxel_map import SearchState
from tests import naive

VOXEL = 0.25


def frames(count=5, n=400):
    """Scans of a wavy surface around the origin, with positive and negative coordinates."""
    rng = np.random.default_rng(7)
    for k in range(count):
        x, y = rng.uniform(-2, 2, (2, n)) + 0.3 * k
        yield np.stack([x, y, 0.3 * np.sin(3 * x) + 0.02 * rng.normal(size=n)], axis=1)


def sorted_by_voxel(points):
    return points[np.lexsort(np.floor(points / VOXEL).T[::-1])]


@pytest.mark.kernels
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    voxel_m=st.sampled_from([0.1, 0.25, 1.0]),
    count=st.integers(1, 4),
    n=st.integers(0, 60),
)
def test_moments_and_shapes_equal_their_slow_twin_after_every_scan(seed, voxel_m, count, n):
    voxels, points, weights = VoxelMap(voxel_m), np.zeros((0, 3)), np.zeros(0)
    rng = np.random.default_rng(seed)
    for _ in range(count):
        frame, weight = rng.normal(size=(n, 3)) * [1, 0.5, 0.1], rng.uniform(0.5, 2, n)
        voxels.insert(frame, weight)
        points, weights = np.vstack([points, frame]), np.append(weights, weight)
        expected = naive.voxel_moments(points, weights, voxel_m)
        means, mass = voxels.means(), voxels.weights()
        assert len(voxels) == len(expected) == len(means)
        asked = rng.integers(-1, len(voxels), 5)
        some = asked[asked >= 0]
        first = voxels.shapes(asked, 0.25)[some].copy()
        shapes = voxels.shapes(np.arange(len(voxels)), 0.25)
        np.testing.assert_array_equal(first, shapes[some])
        for slot, shape in enumerate(naive.full(shapes)):
            weight_, mean, covariance = expected[tuple(np.floor(means[slot] / voxel_m).astype(int))]
            assert mass[slot] == pytest.approx(weight_)
            np.testing.assert_allclose(means[slot], mean, atol=1e-12)
            np.testing.assert_allclose(shape, covariance + 0.25 * np.eye(3), atol=1e-12)


def test_without_accumulate_the_map_is_the_voxel_grid_of_old_means_and_new_points():
    voxels, cloud = VoxelMap(VOXEL, accumulate=False), np.zeros((0, 3))
    for frame in frames():
        voxels.insert(frame)
        cloud = voxel_grid(np.vstack([cloud, frame]), VOXEL)  # PC0 ← voxel grid of PC0 + PC1
        np.testing.assert_allclose(sorted_by_voxel(voxels.means()), sorted_by_voxel(cloud), atol=1e-9)
    accumulated = VoxelMap(VOXEL)
    for frame in frames():
        accumulated.insert(frame)
    assert np.abs(sorted_by_voxel(accumulated.means()) - sorted_by_voxel(cloud)).max() > 0.01


def test_many_insertions_equal_one():
    # 60,000 voxels exceed the initial capacity of the arrays and the table several times.
    rng = np.random.default_rng(1)
    points = rng.uniform(-5, 5, (70_000, 3))
    grown, at_once = VoxelMap(0.2), VoxelMap(0.2)
    at_once.insert(points)
    for part in np.array_split(points, 40):
        grown.insert(part)
    assert len(grown) == len({tuple(c) for c in np.floor(points / 0.2).astype(int)})
    np.testing.assert_allclose(grown.means(), at_once.means(), atol=1e-12)
    shapes = [voxels.shapes(np.arange(len(voxels))) for voxels in (grown, at_once)]
    np.testing.assert_allclose(*shapes, atol=1e-12)
    assert sum(array.nbytes for array in vars(grown).values() if isinstance(array, np.ndarray)) < 100e6


@pytest.mark.kernels
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), sizes=st.sampled_from([(0.1, 0.05), (0.1, 0.3), (0.25, 0.8), (1.0, 1.0)]))
def test_the_nearest_mean_of_each_moving_point_is_found(seed, sizes):
    voxel_m, limit_m = sizes
    rng, voxels, n = np.random.default_rng(seed), VoxelMap(voxel_m), 20
    voxels.insert(rng.normal(size=(rng.integers(1, 150), 3)) * [1, 0.5, 0.1])
    source = rng.normal(size=(n, 3))
    source[0], source[1] = 1e9, np.nan  # far away, and nowhere
    match, state, T = np.full(n, 7), SearchState.of(n), np.eye(4)
    for size in (0.3, 0.1, 0.01, 0.001, 0.3):
        T[:3, 3] += rng.normal(size=3) * size
        voxels.correspond(source, T, limit_m, match, state)
        apart = np.linalg.norm((source + T[:3, 3])[:, None] - voxels.means(), axis=2)
        apart[1] = np.inf
        np.testing.assert_array_equal(match, np.where(apart.min(axis=1) <= limit_m, apart.argmin(axis=1), -1))


def test_points_that_hardly_move_are_not_searched_for_again():
    voxels, rng = VoxelMap(VOXEL), np.random.default_rng(0)
    voxels.insert(rng.uniform(-1, 1, (3000, 3)) * [1, 1, 0.05])
    source, T = rng.uniform(-1, 1, (500, 3)) * [1, 1, 0.05], np.eye(4)
    match, state = np.full(500, -1), SearchState.of(500)
    assert voxels.correspond(source, T, 0.5, match, state) == 500
    T[0, 3] = 0.001
    assert voxels.correspond(source, T, 0.5, match, state) < 50


def test_near_finds_the_voxels_that_overlap_a_cube():
    voxels = VoxelMap(VOXEL)
    for frame in frames():
        voxels.insert(frame)
    corner = np.floor(voxels.means() / VOXEL) * VOXEL
    for centre, radius in [((0, 0, 0), 0.6), ((-1.1, 0.4, 0.1), 0.33), ((0.5, 0.5, 0.2), 1e9), ((30, 0, 0), 1.0)]:
        overlaps = ((corner <= np.add(centre, radius)) & (corner + VOXEL > np.subtract(centre, radius))).all(axis=1)
        np.testing.assert_array_equal(np.sort(voxels.near(np.array(centre), radius)), np.flatnonzero(overlaps))
    assert len(voxels.near(np.array([0, 0, 0.0]), 0.6)) > 10


def test_points_on_voxel_faces_belong_to_the_upper_voxel():
    voxels = VoxelMap(0.5)
    voxels.insert(np.array([[0.0, 0, 0], [-0.5, 0, 0], [-1e-9, 0, 0], [0.5, 0, 0], [-0.75, 0, 0]]))
    assert len(voxels) == 4
    np.testing.assert_allclose(np.sort(voxels.means()[:, 0]), [-0.75, -0.25, 0.0, 0.5], atol=1e-8)


def test_means_keep_their_precision_far_from_the_origin():
    offset = np.array([9e4, -8e4, 1e3])
    near, far = VoxelMap(0.1), VoxelMap(0.1)
    points = next(frames(1)) + 0.05
    near.insert(points)
    far.insert(points + offset)
    np.testing.assert_allclose(sorted_by_voxel(far.means() - offset), sorted_by_voxel(near.means()), atol=1e-9)


@pytest.mark.parametrize(
    ("points", "weight"),
    [
        (np.full((2, 3), np.nan), None),
        (np.array([[1e6, 0, 0]]), None),
        (np.zeros((2, 3)), np.array([1.0, 0.0])),
        (np.zeros((2, 3)), np.array([1.0, np.nan])),
        (np.zeros((2, 3)), np.ones(3)),
    ],
)
def test_invalid_points_and_weights_are_refused_and_leave_the_map_unchanged(points, weight):
    voxels = VoxelMap(0.1)
    voxels.insert(next(frames(1)))
    before = voxels.means()
    with pytest.raises(InputError):
        voxels.insert(points, weight)
    np.testing.assert_array_equal(voxels.means(), before)


@pytest.mark.parametrize("step", [(1, 0, 0), (0, 0, 1), (512, 0, 0), (0, 512, 0), (1, 1, 1)])
def test_voxels_in_a_row_have_different_buckets(step):
    keys = [voxel_map.pack(*(k * np.array(step) - 900)) for k in range(2000)]
    buckets = {voxel_map.bucket_of(key, (1 << 12) - 1) for key in keys}
    assert len(buckets) > 0.9 * 4096 * (1 - np.exp(-2000 / 4096))  # at most a tenth fewer than at random


def test_a_voxel_without_size_is_refused():
    with pytest.raises(InputError, match="voxel_m"):
        VoxelMap(0.0)
