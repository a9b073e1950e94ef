import numpy as np
import pytest

from steelnb.config import PreprocessSettings
from steelnb.datatypes import Scan
from steelnb.preprocess import finite_points, pass_through, preprocess_scan, voxel_grid
from tests import naive


def test_finite_points_drops_every_kind_of_invalid_return():
    image = np.arange(18.0).reshape(2, 3, 3)
    image[0, 1, 2] = np.nan
    image[1, 2, 0] = np.inf
    np.testing.assert_array_equal(finite_points(image), image.reshape(-1, 3)[[0, 2, 3, 4]])


def test_pass_through_includes_its_bounds():
    points = np.array([[0, 0, 0], [1, 1, 1], [1, 1, 1.0001], [-0.0001, 0, 0]])
    np.testing.assert_array_equal(pass_through(points, np.zeros(3), np.ones(3)), points[:2])


@pytest.mark.parametrize("leaf_m", [0.05, 0.3, 10.0])
def test_voxel_grid_is_its_slow_twin(leaf_m):
    points = np.random.default_rng(3).uniform(-1, 1, (400, 3))
    np.testing.assert_allclose(voxel_grid(points, leaf_m), naive.voxel_grid(points, leaf_m), atol=1e-12)


def test_voxel_grid_keeps_far_points_apart_where_the_cubes_cannot_be_counted():
    points = np.array([[0, 0, 0], [1e-7, 0, 0], [1e6, 1e6, 1e6], [-1e6, 1e6, -1e6]])
    result = voxel_grid(points, 1e-6)
    np.testing.assert_allclose(result, naive.voxel_grid(points, 1e-6))
    assert len(result) == 3


def test_voxel_grid_does_not_depend_on_the_order_of_points():
    points = np.random.default_rng(4).normal(size=(500, 3))
    np.testing.assert_allclose(voxel_grid(points, 0.4), voxel_grid(points[::-1], 0.4), atol=1e-12)


@pytest.mark.parametrize("leaf_m", [0.0, -1.0, np.nan])
def test_voxel_grid_refuses_a_leaf_that_is_none(leaf_m):
    with pytest.raises(ValueError, match="leaf_m"):
        voxel_grid(np.zeros((2, 3)), leaf_m)


def test_preprocess_scan_crops_in_the_drone_frame_and_cuts_the_floor_in_the_world():
    # The drone looks along world y, 1 m above the ground; its sensor sits 0.1 m further forward.
    T_world_drone = np.array([[0, -1, 0, 5], [1, 0, 0, 5], [0, 0, 1, 1.0], [0, 0, 0, 1]])
    T_drone_sensor = np.eye(4)
    T_drone_sensor[0, 3] = 0.1
    points = np.array([[1, 0, 0], [1, 0, -0.8], [1.45, 0, 0], [1, 1.6, 0], [np.nan, 0, 0], [-0.2, 0, 0]])
    result = preprocess_scan(Scan(0.0, points), T_world_drone, T_drone_sensor, PreprocessSettings())
    np.testing.assert_allclose(result, [[1.1, 0, 0]])
