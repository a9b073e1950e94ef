"""Algebra of rigid motions: the one home of rotation steps, twists and changes of frame.

A twist ξ = (ω, v) is a rotation vector, radians, and a translation, metres, both in the axes of the target frame:
rotate by ω about a centre, then translate by v. The step of a pose is a twist about the pose's own position. With four
degrees of freedom it is the last four numbers: yaw, x, y, z. Source: Solà, Deray, Atchuthan, "A micro Lie theory for
state estimation in robotics" (arXiv 1812.01537, 2018).
"""

import math

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray

UPRIGHT_DOF, POSE_DOF = 4, 6
"""Degrees of freedom of a pose whose roll and pitch are known (yaw, x, y, z), and of a free pose."""


def transform_points(T_target_source: Array, points: Array) -> Array:
    """Points ``(..., 3)`` of the source frame, in the target frame."""
    return np.asarray(points @ T_target_source[:3, :3].T + T_target_source[:3, 3])


def inverse_poses(T: Array) -> Array:
    """Inverses of transforms ``(N, 4, 4)``."""
    result = np.tile(np.eye(4), (len(T), 1, 1))
    result[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, 3:] = -result[:, :3, :3] @ T[:, :3, 3:]
    return result


def exp_about(centre: Array, xi: Array) -> Array:
    """Rigid motion ``(4, 4)`` of a twist ``(ω, v)``: rotate by ω about ``centre (3,)``, then translate by v."""
    motion = np.eye(4)
    _write_rotation(xi[0], xi[1], xi[2], motion)
    motion[:3, 3] = centre - motion[:3, :3] @ centre + xi[3:]
    return motion


@njit(cache=True)
def _write_rotation(x, y, z, motion):  # type: ignore[no-untyped-def]
    """Write the matrix of a rotation vector to ``motion[:3, :3]``. Its formulas and its bits are those of
    `scipy.spatial.transform.Rotation`, whose call took four fifths of the time of `exp_about`."""
    angle = math.sqrt(x * x + y * y + z * z)
    scale = 0.5 - angle**2 / 48 + angle**2 * angle**2 / 3840 if angle <= 1e-3 else math.sin(angle / 2) / angle
    x, y, z, w = scale * x, scale * y, scale * z, math.cos(angle / 2)
    motion[0, 0], motion[0, 1], motion[0, 2] = x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)
    motion[1, 0], motion[1, 1], motion[1, 2] = 2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)
    motion[2, 0], motion[2, 1], motion[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w


def moved_poses(T: Array, step: Array) -> Array:
    """Poses ``(K, 4, 4)`` after steps ``(K, D)``, D = 4 or 6."""
    result, rotation = T.copy(), np.zeros((len(T), 3))
    rotation[:, 6 - step.shape[1] :] = step[:, :-3]
    result[:, :3, 3] += step[:, -3:]
    result[:, :3, :3] = Rotation.from_rotvec(rotation).as_matrix() @ T[:, :3, :3]
    return result


def pose_step(T_from: Array, T_to: Array, size: int = UPRIGHT_DOF) -> Array:
    """The step ``(size,)`` between two poses: the inverse of `moved_poses` to first order in its angles."""
    rotation = T_to[:3, :3] @ T_from[:3, :3].T
    return np.concatenate([tilt_of(rotation), yaw_of(rotation)[None], T_to[:3, 3] - T_from[:3, 3]])[-size:]


def pose_difference(T_from: Array, T_to: Array) -> Array:
    """The step ``(6,)`` between two poses: the inverse of `moved_poses`, at any angle."""
    return np.append(rotation_between(T_from[:3, :3], T_to[:3, :3]), T_to[:3, 3] - T_from[:3, 3])


def rotation_between(R_from: Array, R_to: Array) -> Array:
    """Rotation vector ``(3,)``, radians, in the target frame of both rotations ``(3, 3)``, that takes one to the
    other."""
    return np.asarray(Rotation.from_matrix(R_to @ R_from.T, assume_valid=True).as_rotvec())


def yaw_of(rotation: Array) -> Array:
    """The yaw ``(…)``, radians, of the rotation about z nearest to each rotation ``(…, 3, 3)``."""
    first, second = rotation[..., 0, :], rotation[..., 1, :]
    return np.arctan2(second[..., 0] - first[..., 1], first[..., 0] + second[..., 1])


def tilt_of(rotation: Array) -> Array:
    """The rotations about x and y ``(…, 2)``, radians, of rotations ``(…, 3, 3)``: a small tilt, then any yaw."""
    return np.stack([rotation[..., 2, 1], -rotation[..., 2, 0]], axis=-1)


def cross_matrix(v: Array) -> Array:
    """The matrix ``(3, 3)`` of the product ``v × …``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def twist_jacobian(arm: Array) -> Array:
    """Derivative ``(6, 6)`` of the rotation and shift of a point at ``arm (3,)`` from the centre of a twist."""
    by_twist = np.eye(6)
    by_twist[3:, :3] = -cross_matrix(arm)
    return by_twist


def information_at(information: Array, arm: Array) -> Array:
    """Convert information ``(6, 6)`` about the rotation and the shift of one point to that of another point, which is
    offset from it by ``arm (3,)``."""
    by_twist = twist_jacobian(-arm)
    return np.asarray(by_twist.T @ information @ by_twist)


def points_along(start: Array, end: Array, spacing_m: float) -> tuple[Array, IntArray]:
    """Points ``(N, 3)`` about ``spacing_m`` apart on segments from ``start (M, 3)`` to ``end (M, 3)``, ends included,
    and the segment of each point ``(N,)``."""
    count = [max(2, int(length / spacing_m) + 1) for length in np.linalg.norm(end - start, axis=1)]
    share = [np.linspace(0, 1, each)[:, None] for each in count]
    points = [a + each * (b - a) for a, b, each in zip(start, end, share, strict=True)]
    return np.concatenate([np.zeros((0, 3)), *points]), np.repeat(np.arange(len(count)), count)


def connected(pairs: IntArray, count: int) -> IntArray:
    """Number of the group of each of ``count`` things ``(N,)``, of which ``pairs (P, 2)`` belong together."""
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
