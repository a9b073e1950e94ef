"""Learned odometry: a small convolutional network estimates the translation between two range images.

After Wang, Clark, Wen and Trigoni, "DeepVO: Towards end-to-end visual odometry with deep recurrent convolutional neural
networks" (ICRA 2017), for range images instead of colour, and without its recurrent part.
"""

from pathlib import Path

import numpy as np

from steelnb.core.types import Array, Scan
from steelnb.odometry.base import BaseOdometry, Outcome, Stopwatch
from steelnb.odometry.deepvo.network import Network, read_network
from steelnb.settings import DeepVoSettings, OdometrySettings
from steelnb.settings.presets import PRESETS

COLUMNS, ROWS = 48, 64
TAN_HALF_WIDTH, TAN_HALF_HEIGHT = 0.9325, 1.327
"""Size of a derotated image, and tangents of half its fields of view, as for a Starling 2's sensor."""
COVERAGE_MIN = 0.01
"""Minimum share of pixels with returns; scans with fewer are skipped."""
GAP_MAX_S = 0.65
"""Maximum time between the scans of a pair. In training, it was up to three periods of 0.2 s."""
UNIT_M = 0.1
"""Unit of length of the network's output."""
MIRROR = np.array([1.0, -1.0, 1.0])
"""Signs of the translation between mirrored images."""


def derotated(points: Array, R_level_sensor: Array) -> np.ndarray:
    """Range image ``(2, ROWS, COLUMNS)`` float32 as seen by a levelled camera: the share of each pixel that has
    returns, and this share times their mean inverse range, 1/m.

    ``points (N, 3)`` or ``(H, W, 3)``, sensor frame, metres, NaN for no return. Each point is distributed over the four
    pixels around it with bilinear weights, which preserves sub-pixel edges.
    """
    count = points.size // 3 if points.ndim == 3 else 240 * 180
    points = points.reshape(-1, 3)
    x, y, z = (points[np.isfinite(points[:, 0])] @ R_level_sensor.T).T
    ahead = x > 0.05
    x, y, z = x[ahead], y[ahead], z[ahead]
    column, row = (1 - y / x / TAN_HALF_WIDTH) * (COLUMNS / 2) - 0.5, (1 - z / x / TAN_HALF_HEIGHT) * (ROWS / 2) - 0.5
    inside = (column > -1) & (column < COLUMNS) & (row > -1) & (row < ROWS)
    column, row = column[inside], row[inside]
    inverse = 1 / np.sqrt(x[inside] ** 2 + y[inside] ** 2 + z[inside] ** 2)
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    right, down = column - left, row - top
    width = COLUMNS + 2
    cell = (top + 1) * width + left + 1
    image = np.zeros((2, (ROWS + 2) * width))
    for by_row, share_row in ((0, 1 - down), (1, down)):
        for by_column, share_column in ((0, 1 - right), (1, right)):
            weight, at = share_row * share_column, cell + by_row * width + by_column
            image[0] += np.bincount(at, weight, image.shape[1])
            image[1] += np.bincount(at, weight * inverse, image.shape[1])
    image *= ROWS * COLUMNS / max(count, 1)
    return image.reshape(2, ROWS + 2, width)[:, 1:-1, 1:-1].astype(np.float32)


def level_pair(points: tuple[Array, Array], R_world_sensor: tuple[Array, Array]) -> tuple[np.ndarray, Array]:
    """Derotated images ``(4, ROWS, COLUMNS)`` of two scans with the attitudes ``R_world_sensor``, each ``(3, 3)``, as
    seen by a levelled camera with the mean of their headings; and that camera's attitude ``R_world_level (3, 3)``."""
    ahead = R_world_sensor[0][:2, 0] + R_world_sensor[1][:2, 0]
    c, s = ahead / max(float(np.hypot(*ahead)), 1e-9)
    R_world_level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    images = [derotated(p, R_world_level.T @ R) for p, R in zip(points, R_world_sensor, strict=True)]
    return np.concatenate(images), R_world_level


def motions(network: Network, images: np.ndarray) -> tuple[Array, Array]:
    """Translations ``(B, 3)`` of the sensor from the first to the second image of pairs ``(B, 4, ROWS, COLUMNS)``,
    ahead, left and up in metres, and their standard deviations ``(B, 3)``.

    They are means of four evaluations: forwards and backwards in time, plain and mirrored. Identical images therefore
    give zero translation, whatever the weights.
    """
    swapped = images[:, [2, 3, 0, 1]]
    output = network(np.concatenate([images, swapped, images[..., ::-1], swapped[..., ::-1]])).reshape(4, -1, 6)
    sign = np.stack([np.ones(3), -np.ones(3), MIRROR, -MIRROR])[:, None]
    translation, log_sigma = (sign * output[..., :3]).mean(axis=0), output[..., 3:].mean(axis=0)
    return UNIT_M * translation, UNIT_M * np.exp(log_sigma.astype(np.float64))


class DeepVoOdometry(BaseOdometry):
    """Integrates the translations that a network estimates from the derotated range images of two scans.

    It uses the prior's first pose and its attitudes, but not its later positions. There is no map, so the errors
    accumulate. The ``matches`` of a step are the pixels with returns in both images. Raises `InputError` for weights
    that cannot be used.
    """

    kind, method = DeepVoSettings, "deepvo"
    stages = "image", "network"
    settings: DeepVoSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        packaged = PRESETS / self.settings.weights
        self.network = read_network(packaged if packaged.is_file() else Path(self.settings.weights))
        self._last: tuple[float, Array, Array] | None = None  # stamp, points and attitude of the last scan with returns
        self._position: Array | None = None  # position of the sensor, world frame

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> Outcome:
        T_world_sensor = prior @ self.T_drone_sensor
        R, lever = T_world_sensor[:3, :3], prior[:3, :3] @ self.T_drone_sensor[:3, 3]
        if self._position is None:
            self._position = T_world_sensor[:3, 3]
        reason, matches, last = "", 0, self._last
        images, R_world_level = level_pair((last[1] if last else scan.points, scan.points), (last[2] if last else R, R))
        watch.lap("image")
        has_returns = images[[0, 2]].reshape(2, -1) > 0.1
        too_few = has_returns[1].mean() < COVERAGE_MIN
        if too_few:
            reason = "too few returns"
        elif last is None:
            reason = "first scan"
        elif abs(scan.stamp_s - last[0]) > GAP_MAX_S:
            reason = f"{abs(scan.stamp_s - last[0]):.2f} s since the last scan with returns"
        else:
            matches = int(np.count_nonzero(has_returns.all(axis=0)))
            (translation,), _ = motions(self.network, images[None])
            self._position = self._position + R_world_level @ translation
        if not too_few:
            self._last = scan.stamp_s, scan.points, R
        T_world_drone = prior.copy()
        T_world_drone[:3, 3] = self._position - lever
        watch.lap("network")
        return T_world_drone, reason, matches, 0
