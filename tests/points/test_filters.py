import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.types import Scan
from steelnb.points import preprocess_scan, voxel_grid
from steelnb.points.filters import crop
from steelnb.settings import PreprocessSettings
from tests import naive

BOX = np.zeros(3), np.ones(3), np.array([0.0, 0.0, 1.0])


@pytest.mark.kernels
def test_crop_keeps_points_on_the_bounds_and_drops_invalid_returns():
    invalid = 0.5 * np.ones((3, 3)) + np.diag([np.nan, np.inf, -np.inf])
    points = np.array([[0, 0, 0], [1, 1, 1], [1, 1, 1.0001], [-0.0001, 0, 0], [1, 1, 0.5], *invalid])
    np.testing.assert_array_equal(crop(points, np.eye(4), *BOX, 0.0, 0.0), points[[0, 1, 4]])
    np.testing.assert_array_equal(crop(points, np.eye(4), *BOX, 0.25, 0.75), points[[1, 4]])


@pytest.mark.kernels
def test_a_scan_is_cropped_in_the_drone_frame_and_cut_at_the_floor_of_the_world():
    rng = np.random.default_rng(5)
    points = rng.uniform(-2, 2, (500, 3))
    T_drone_sensor, T_world_drone = np.eye(4), np.eye(4)
    T_drone_sensor[:3, :3], T_world_drone[:3, :3] = Rotation.random(2, random_state=6).as_matrix()
    T_drone_sensor[:3, 3], T_world_drone[:3, 3] = rng.normal(size=(2, 3))
    drone = points @ T_drone_sensor[:3, :3].T + T_drone_sensor[:3, 3]
    world = drone @ T_world_drone[:3, :3].T + T_world_drone[:3, 3]
    expected = drone[(np.abs(drone) <= 1).all(axis=1) & (world[:, 2] >= 0.2)]
    one_a_voxel = PreprocessSettings(crop_m=1.0, floor_m=0.2, voxel_leaf_m=1e-4)
    result = preprocess_scan(Scan(0.0, points.reshape(20, 25, 3)), T_world_drone, T_drone_sensor, one_a_voxel)
    assert 10 < len(expected) < 400
    np.testing.assert_allclose(result, expected[np.lexsort(np.floor(expected / 1e-4).T[::-1])], atol=1e-12)


@pytest.mark.parametrize("leaf_m", [0.05, 0.3, 10.0])
def test_voxel_grid_equals_its_slow_twin(leaf_m):
    points = np.random.default_rng(3).uniform(-1, 1, (400, 3))
    np.testing.assert_allclose(voxel_grid(points, leaf_m), naive.voxel_grid(points, leaf_m), atol=1e-12)


@pytest.mark.parametrize("leaf_m", [0.0, 1e-7])
def test_voxel_grid_refuses_a_leaf_that_is_not_positive_or_far_too_small(leaf_m):
    with pytest.raises(InputError, match="leaf_m"):
        voxel_grid(np.array([[0.0, 0, 0], [1, 1, 1]]), leaf_m)
