import numpy as np
import pytest

from steelnb.errors import InputError
from steelnb.points import smooth_ranges
from steelnb.points.ranges import ALIKE, SIGMA_M, SIGMA_SHARE


def directions(rows, columns):
    y, z = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(0.3, -0.3, rows))
    ray = np.stack([np.ones_like(y), y, z], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1)[..., None]


def obviously(points, half):
    distance = np.linalg.norm(points, axis=-1)
    smooth = points.copy()
    for i, j in np.argwhere(distance > 0):
        near = distance[max(i - half, 0) : i + half + 1, max(j - half, 0) : j + half + 1]
        alike = near[np.abs(near - distance[i, j]) <= ALIKE * max(SIGMA_M, SIGMA_SHARE * distance[i, j])]
        smooth[i, j] *= alike.mean() / distance[i, j]
    return smooth


@pytest.mark.kernels
@pytest.mark.parametrize("half", [0, 1, 2])
def test_it_is_the_mean_of_the_ranges_alike(half):
    rng = np.random.default_rng(3)
    distance = rng.choice([1.0, 1.02, 1.07, 3.0, 3.1, np.nan], (12, 17)) + 0.005 * rng.normal(size=(12, 17))
    points = distance[..., None] * directions(12, 17)
    np.testing.assert_allclose(smooth_ranges(points, half), obviously(points, half), atol=1e-12)


def test_noise_falls_threefold_on_a_surface_and_an_edge_stays_sharp():
    rng = np.random.default_rng(4)
    ray = directions(40, 40)
    truth = np.where(np.arange(40) < 20, 2.0, 3.0) * np.ones((40, 1))
    noisy = truth + 0.01 * truth * rng.normal(size=truth.shape)
    smooth = np.linalg.norm(smooth_ranges(noisy[..., None] * ray), axis=-1)
    inside = (slice(1, -1), np.r_[1:18, 22:39])
    assert np.std((smooth - truth)[inside]) < 0.4 * np.std((noisy - truth)[inside])
    assert np.abs(smooth - truth).max() < 0.15
    assert abs((smooth - truth).mean()) < 0.002


def test_what_did_not_return_stays_as_it_is_and_counts_for_nothing():
    points = 2.0 * directions(5, 5)
    points[2, 2] = np.nan
    points[0, 0], points[4, 4] = np.inf, 0.0
    smooth = smooth_ranges(points)
    np.testing.assert_allclose(smooth, points, atol=1e-12)


def test_points_without_order_stay_as_they_are():
    points = directions(5, 5).reshape(-1, 3)
    assert smooth_ranges(points) is points
    with pytest.raises(InputError, match=r"\(7, 4\)"):
        smooth_ranges(np.zeros((7, 4)))
