"""Registration of scans to the front faces of bars: Gauss-Newton on position and yaw, from a predicted pose.

The prediction and the points count by their information. Roll and pitch are the prediction's, or found as well where
the prior's have errors.
"""

from typing import NamedTuple

import numpy as np

from steelnb.fusion.bar_equations import noise_ratio
from steelnb.fusion.known import KnownBars
from steelnb.fusion.point_association import world_points
from steelnb.fusion.poses import DRIFT_PERIOD_S, DRIFT_SIGMA, POSE, moved_poses, pose_size, pose_step, tilt_stays
from steelnb.types import Array, Scan

STEPS_MAX = 5
STEP_MIN = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1e-4])
"""A step of a registration below this, metres and radians, ends it."""
SHARE_MIN, BARS_MIN, BAR_POINTS_MIN, POINTS_MIN = 0.4, 4, 10, 100
"""A scan is registered if this share of its points that belong to bars lie on front faces, of this many bars with so
many points each; with fewer points it tells nothing. Chosen on the development seeds 11 and 12."""
RATIO = (1.0, 6.0)
"""Bounds of the range noise as a multiple of that in `points.ranges`."""


class Fit(NamedTuple):
    """A registration: the pose of the sensor, its information ``(D, D)`` about x, y, z and yaw, and for D = 6 roll and
    pitch, the number of bars matched, the share of the points on them, the range noise as a multiple, and why it does
    not hold."""

    T_world_sensor: Array
    information: Array
    bars: int
    share: float
    ratio: float
    reason: str


class FaceRegistration:
    """Registers scan after scan to ``known`` bars. ``variance (D,)`` is that of the pose predicted for the next scan,
    ``ratio`` the range noise as a multiple of that in `points.ranges`. D is 4, and 6 with a ``tilt_sigma_rad`` of the
    prior's roll and pitch."""

    def __init__(self, known: KnownBars, stamp_s: float = 0.0, ratio: float = 1.0, tilt_sigma_rad: float = 0.0) -> None:
        self.known, self.ratio, self.tilt_sigma_rad = known, ratio, tilt_sigma_rad
        self.variance, self._stamp_s = np.zeros(pose_size(tilt_sigma_rad)), stamp_s

    def predict(self, stamp_s: float) -> None:
        """Let the variance grow as drift does from the scan before to that of ``stamp_s``."""
        passed_s = max(stamp_s - self._stamp_s, 0.0) or DRIFT_PERIOD_S
        self._stamp_s = stamp_s
        self.variance = self.variance.copy()
        self.variance[:POSE] += DRIFT_SIGMA**2 * passed_s / DRIFT_PERIOD_S
        stays = tilt_stays(2.0 * passed_s)
        self.variance[POSE:] = stays * self.variance[POSE:] + (1.0 - stays) * self.tilt_sigma_rad**2

    def fit(self, points: Array, T_start: Array, known: Array | None = None) -> Fit:
        """Register ``points (N, 3)``, sensor frame, from a pose of the sensor, with all points assigned to bars anew in
        each step. ``known (D, D)`` is the information about that pose, in place of the predicted variance."""
        held = np.diag(1 / self.variance) if known is None else known
        T, information, residuals, size = T_start, np.eye(4), np.zeros(0), len(held)
        for _ in range(STEPS_MAX):
            matrix, vector, residuals = self.known.equations(points, T, self.ratio, size)
            information, apart = matrix + held, pose_step(T_start, T, size)
            pulled = vector - (apart / self.variance if known is None else known @ apart)
            step = np.asarray(np.linalg.solve(information, pulled), dtype=np.float64)
            T = moved_poses(T[None], step[None])[0]
            if (np.abs(step) < STEP_MIN[:size]).all():
                break
        near, on = self.known.matched(points, T, self.ratio)
        bars, share = int(((on >= BAR_POINTS_MIN) & (on >= SHARE_MIN * near)).sum()), float(on.sum() / len(points))
        enough = bars >= BARS_MIN and share >= SHARE_MIN
        reason = "" if enough else f"too little of the map in sight: {bars} bars, {100 * share:.0f} % of the points"
        return Fit(T, information, bars, share, noise_ratio(residuals, self.ratio), reason)

    def accept(self, fit: Fit) -> None:
        """Take over the noise and the covariance of a registration that holds."""
        self.ratio = float(np.clip(fit.ratio, *RATIO))
        self.variance = np.diag(np.linalg.inv(fit.information))


def points_in_range(scan: Scan, T_world_sensor: Array, range_max_m: float, floor_m: float, count: int = 0) -> Array:
    """Points ``(N, 3)`` of a scan in the sensor frame, within range and not below the floor; about ``count`` of them,
    evenly picked, or all for 0."""
    flat = np.ascontiguousarray(scan.points).reshape(-1, 3)
    world, _ = world_points(flat, T_world_sensor, range_max_m, floor_m)
    some = world[:: max(1, len(world) // count)] if count else world
    return np.asarray((some - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3])
