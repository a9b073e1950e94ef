"""Poses with four or six degrees of freedom, and the model of a drifting prior.

The step of a pose is a rotation about the world's x, y and z axes through its own position, radians, and then a shift,
metres: six numbers in the order of a twist. Four degrees of freedom are the last four of them: yaw, x, y, z.

The prior drifts in position and yaw as a random walk does. Its roll and pitch are exact; or they have errors, a
first-order Gauss-Markov process, as those of an attitude filter.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.types import Array

POSE = 4
"""Degrees of freedom of a pose whose roll and pitch are the prior's: yaw, x, y, z."""
DRIFT_SIGMA = np.array([0.002, 0.01, 0.01, 0.01])
"""Standard deviation of an increment of the drift of yaw, x, y and z in `DRIFT_PERIOD_S`, radians and metres."""
DRIFT_PERIOD_S = 0.2
TILT_S = 10.0
"""Correlation time of the errors of the prior's roll and pitch: that of attitude filters is seconds to a minute."""
TILT_SIGMA_RAD = 0.0175
"""Standard deviation of the prior's roll and pitch beside an IMU, 1°, if none is stated: most priors have theirs from a
filter on its readings."""
FIXED = 1e12
"""Information that holds a pose where it is."""


def pose_size(tilt_sigma_rad: float) -> int:
    """The degrees of freedom of a pose where the prior's roll and pitch have this standard deviation."""
    return POSE + 2 * (tilt_sigma_rad > 0)


def drift_variance(passed_s: Array | float) -> Array:
    """Variance ``(…, 4)`` of the drift of yaw, x, y and z in times ``passed_s (…)``: it grows with the time."""
    return np.asarray(passed_s)[..., None] / DRIFT_PERIOD_S * DRIFT_SIGMA**2


def tilt_decay(passed_s: Array | float) -> Array:
    """The factor ``(…)`` by which an error of the prior's roll or pitch decays in times ``passed_s (…)``; in twice the
    time, that of its variance."""
    return np.exp(-np.asarray(passed_s) / TILT_S)


def moved_poses(T: Array, step: Array) -> Array:
    """Poses ``(K, 4, 4)`` after steps ``(K, D)``, D = 4 or 6."""
    result, rotation = T.copy(), np.zeros((len(T), 3))
    rotation[:, 6 - step.shape[1] :] = step[:, :-3]
    result[:, :3, 3] += step[:, -3:]
    result[:, :3, :3] = Rotation.from_rotvec(rotation).as_matrix() @ T[:, :3, :3]
    return result


def pose_step(T_from: Array, T_to: Array, size: int = POSE) -> Array:
    """The step ``(size,)`` from one pose to another: the inverse of `moved_poses` up to products of its angles."""
    rotation = T_to[:3, :3] @ T_from[:3, :3].T
    return np.concatenate([tilt_of(rotation), yaw_of(rotation)[None], T_to[:3, 3] - T_from[:3, 3]])[-size:]


def yaw_of(rotation: Array) -> Array:
    """The angle about z, radians, that is nearest to each rotation ``(…, 3, 3)``."""
    first, second = rotation[..., 0, :], rotation[..., 1, :]
    return np.arctan2(second[..., 0] - first[..., 1], first[..., 0] + second[..., 1])


def tilt_of(rotation: Array) -> Array:
    """The turns about x and y, radians, of rotations ``(…, 3, 3)`` that tilt the vertical by a small angle; ``(…, 2)``,
    whatever their yaw."""
    return np.stack([rotation[..., 2, 1], -rotation[..., 2, 0]], axis=-1)
