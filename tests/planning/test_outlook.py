import numpy as np

from steelnb.planning.outlook import ARM_M, STEP, Camera, around, outlook
from steelnb.settings import TofSettings

TOF = TofSettings.preset("starling2")
CAMERA = Camera(
    float(np.tan(TOF.fov_horizontal_rad / 2)), float(np.tan(TOF.fov_vertical_rad / 2)), TOF.rows * TOF.columns,
    TOF.range_max_m, TOF.sigma_floor_m, TOF.sigma_relative, TOF.T_drone_sensor,
)  # fmt: skip


def wall(distance_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Voxels of a wall across the x axis, and their normals."""
    y, z = np.meshgrid(np.arange(-10, 10, 0.1), np.arange(-10, 10, 0.1))
    points = np.column_stack([np.full(y.size, distance_m), y.ravel(), z.ravel()])
    return points, np.tile([1.0, 0.0, 0.0], (len(points), 1))


def test_before_a_wall_all_pixels_return_but_those_that_fade_out():
    returns = outlook(*wall(2.0), 0.01, np.eye(4)[None], CAMERA).returns[0]
    assert 0.75 * CAMERA.pixels < returns < CAMERA.pixels


def test_along_a_wall_nothing_is_told_and_beyond_the_range_nothing_is_seen():
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = -10.0
    seen = outlook(*wall(2.0), 0.01, poses, CAMERA)
    assert seen.sigma[0] > 1e3 * np.sqrt(1 / np.linalg.eigvalsh(seen.information[0])[-1])
    assert seen.returns[1] == 0
    assert seen.sigma[1] == np.inf


def test_the_information_is_that_of_ranges_by_differences():
    # One voxel, whose range along its own ray changes by n · step / n · d.
    point, normal = np.array([[2.0, 0.4, -0.3]]), np.array([[0.8, 0.6, 0.0]])
    T = np.eye(4)
    seen = outlook(point, normal, 0.01, T[None], CAMERA)
    centre = T[:3, 3] + CAMERA.T_drone_sensor[:3, 3]
    ray = (point[0] - centre) / np.linalg.norm(point[0] - centre)

    def range_m(pose: np.ndarray) -> float:
        """Of the pixel that sees the voxel now, from another pose."""
        turned, origin = pose[:3, :3] @ ray, pose[:3, :3] @ CAMERA.T_drone_sensor[:3, 3] + pose[:3, 3]
        return float(normal[0] @ (point[0] - origin) / (normal[0] @ turned))

    gradient = []
    for axis in range(4):
        pose = np.eye(4)
        if axis < 3:
            pose[axis, 3] = 1e-6
        else:
            c, s = np.cos(1e-6 / ARM_M), np.sin(1e-6 / ARM_M)
            pose[:2, :2] = [[c, -s], [s, c]]
        gradient.append((range_m(pose) - range_m(T)) / 1e-6)
    expected = seen.returns[0] * np.outer(gradient, gradient) / (0.01 * np.linalg.norm(point[0] - centre)) ** 2
    np.testing.assert_allclose(seen.information[0], expected, rtol=2e-2, atol=1e-2 * np.abs(expected).max())


def test_the_poses_around_one_are_a_step_apart_along_each_axis():
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    poses = around(T)
    np.testing.assert_allclose(poses[1:4, :3, 3] - T[:3, 3], np.diag(STEP[:3]))
    np.testing.assert_allclose(poses[4, :2, 0], [np.cos(STEP[3] / ARM_M), np.sin(STEP[3] / ARM_M)])
