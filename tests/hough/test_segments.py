import numpy as np
import pytest

from steelnb.hough import detect_segments


def bar(start, end, n, noise_m=0.004, seed=0):
    rng = np.random.default_rng(seed)
    start, end = np.array(start, float), np.array(end, float)
    return start + rng.uniform(0, 1, (n, 1)) * (end - start) + rng.normal(scale=noise_m, size=(n, 3))


def test_a_line_is_cut_where_its_points_leave_a_gap():
    points = np.concatenate([bar([0, 0, 0], [1, 0, 0], 100, seed=1), bar([1.5, 0, 0], [3, 0, 0], 150, seed=2)])
    together = detect_segments(points, 0.05, min_votes=20, gap_max=0.6)
    apart = detect_segments(points, 0.05, min_votes=20, gap_max=0.3)
    assert len(together) == 1
    np.testing.assert_allclose(sorted(apart.length), [1, 1.5], atol=0.05)
    np.testing.assert_array_equal(sorted(apart.count), [100, 150])


def test_ends_direction_and_radius_are_those_of_the_bar():
    start, end = np.array([1.0, 2, 3]), np.array([1.5, 2.5, 5])
    found = detect_segments(bar(start, end, 2000, noise_m=0.01), 0.08, min_votes=500)
    assert len(found) == 1
    ends = sorted([found.start[0], found.end[0]], key=lambda p: p[2])
    np.testing.assert_allclose(ends, [start, end], atol=0.03)
    assert found.radius[0] == pytest.approx(0.01 * np.sqrt(2), rel=0.1)


@pytest.mark.parametrize(
    ("bounds", "kept"),
    [
        ({}, 1),
        ({"pca_ratio_min": 0.99}, 1),
        ({"pca_ratio_min": 0.9999999}, 0),
        ({"radius_max": 0.03}, 1),
        ({"radius_max": 0.002}, 0),
        ({"density_min": 90.0}, 1),
        ({"density_min": 120.0}, 0),
        ({"length_min": 0.9}, 1),
        ({"length_min": 1.2}, 0),
    ],
)
def test_sorting_keeps_what_passes_its_bounds(bounds, kept):
    points = bar([0, 0, 0], [0, 1, 0], 100)
    assert len(detect_segments(points, 0.05, min_votes=20, **bounds)) == kept


def test_a_ball_gives_no_segment():
    points = np.random.default_rng(5).normal(scale=0.3, size=(500, 3))
    assert len(detect_segments(points, 0.05, min_votes=12, pca_ratio_min=0.98, density_min=30.0, length_min=0.4)) == 0
