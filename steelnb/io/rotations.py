"""Rotation matrices in tables → quaternions, and the order of quaternions."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array

ROTATION_TOLERANCE = 1e-2
"""Maximum error of rotation matrices, beyond which the numbers are something else."""
UPRIGHT, UPRIGHT_SHARE = 0.7, 0.9
"""Minimum cosine between the vertical and the z axis of what stands upright, and share of the poses that have it, by
which a drone does."""
LEVEL = 0.2
"""Maximum sine between the horizontal and an axis that is level, as one across the image is; drones bank by more, but
seldom longer."""


def xyzw_of(rows: Array, columns: int) -> Array | None:
    """Quaternions ``(N, 4)`` of the rotations in matrices of three rows and 3 or 4 ``columns``, ``rows (N, 9 or 12)``,
    NaN where these are; None if they are no rotations."""
    R, xyzw = rows.reshape(-1, 3, columns)[:, :, :3], np.full((len(rows), 4), np.nan)
    R = R[is_finite := np.isfinite(R).all(axis=(1, 2))]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > ROTATION_TOLERANCE or (np.linalg.det(R) < 0).any():
        return None
    xyzw[is_finite] = Rotation.from_matrix(R).as_quat()
    return xyzw


def heights_of_z(quaternions: Array) -> tuple[Array, Array]:
    """Cosine ``(N,)`` between the vertical and the z axis of rotations, if ``quaternions (N, 4)`` are x, y, z, w, and
    if they are w, x, y, z."""
    as_xyzw, as_wxyz = (Rotation.from_quat(q).as_matrix()[:, 2, 2] for q in (quaternions, quaternions[:, [1, 2, 3, 0]]))
    return as_xyzw, as_wxyz


def w_is_first(quaternions: Array) -> bool | None:
    """Whether a drone with ``quaternions (N, 4)`` is upright if they are w, x, y, z, and in no usual attitude if they
    are x, y, z, w: neither upright nor upside down, as with z down, nor with z level, as of a camera. None if it is
    upright in both orders."""
    q = quaternions[np.isfinite(quaternions).all(axis=1) & quaternions.any(axis=1)]
    if not len(q):
        return False
    as_xyzw, as_wxyz = heights_of_z(q)
    if (as_wxyz > UPRIGHT).mean() <= UPRIGHT_SHARE:
        return False
    if (as_xyzw > UPRIGHT).mean() > UPRIGHT_SHARE:
        return None
    return not ((as_xyzw < -UPRIGHT).mean() > UPRIGHT_SHARE or np.median(np.abs(as_xyzw)) < LEVEL)
