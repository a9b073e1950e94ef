"""Learned odometry: the translation between two range images by a small convolutional network.

After Wang, Clark, Wen and Trigoni, "DeepVO: Towards end-to-end visual odometry with deep recurrent convolutional neural
networks" (ICRA 2017), for range images instead of colour, and without its recurrent part.
"""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from steelnb.odometry.base import Odometry, scan_of, settings_of
from steelnb.odometry.network import Network, read_network
from steelnb.points.inputs import checked_pose
from steelnb.settings import DeepVoSettings, OdometrySettings
from steelnb.settings.presets import PRESETS
from steelnb.types import Array, OdometryStep, Scan

COLUMNS, ROWS = 48, 64
TAN_SIDE, TAN_UP = 0.9325, 1.327
"""Pixels of a derotated image, and tangents of the half of its fields of view: those of a Starling 2's sensor."""
SEEN_MIN = 0.01
"""Share of the pixels that must have returns; with fewer a scan says nothing of the motion."""
GAP_MAX_S = 0.65
"""Scans further apart are no pair: in training they are up to three periods of 0.2 s apart."""
UNIT_M = 0.1
"""Length that is 1 to the network."""
MIRROR = np.array([1.0, -1.0, 1.0])
"""Translation in the mirrored images."""


def derotated(points: Array, R_level_sensor: Array) -> np.ndarray:
    """Range image of a levelled camera ``(2, ROWS, COLUMNS)`` float32: the share of each pixel that has returns, and
    that share times their mean inverse range, 1/m.

    ``points (N, 3)`` or ``(H, W, 3)``, sensor frame, NaN for no return. Each point is shared by the four pixels around
    it (bilinear weights), so that edges between pixels have a place.
    """
    count = points.size // 3 if points.ndim == 3 else 240 * 180
    points = points.reshape(-1, 3)
    x, y, z = (points[np.isfinite(points[:, 0])] @ R_level_sensor.T).T
    ahead = x > 0.05
    x, y, z = x[ahead], y[ahead], z[ahead]
    column, row = (1 - y / x / TAN_SIDE) * (COLUMNS / 2) - 0.5, (1 - z / x / TAN_UP) * (ROWS / 2) - 0.5
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
    image *= ROWS * COLUMNS / count
    return image.reshape(2, ROWS + 2, width)[:, 1:-1, 1:-1].astype(np.float32)


class Pair(NamedTuple):
    """Images ``(4, ROWS, COLUMNS)`` of two scans as a levelled camera at the sensor would see them, whose heading is
    the middle of theirs; and ``R_world_level (3, 3)`` of that camera."""

    images: np.ndarray
    R_world_level: Array


def paired(points: tuple[Array, Array], R_world_sensor: tuple[Array, Array]) -> Pair:
    """The derotated images of two scans, of which the attitudes ``(3, 3)`` are known."""
    ahead = R_world_sensor[0][:2, 0] + R_world_sensor[1][:2, 0]
    c, s = ahead / max(float(np.hypot(*ahead)), 1e-9)
    R_world_level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    images = [derotated(p, R_world_level.T @ R) for p, R in zip(points, R_world_sensor, strict=True)]
    return Pair(np.concatenate(images), R_world_level)


def motions(network: Network, images: np.ndarray) -> tuple[Array, Array]:
    """Translations ``(B, 3)`` of the sensor from the first to the second image of pairs ``(B, 4, ROWS, COLUMNS)``,
    ahead, left and up in metres, and their standard deviations ``(B, 3)``.

    The network is asked four times, forwards and backwards in time, as it is and mirrored, and the mean is taken: what
    stands still has no motion, whatever the weights.
    """
    swapped = images[:, [2, 3, 0, 1]]
    found = network(np.concatenate([images, swapped, images[..., ::-1], swapped[..., ::-1]])).reshape(4, -1, 6)
    sign = np.stack([np.ones(3), -np.ones(3), MIRROR, -MIRROR])[:, None]
    moved, log_sigma = (sign * found[..., :3]).mean(axis=0), found[..., 3:].mean(axis=0)
    return UNIT_M * moved, UNIT_M * np.exp(log_sigma.astype(np.float64))


class DeepVoOdometry(Odometry):
    """Adds up translations that a network reads from the derotated range images of two scans.

    Of the prior it uses the first pose, and the attitude, which is kept; its positions it does not look at. Nothing
    holds the sum: there is no map.

    Parameters
    ----------
    settings : of the family ``deepvo``, default ``OdometrySettings.preset("deepvo")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.

    Raises `InputError` for weights that cannot be used.
    """

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        self.settings = settings_of(settings, DeepVoSettings, "deepvo")
        packaged = PRESETS / self.settings.weights
        self.network = read_network(packaged if packaged.is_file() else Path(self.settings.weights))
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self.sigma_m = np.zeros(3)
        self._last: tuple[float, Array, Array] | None = None  # stamp, points and attitude of the last scan with returns
        self._place: Array | None = None  # of the sensor, world frame

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Add the motion since the last scan; see `Odometry.update`. ``matches`` are the pixels that have returns in
        both images, ``sigma_m (3,)`` the network's standard deviations of the last motion: ahead, left, up."""
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        clock = [time.perf_counter()]
        T_world_sensor = prior @ self.T_drone_sensor
        R, lever = T_world_sensor[:3, :3], prior[:3, :3] @ self.T_drone_sensor[:3, 3]
        if self._place is None:
            self._place = T_world_sensor[:3, 3]
        reason, matches, last = "", 0, self._last
        pair = paired((last[1] if last else scan.points, scan.points), (last[2] if last else R, R))
        clock.append(time.perf_counter())
        seen = pair.images[[0, 2]].reshape(2, -1) > 0.1
        few = seen[1].mean() < SEEN_MIN
        if few:
            reason = "too few returns"
        elif last is None:
            reason = "first scan"
        elif abs(scan.stamp_s - last[0]) > GAP_MAX_S:
            reason = f"{abs(scan.stamp_s - last[0]):.2f} s since the last scan with returns"
        else:
            matches = int(np.count_nonzero(seen.all(axis=0)))
            (moved,), (self.sigma_m,) = motions(self.network, pair.images[None])
            self._place = self._place + pair.R_world_level @ moved
        if not few:
            self._last = scan.stamp_s, scan.points, R
        T_world_drone = prior.copy()
        T_world_drone[:3, 3] = self._place - lever
        clock.append(time.perf_counter())
        seconds = dict(zip(("image", "network"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T_world_drone, reason == "", reason, matches, seconds)

    def map_points(self) -> Array:
        """No points ``(0, 3)``: there is no map."""
        return np.zeros((0, 3))
