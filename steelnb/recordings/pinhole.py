"""Depth images → points, and the two conventions of a camera's axes.

Cameras look along z, with x right and y down; the sensor frame here is the drone's: x forward, y left, z up.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.recordings.choice import Intrinsics

T_OPTICAL_SENSOR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""From x forward, y left, z up to z forward, x right, y down."""


def depth_points(depth_m: NDArray, camera: Intrinsics) -> Array:
    """Points ``(H, W, 3)`` in the sensor frame from depths ``(H, W)`` along the optical axis, in metres.

    Depths that are not finite or not positive are NaN.
    """
    depth = np.asarray(depth_m, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
    left, up = _rays(depth.shape[0], depth.shape[1], camera.fx, camera.fy, camera.cx, camera.cy)
    points = np.empty((*depth.shape, 3))
    points[..., 0] = depth
    np.multiply(depth, left, out=points[..., 1])
    np.multiply(depth, up[:, None], out=points[..., 2])
    return points


def from_optical(points: Array) -> Array:
    """Points ``(..., 3)`` of an optical frame in the sensor frame: x forward, y left, z up."""
    return np.stack([points[..., 2], -points[..., 0], -points[..., 1]], axis=-1)


@lru_cache(maxsize=4)
def _rays(rows: int, columns: int, fx: float, fy: float, cx: float, cy: float) -> tuple[Array, Array]:
    return np.asarray((cx - np.arange(columns)) / fx), np.asarray((cy - np.arange(rows)) / fy)
