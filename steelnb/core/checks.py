"""Checks of input clouds and poses, shared by `register` and every odometry."""

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array

RIGID_TOLERANCE = 1e-3
"""Largest deviation of RᵀR from the identity. Rounding to single precision or to text stays below it."""


def checked_cloud(points: object, name: str = "points") -> Array:
    """A cloud ``(N, 3)`` or image ``(H, W, 3)``, metres, as float64 of the same shape; masked entries become NaN.

    Raises `InputError` for any other shape and for values that are not real numbers.
    """
    if isinstance(points, np.ma.MaskedArray):
        points = np.ma.filled(points.astype(np.float64), np.nan)
    try:
        array = np.asarray(points)
        if array.dtype.kind not in "fiu":
            raise TypeError
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        kind = getattr(points, "dtype", type(points).__name__)
        raise InputError(f"{name}: {kind}; expected real numbers in an array (N, 3) or (H, W, 3)") from None
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise InputError(f"{name}: an array of shape {array.shape}; expected (N, 3) or (H, W, 3), metres")
    return array


def checked_pose(T: object, name: str) -> Array:
    """A rigid transform ``(4, 4)`` as float64. Raises `InputError` if it is not one."""
    try:
        array = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {T!r}: expected a finite (4, 4) array") from None
    if array.shape != (4, 4):
        raise InputError(f"{name}: an array of shape {array.shape}; expected a rigid transform (4, 4)")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: an entry is not finite; expected a rigid transform (4, 4)")
    R = array[:3, :3]
    if np.abs(array[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise InputError(f"{name}: last row {array[3].tolist()}; expected 0, 0, 0, 1")
    if np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE:
        length = np.linalg.norm(R, axis=0).round(4).tolist()
        raise InputError(f"{name}: axes of length {length}, not orthonormal; expected a rotation, no scale or shear")
    if np.linalg.det(R) < 0:
        raise InputError(f"{name}: a reflection (determinant {np.linalg.det(R):.3f}); expected a right-handed frame")
    return array
