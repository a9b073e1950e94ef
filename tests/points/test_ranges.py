import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.points import smooth_ranges
from steelnb.points.ranges import GATE_SIGMAS, SIGMA_M, SIGMA_SHARE


def directions(rows, columns):
    y, z = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(0.3, -0.3, rows))
    ray = np.stack([np.ones_like(y), y, z], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1)[..., None]


def naive_sigma_filter(points, radius):
    distance = np.linalg.norm(points, axis=-1)
    smooth = points.copy()
    for i, j in np.argwhere((distance > 0) & (distance < np.inf)):
        near = distance[max(i - radius, 0) : i + radius + 1, max(j - radius, 0) : j + radius + 1]
        alike = near[np.abs(near - distance[i, j]) <= GATE_SIGMAS * max(SIGMA_M, SIGMA_SHARE * distance[i, j])]
        smooth[i, j] *= alike.mean() / distance[i, j]
    return smooth


@pytest.mark.kernels
@pytest.mark.parametrize("radius", [0, 1, 2])
def test_smooth_ranges_equals_its_slow_twin(radius):
    rng = np.random.default_rng(3)
    distance = rng.choice([1.0, 1.02, 1.07, 3.0, 3.1, np.nan], (12, 17)) + 0.005 * rng.normal(size=(12, 17))
    points = distance[..., None] * directions(12, 17)
    points[3, 5:7], points[8, 2] = np.inf, 0.0
    np.testing.assert_allclose(smooth_ranges(points, radius), naive_sigma_filter(points, radius), atol=1e-12)


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


def test_an_unorganised_cloud_is_returned_unchanged():
    points = directions(5, 5).reshape(-1, 3)
    assert smooth_ranges(points) is points
    with pytest.raises(InputError, match=r"\(7, 4\)"):
        smooth_ranges(np.zeros((7, 4)))
