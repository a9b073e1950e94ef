import numpy as np
import pytest

from steelnb.odometry.loam import SMOOTH, loam_features, scan_lines
from steelnb.settings import TofSettings
from steelnb.simulation.raycasting import rays
from tests import naive

pytestmark = pytest.mark.kernels


def camera(columns=61, rows=41):
    """Rays of a camera: of unit length, and with x = 1."""
    ray = rays(TofSettings(columns=columns, rows=rows, fov_horizontal_rad=1.2, fov_vertical_rad=0.9))
    return ray, ray / ray[..., :1]


def stepped_walls(seed, missing):
    """A scan of walls at different depths, with noise and missing returns."""
    noise = np.random.default_rng(seed)
    _, flat = camera(columns=121, rows=6)
    depth = np.repeat(noise.uniform(1.5, 4, (6, 6)), 21, axis=1)[:, :121]
    depth += noise.normal(0, 0.004, depth.shape)
    depth[noise.random(depth.shape) < missing] = np.nan
    return depth[..., None] * flat


@pytest.mark.parametrize("seed", [0, 3, 7])
@pytest.mark.parametrize("limits", [(2, 4), (20, 40)])
def test_edges_and_planes_equal_those_of_the_slow_twin(seed, limits):
    image = stepped_walls(seed, missing=0.003 * seed)
    features, twin = loam_features(image, *limits), naive.loam_features(image, *limits)
    assert len(features.point) == len(twin) > 10
    assert 0 < features.plane.sum() < len(twin)
    np.testing.assert_allclose(features.point, [point for point, _, _ in twin])
    np.testing.assert_array_equal(features.plane, [plane for _, plane, _ in twin])
    np.testing.assert_array_equal(features.rank, [rank for _, _, rank in twin])


def test_the_corner_of_two_walls_is_an_edge_and_the_walls_are_planes():
    _, flat = camera(rows=5)
    corner = flat * (3.0 - np.abs(flat[..., 1:2]))
    features = loam_features(corner, edges=1, planes=4)
    sharpest = features.point[(features.plane == 0) & (features.rank == 0)]
    assert len(sharpest) >= 5
    assert np.abs(sharpest[:, 1]).min() < 0.1  # three pixels
    assert loam_features(3.0 * flat).plane.all()  # a wall alone has no edge
    assert SMOOTH == 5e-3


def test_scan_lines_has_one_row_a_laser_sorted_by_azimuth():
    noise = np.random.default_rng(1)
    elevation = np.radians([-15.0, -13.0, -0.5, 1.2, 15.0])
    azimuth = np.radians(np.arange(-180, 180, 3.0))
    angle = np.stack(np.meshgrid(elevation, azimuth, indexing="ij"), axis=-1).reshape(-1, 2)
    angle[:, 0] += noise.uniform(-2e-4, 2e-4, len(angle))
    distance = noise.uniform(2, 9, len(angle))[:, None]
    points = distance * np.column_stack(
        [np.cos(angle[:, 0]) * np.cos(angle[:, 1]), np.cos(angle[:, 0]) * np.sin(angle[:, 1]), np.sin(angle[:, 0])]
    )
    some = np.vstack([points[noise.permutation(len(points))], np.full((3, 3), np.nan), np.zeros((2, 3))])
    image = scan_lines(some)
    assert image.shape == (5, len(azimuth), 3)
    np.testing.assert_allclose(image.reshape(-1, 3), points)


def test_scan_lines_splits_a_cloud_without_distinct_lasers():
    noise = np.random.default_rng(2)
    points = noise.uniform(-1, 1, (3000, 3))
    image = scan_lines(points)
    returns = image[np.isfinite(image).all(axis=2)]
    assert 50 < len(image) < 1000
    assert sorted(map(tuple, returns)) == sorted(map(tuple, points))
    assert scan_lines(np.full((4, 3), np.nan)).shape == (0, 0, 3)
    assert not len(loam_features(scan_lines(np.zeros((0, 3)))).point)
