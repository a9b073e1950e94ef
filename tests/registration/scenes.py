"""Clouds and poses shared by the tests of registration."""

import numpy as np
from scipy.spatial.transform import Rotation


def corner(n, seed, noise_m=0.0):
    """Points on three walls of a corner, a ball and a bar, about 4 m wide. They constrain all six directions."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 4, (2, n))
    zero = np.zeros(n)
    walls = np.stack([np.stack([u, v, zero], 1), np.stack([u, zero, v], 1), np.stack([zero, u, v], 1)])
    points = walls[rng.integers(0, 3, n), np.arange(n)]
    ball = rng.normal(size=(n // 5, 3))
    points[: n // 5] = [2.5, 2.0, 1.5] + 0.7 * ball / np.linalg.norm(ball, axis=1)[:, None]
    bar = rng.uniform(0, 2 * np.pi, n // 10)
    points[n // 5 : n // 5 + n // 10] = np.stack(
        [1 + 0.1 * np.cos(bar), 3 + 0.1 * np.sin(bar), rng.uniform(0.2, 3, len(bar))], axis=1
    )
    return points + noise_m * rng.normal(size=(n, 3))


def motion(turn_deg, shift_m, dof="se3", seed=0):
    """Rigid motion by an angle and a length, restricted to the degrees of freedom."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    axis = {"se3": axis, "xyz_yaw": np.array([0, 0, 1.0]), "xyz": np.zeros(3)}[dof]
    axis = axis / (np.linalg.norm(axis) or 1)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    T[:3, 3] = shift_m * shift / np.linalg.norm(shift)
    return T


def transformed(points, T):
    return points @ T[:3, :3].T + T[:3, 3]


def pose_error(T_one, T_two, centre=(2, 2, 2)):
    """(distance of the centre of the scene in metres, angle in degrees) between two poses."""
    centre = np.append(centre, 1)
    turn = Rotation.from_matrix(T_one[:3, :3].T @ T_two[:3, :3]).magnitude()
    return np.linalg.norm((np.linalg.inv(T_one) @ centre - np.linalg.inv(T_two) @ centre)[:3]), np.degrees(turn)
