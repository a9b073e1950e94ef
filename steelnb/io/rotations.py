"""Rotation matrices in tables → quaternions, and the order of quaternions."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array

ROTATION_TOLERANCE = 1e-2
"""Maximum error of rotation matrices, beyond which the numbers are something else."""
UPRIGHT, UPRIGHT_SHARE, LEVEL = 0.7, 0.9, 0.2
"""Minimum height of a drone's z axis, and share of the poses that have it, by which it is upright; and maximum height,
in the median, of a sensor's z axis that is level."""


def xyzw_of(rows: Array, columns: int) -> Array | None:
    """Quaternions ``(N, 4)`` of the rotations in matrices of three rows and 3 or 4 ``columns``, ``rows (N, 9 or 12)``,
    NaN if these are; None if they are no rotations."""
    R, xyzw = rows.reshape(-1, 3, columns)[:, :, :3], np.full((len(rows), 4), np.nan)
    R = R[is_finite := np.isfinite(R).all(axis=(1, 2))]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > ROTATION_TOLERANCE or (np.linalg.det(R) < 0).any():
        return None
    xyzw[is_finite] = Rotation.from_matrix(R).as_quat()
    return xyzw


def w_is_first(quaternions: Array) -> bool | None:
    """Whether a drone with ``quaternions (N, 4)`` is upright if they are w, x, y, z, and in no usual attitude if they
    are x, y, z, w: neither upright nor upside down, as with z down, nor with z level, as of a camera. None if it is
    upright in both orders."""
    q = quaternions[np.isfinite(quaternions).all(axis=1) & quaternions.any(axis=1)]
    if not len(q):
        return False
    as_read, turned = (Rotation.from_quat(each).as_matrix()[:, 2, 2] for each in (q, q[:, [1, 2, 3, 0]]))
    if (turned > UPRIGHT).mean() <= UPRIGHT_SHARE:
        return False
    if (as_read > UPRIGHT).mean() > UPRIGHT_SHARE:
        return None
    return not ((as_read < -UPRIGHT).mean() > UPRIGHT_SHARE or np.median(np.abs(as_read)) < LEVEL)
