"""Registration of one scan to known bars: `fusion.adjustment.problem` with one pose and almost fixed bars.

Gauss-Newton estimates position and yaw, and also roll and pitch if those of the prior have errors. The predicted pose
is a factor with its information.
"""

from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import UPRIGHT_DOF, moved_poses, pose_step, transform_points
from steelnb.core.types import Array, IntArray, Scan
from steelnb.fusion.adjustment import factors
from steelnb.fusion.adjustment.factors import FACE_DOF, linearised, noise_ratio
from steelnb.fusion.adjustment.problem import Bars, Problem, pose_size
from steelnb.fusion.bars import VOXEL_M
from steelnb.fusion.point_to_bar import BarVoxels, Observations, face_residuals, world_points
from steelnb.fusion.sections.shapes import THICKNESS_SPREAD
from steelnb.odometry.near_side import pixels_on_surfaces

MATCH_REACH_M, MATCH_MARGIN_M = 0.15, 0.03
"""Reach and margin of the voxels of a bar (`BarVoxels.around`)."""
BAR_SIGMA_M, TURN_SIGMA = 0.003, 0.05
"""Standard deviations of a bar: of its position (an error that all scans share) and its flange, and of the rotation of
its section, radians."""
MATCH_SIGMAS = 3.0
STEPS_MAX = 5
STEP_MIN = np.array([1e-4, 1e-4, 1e-4, 2e-4, 2e-4, 2e-4])
"""A step below this, radians and metres, ends the iteration."""
MATCHED_BARS_MIN, BAR_POINTS_MIN, SCAN_POINTS_MIN = 4, 10, 100
"""Minimum number of bars, points per bar, and points per scan; below them a registration is rejected."""
SHARE_MIN = 0.5
"""Minimum share of the points near bars that lie on front faces, both for each bar and for the scan. Points far from
all bars do not count: they lie on structure that is not mapped yet."""
POSITION_SIGMA_MAX_M, FITTING_SIGMA_MAX_M, FITTING_SHARE = 0.004, 0.01, 0.65
"""Largest accepted standard deviations of the position along an axis. The second applies if at least `FITTING_SHARE` of
the points near bars lie on front faces: from a distance of 3.4 m, no scan reaches 4 mm, although most points fit. Where
fewer points fit, a pose that is claimed to 4 to 10 mm may have slid along a tower's arms by centimetres."""
RATIO_BOUNDS = (1.0, 6.0)
"""Bounds of the range noise as a multiple of that in `points.ranges`."""


class Fit(NamedTuple):
    """A registration: the pose of the sensor; ``information (D, D)`` and ``variance (D,)`` of a step from it
    (`factors`), D = 4 or 6; number of matched ``bars``; ``ratio``: range noise as a multiple of that in
    `points.ranges`; ``reason``: why it is rejected, else empty."""

    T_world_sensor: Array
    information: Array
    variance: Array
    bars: int
    ratio: float
    reason: str


