"""Poses with four or six degrees of freedom, and what a drifting prior says of them.

The prior drifts in position and yaw as a random walk does. Its roll and pitch are exact; or they have errors, a
first-order Gauss-Markov process, as those of an attitude filter.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.types import Array

POSE = 4
"""Degrees of freedom: x, y, z, yaw, behind which come roll and pitch where they are free."""
AXES = (2, 0, 1)
"""The axes of the world about which yaw, roll and pitch turn a pose."""
DRIFT_SIGMA = np.array([0.01, 0.01, 0.01, 0.002])
"""Standard deviation of an increment of the drift in `DRIFT_PERIOD_S`, metres and radians; it grows with √time."""
DRIFT_PERIOD_S = 0.2
TILT_S = 10.0
"""Correlation time of the errors of the prior's roll and pitch: that of attitude filters is seconds to a minute."""
FIXED = 1e12


def pose_size(tilt_sigma_rad: float) -> int:
    """The degrees of freedom of a pose where the prior's roll and pitch have this standard deviation."""
    return POSE + 2 * (tilt_sigma_rad > 0)


def tilt_stays(passed_s: Array | float) -> Array:
    """The share of an error of the prior's roll or pitch that is left after ``passed_s``; with twice the time, that of
    its variance."""
    return np.exp(-np.asarray(passed_s) / TILT_S)


def moved_poses(T: Array, step: Array) -> Array:
    """Poses ``(K, 4, 4)`` after steps ``(K, D)`` of x, y, z, metres, and yaw, and if D is 6 roll and pitch, about their
    own places, radians."""
    result, turn = T.copy(), np.zeros((len(T), 3))
    turn[:, AXES[: step.shape[1] - 3]] = step[:, 3:]
    result[:, :3, 3] += step[:, :3]
    result[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ T[:, :3, :3]
    return result


def pose_step(T_from: Array, T_to: Array, size: int = POSE) -> Array:
    """The step ``(size,)`` of x, y, z, metres, yaw, and if size is 6 roll and pitch, radians, from one pose to another;
    undone by `moved_poses`, but for products of its turns."""
    turned = T_to[:3, :3] @ T_from[:3, :3].T
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], yaw_of(turned)[None], tilt_of(turned)])[:size]


def yaw_of(rotation: Array) -> Array:
    """The angle about z, radians, that is nearest to each rotation ``(…, 3, 3)``."""
    first, second = rotation[..., 0, :], rotation[..., 1, :]
    return np.arctan2(second[..., 0] - first[..., 1], first[..., 0] + second[..., 1])


def tilt_of(rotation: Array) -> Array:
    """The turns about x and y, radians, of rotations ``(…, 3, 3)`` that tilt the vertical by a small angle; ``(…, 2)``,
    whatever their yaw."""
    return np.stack([rotation[..., 2, 1], -rotation[..., 2, 0]], axis=-1)
