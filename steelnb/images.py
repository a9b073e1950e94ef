"""Grey images of a camera on a flight, with its calibration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GreyImage = NDArray[np.uint8]
"""``(H, W)``, 0 black to 255 white."""


@dataclass(frozen=True)
class CameraImages:
    """N grey images, each made or read when it is asked for.

    ``stamp_s (N,)``, strictly rising, the middles of the exposures; ``images``: N arrays ``(H, W)``, or None for one of
    a recording that cannot be read; ``K (3, 3)``, intrinsics in OpenCV's pixels, whose origin is the centre of the
    first pixel, u to the right and v down; ``T_drone_camera (4, 4)``: the mount. The camera frame has x along the
    optical axis, y left and z up, so a point (x, y, z) is seen at ``K @ (−y, −z, x)``, up to scale.
    """

    stamp_s: NDArray[np.float64]
    images: Sequence[GreyImage | None]
    K: NDArray[np.float64]
    T_drone_camera: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamp_s)

    def at(self, stamp_s: float) -> int | None:
        """Number of the last image not after ``stamp_s``; None where it is older than half the time between images."""
        if not len(self):
            return None
        half_s = 0.5 * float(np.median(np.diff(self.stamp_s))) if len(self) > 1 else 0.05
        index = int(np.searchsorted(self.stamp_s, stamp_s + 1e-6)) - 1
        return index if index >= 0 and stamp_s - self.stamp_s[index] <= half_s else None


def project(points: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels ``(N, 2)``, u and v, of points ``(N, 3)`` in the camera frame; NaN where x is not positive."""
    x = np.where(points[:, 0] > 0, points[:, 0], np.nan)
    return np.column_stack([K[0, 2] - K[0, 0] * points[:, 1] / x, K[1, 2] - K[1, 1] * points[:, 2] / x])


def unproject(pixels: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(N, 3)`` in the camera frame at depth x = 1 that are seen at pixels ``(N, 2)``."""
    across, down = (pixels[:, axis] - K[axis, 2] for axis in (0, 1))
    return np.column_stack([np.ones(len(pixels)), -across / K[0, 0], -down / K[1, 1]])
