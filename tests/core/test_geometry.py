import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core import geometry


@pytest.fixture(params=range(3))
def rng(request):
    return np.random.default_rng(request.param)


def random_poses(rng: np.random.Generator, count: int = 1) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    T[:, :3, 3] = rng.normal(scale=10.0, size=(count, 3))
    return T


def test_points_return_by_the_inverse(rng):
    T, points = random_poses(rng, 4), rng.normal(size=(20, 3))
    for pose, inverse in zip(T, geometry.inverse_poses(T), strict=True):
        moved = geometry.transform_points(pose, points)
        homogeneous = np.column_stack([points, np.ones(20)]) @ pose.T
        np.testing.assert_allclose(moved, homogeneous[:, :3], atol=1e-12)
        np.testing.assert_allclose(geometry.transform_points(inverse, moved), points, atol=1e-12)


def test_a_twist_keeps_its_rotation_vector_and_moves_its_centre_by_its_translation(rng):
    centre, xi = rng.normal(scale=10.0, size=3), rng.uniform(-1.0, 1.0, 6)
    T = geometry.exp_about(centre, xi)
    np.testing.assert_allclose(geometry.rotation_between(np.eye(3), T[:3, :3]), xi[:3], atol=1e-12)
    np.testing.assert_allclose(geometry.transform_points(T, centre[None])[0], centre + xi[3:], atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1e-3, 0.1, 3.0, 10.0])
def test_the_rotation_of_a_twist_has_the_bits_of_scipy(rng, size):
    for xi in size * rng.normal(size=(200, 6)):
        rotation = geometry.exp_about(np.zeros(3), xi)[:3, :3]
        assert (rotation == Rotation.from_rotvec(xi[:3]).as_matrix()).all()


def test_the_step_of_a_pose_is_a_twist_about_its_position_and_the_difference_undoes_it(rng):
    T, step = random_poses(rng, 3), rng.uniform(-1.0, 1.0, (3, 6))
    moved = geometry.moved_poses(T, step)
    for before, after, xi in zip(T, moved, step, strict=True):
        np.testing.assert_allclose(after, geometry.exp_about(before[:3, 3], xi) @ before, atol=1e-12)
        np.testing.assert_allclose(geometry.pose_difference(before, after), xi, atol=1e-12)


@pytest.mark.parametrize("size", [geometry.UPRIGHT_DOF, geometry.POSE_DOF])
def test_the_first_order_step_errs_by_the_square_of_the_angles(rng, size):
    T, step = random_poses(rng), 1e-4 * rng.normal(size=(1, size))
    found = geometry.pose_step(T[0], geometry.moved_poses(T, step)[0], size)
    np.testing.assert_allclose(found, step[0], atol=1e-7)
    assert not np.allclose(found, 0.0, atol=1e-6)


def test_yaw_and_tilt_are_those_of_the_factors_of_a_rotation(rng):
    yaw, tilt = rng.uniform(-3.0, 3.0, 4), 1e-4 * rng.normal(size=(4, 2))
    turned = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    rotation = (turned * Rotation.from_rotvec(np.column_stack([tilt, np.zeros(4)]))).as_matrix()
    np.testing.assert_allclose(geometry.yaw_of(rotation), yaw, atol=1e-7)
    np.testing.assert_allclose(geometry.tilt_of(rotation), tilt, atol=1e-7)


def test_jacobian_of_a_twist_agrees_with_differences(rng):
    T, centre = random_poses(rng)[0], rng.normal(scale=5.0, size=3)
    jacobian = geometry.twist_jacobian(T[:3, 3] - centre)
    for column, xi in zip(jacobian.T, 1e-6 * np.eye(6), strict=True):
        ahead, behind = (geometry.pose_difference(T, geometry.exp_about(centre, s * xi) @ T) for s in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-6, column, atol=1e-6)


def test_information_about_another_point_gives_the_same_cost_to_the_same_twist(rng):
    root, arm, xi = rng.normal(size=(6, 6)), rng.normal(size=3), rng.normal(size=6)
    information, moved = root @ root.T, geometry.twist_jacobian(arm) @ xi  # the twist, seen at the other point
    assert moved @ geometry.information_at(information, arm) @ moved == pytest.approx(xi @ information @ xi)
    np.testing.assert_allclose(geometry.cross_matrix(arm) @ xi[:3], np.cross(arm, xi[:3]), atol=1e-15)