class Locator:
    """Registers scan after scan to ``bars`` with sections, in the world frame.

    ``stamp_s``: of the last scan; ``variance (D,)``: of the predicted pose of the next one; D = 4, or 6 if the prior's
    roll and pitch have a ``tilt_sigma_rad``; ``ratio``: range noise as a multiple of that in `points.ranges`.
    """

    def __init__(self, bars: Bars, stamp_s: float = 0.0, ratio: float = 1.0, tilt_sigma_rad: float = 0.0) -> None:
        self.bars, self.ratio, self.tilt_sigma_rad = bars, ratio, tilt_sigma_rad
        self.variance, self.stamp_s = np.zeros(pose_size(tilt_sigma_rad)), stamp_s
        self._voxels = BarVoxels.around(bars.segments, MATCH_REACH_M, MATCH_MARGIN_M, VOXEL_M)

    def predict(self, stamp_s: float) -> None:
        """Add the variance of the drift since the last scan."""
        passed_s = max(stamp_s - self.stamp_s, 0.0) or factors.DRIFT_PERIOD_S
        self.stamp_s = stamp_s
        self.variance = self.variance.copy()
        self.variance[-UPRIGHT_DOF:] += factors.drift_variance(passed_s)
        decay = factors.tilt_decay(2.0 * passed_s)  # of a variance
        self.variance[:-UPRIGHT_DOF] = decay * self.variance[:-UPRIGHT_DOF] + (1.0 - decay) * self.tilt_sigma_rad**2

    def fit(self, points: Array, T_start: Array, known: Array | None = None) -> Fit:
        """Register ``points (N, 3)``, sensor frame, from the predicted pose ``T_start (4, 4)`` of the sensor.

        ``known (D, D)``: information of the prediction, by default from ``variance``. Each step associates the points
        with bars anew.
        """
        prior = np.diag(1 / self.variance) if known is None else known
        T, information, residuals, size = T_start, np.eye(4), np.zeros(0), len(prior)
        for _ in range(STEPS_MAX):
            matrix, vector, residuals = self._equations(points, T)
            information, error = matrix + prior, pose_step(T_start, T, size)
            rhs = vector - (error / self.variance if known is None else known @ error)
            step = np.asarray(np.linalg.solve(information, rhs), dtype=np.float64)
            T = moved_poses(T[None], step[None])[0]
            if (np.abs(step) < STEP_MIN[-size:]).all():
                break
        near, on = self._matched(points, T)
        bars = int(((on >= BAR_POINTS_MIN) & (on >= SHARE_MIN * near)).sum())
        share, variance = float(on.sum() / max(near.sum(), 1)), np.diag(np.linalg.inv(information))
        sigma_m, reason = float(np.sqrt(variance[-3:].max())), ""
        sigma_max_m = FITTING_SIGMA_MAX_M if share >= FITTING_SHARE else POSITION_SIGMA_MAX_M
        if not (bars >= MATCHED_BARS_MIN and share >= SHARE_MIN and sigma_m <= sigma_max_m):
            reason = (
                f"pose not determined: {bars} bars in sight, {100 * share:.0f} % of the points near bars on "
                f"their faces, position known to {1e3 * sigma_m:.1f} mm"
            )
        return Fit(T, information, variance, bars, noise_ratio(residuals, self.ratio), reason)

    def accept(self, fit: Fit) -> None:
        """Adopt range noise and variance of an accepted registration."""
        self.ratio = float(np.clip(fit.ratio, *RATIO_BOUNDS))
        self.variance = fit.variance

    def _equations(self, points: Array, T_world_sensor: Array) -> tuple[Array, Array, Array]:
        """Normal equations ``(D, D)``, ``(D,)`` of the pose from ``points (N, 3)``, sensor frame, and the histogram of
        their residuals.

        The bars are marginalised with their standard deviations. However many points lie on a bar, they determine the
        pose no better than the bar itself is known.
        """
        bar = self._voxels.bar_of(transform_points(T_world_sensor, points))
        observations = Observations.gathered([(0, points[bar >= 0], bar[bar >= 0])])
        bars, n = self.bars.take(observations.pair_bar), len(observations.pair_bar)
        observations = observations._replace(pair_bar=np.arange(n))
        pose = Problem(T_world_sensor[None], bars, self.ratio, np.zeros((n, 2)), self.tilt_sigma_rad)
        equations, size = linearised(pose, observations), len(self.variance)
        sigma = np.empty((n, FACE_DOF))
        sigma[:, :2] = BAR_SIGMA_M
        sigma[:, 2:4] = sigma[:, :2] / np.maximum(0.5 * bars.segments.length, 0.1)[:, None]
        sigma[:, 4:] = TURN_SIGMA, BAR_SIGMA_M, THICKNESS_SPREAD
        equations.block[:, np.arange(FACE_DOF), np.arange(FACE_DOF)] += sigma**-2.0
        beside = np.concatenate([equations.cross.transpose(0, 2, 1), equations.rhs[:, :, None]], axis=2)
        marginal = (equations.cross @ np.linalg.solve(equations.block, beside)).sum(axis=0)
        return (
            equations.matrix[0] - marginal[:, :size], equations.vector[0] - marginal[:, size], equations.residuals,
        )  # fmt: skip

    def _matched(self, points: Array, T_world_sensor: Array) -> tuple[IntArray, IntArray]:
        """Number of ``points (N, 3)``, sensor frame, that belong to each bar, and number of these within `MATCH_SIGMAS`
        standard deviations of its front face, both ``(B,)``."""
        bar, n = self._voxels.bar_of(transform_points(T_world_sensor, points)), len(self.bars.turn)
        residual, sigma, *_ = face_residuals(points, bar, T_world_sensor, *self.bars.faces())
        on = np.abs(residual) < MATCH_SIGMAS * self.ratio * sigma  # false for NaN
        return np.bincount(bar[bar >= 0], minlength=n), np.bincount(bar[on], minlength=n)


def points_in_range(scan: Scan, T_world_sensor: Array, range_max_m: float, floor_m: float, count: int) -> Array:
    """About ``count`` points ``(N, 3)`` of a scan, sensor frame, within range, above the floor, and not on surfaces
    that are too wide for bars, picked evenly."""
    flat = np.ascontiguousarray(scan.points).reshape(-1, 3)
    world, _, index = world_points(flat, T_world_sensor, range_max_m, floor_m)
    world = world[~pixels_on_surfaces(scan.points, index).ravel()[index]]
    return np.asarray((world[:: max(1, len(world) // count)] - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3])
