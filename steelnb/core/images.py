"""Grey-value images of a camera on a flight, with its calibration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.core import checks

GreyImage = NDArray[np.uint8]
"""``(H, W)``, 0 black to 255 white."""


@dataclass(frozen=True, eq=False)
class CameraImages:
    """N grey-value images, each rendered or read on access.

    ``stamp_s (N,)``: middles of the exposures, strictly increasing; ``images``: N arrays ``(H, W)``, None for an
    unreadable one; ``K (3, 3)``: intrinsics in OpenCV's pixel coordinates (origin at the centre of the first pixel, u
    right, v down); ``T_drone_camera (4, 4)``: the mount. The camera frame has x along the optical axis, y left and z
    up, so a point (x, y, z) projects to ``K @ (−y, −z, x)``, up to scale.
    """

    stamp_s: NDArray[np.float64]
    images: Sequence[GreyImage | None]
    K: NDArray[np.float64]
    T_drone_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        checks.set_checked(
            self,
            stamp_s=checks.checked_stamps(self.stamp_s, "CameraImages.stamp_s"),
            K=checks.checked_array(self.K, "CameraImages.K", (3, 3)),
            T_drone_camera=checks.checked_pose(self.T_drone_camera, "CameraImages.T_drone_camera"),
        )

    def __len__(self) -> int:
        return len(self.stamp_s)

    def at(self, stamp_s: float) -> int | None:
        """Index of the last image at or before ``stamp_s``; None if it is older than half the image period."""
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
    """Points ``(N, 3)`` in the camera frame at depth x = 1 that project to pixels ``(N, 2)``."""
    right, down = (pixels[:, axis] - K[axis, 2] for axis in (0, 1))
    return np.column_stack([np.ones(len(pixels)), -right / K[0, 0], -down / K[1, 1]])
