"""Smoothing of a whole flight: bars found with the corrected poses, poses and bars adjusted together, and again.

Bars are found anew in the second round: at better poses there are more of them, and their sections are more exact."""

from dataclasses import replace

import numpy as np

from steelnb.errors import InputError
from steelnb.fusion import bundle, uncertainty
from steelnb.fusion.bar_equations import Bars
from steelnb.fusion.inertial import TILT_SIGMA_RAD, Inertial, check_imu
from steelnb.fusion.observations import Observations
from steelnb.fusion.proposals import BLURRED_SHARE_MIN, LINEAR_SHARE_MIN
from steelnb.fusion.reconstruct import map_and_fit
from steelnb.fusion.sensor_errors import RANGE, true_flight, true_poses, unknown_errors
from steelnb.points.ranges import true_points
from steelnb.settings import CalibrationSettings, ImuSettings, StructureSettings
from steelnb.types import Estimate, Flight, Trajectory

Stages = tuple[tuple[int, int], ...]
ROUNDS: tuple[tuple[int, float, Stages], ...] = (
    (1, BLURRED_SHARE_MIN, ((8, 2),)), (2, LINEAR_SHARE_MIN, ((8, 2), (1, 2)))
)  # fmt: skip
"""Of each round: how often sections are fitted; the least share of lines that look like bars, in a map that is to be
sharpened and in one that was; then one in how many pixels, and how many steps: first few points, then all. Chosen on
the zigzag of the development seed 11, where half of the pixels in the last steps, or sections fitted once in
both rounds, make errors after alignment larger by a fifth and by half; see benchmarks/smoothing.md."""
BARS_MIN = 3
TILT_MIN_RAD = 0.001
"""Least standard deviation of the prior's roll and pitch where errors of the sensor are sought: the lean of a mount is
found as that of all attitudes."""


def smooth(
    flight: Flight,
    estimate: Estimate,
    settings: StructureSettings | None = None,
    tilt_sigma_rad: float = 0.0,
    calibration: CalibrationSettings | None = None,
    imu: ImuSettings | None = None,
) -> Estimate:
    """The estimate of a flight with all its poses and bars adjusted together (`fusion.bundle`).

    ``settings`` say what a bar is, as for `reconstruct`; ``tilt_sigma_rad`` is the standard deviation of the prior's
    roll and pitch, which are kept where it is 0; with ``calibration``, errors of the sensor are found, too
    (`fusion.sensor_errors`); with ``imu``, the errors of its data sheet, the readings of the flight's IMU take part
    (`fusion.inertial`), where it has one. The corrected poses become smooth, the first one the prior's,
    where drift begins; the map's points are those of one in three scans at the poses before the last steps, its
    segments the bars, with their axes through the centroids of their sections. A flight without bars comes back as it
    was, with the reason in ``unsmoothed``. Raises `InputError` for readings in other units or axes.
    """
    settings = settings or StructureSettings()
    stamp_s, mount = flight.prior.stamp_s, flight.T_drone_sensor
    prior, T = flight.prior.T_world_drone @ mount, estimate.corrected.T_world_drone @ mount
    ratio, errors, inertial = None, None, None
    if imu is not None and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
        time_sigma_s = 0.0 if calibration is None else calibration.time_sigma_s
        inertial = Inertial.started(flight.imu, imu, mount, estimate.corrected, time_sigma_s)
        tilt_sigma_rad = tilt_sigma_rad or TILT_SIGMA_RAD
    if calibration is not None:
        errors, tilt_sigma_rad = unknown_errors(calibration), max(tilt_sigma_rad, TILT_MIN_RAD)
    for fits, linear_min, stages in ROUNDS:
        try:
            scans, fitted, reason = map_and_fit(true_flight(flight, errors).scans, T, settings, fits, linear_min)
        except InputError as fault:
            return replace(estimate, unsmoothed=str(fault))
        if fitted is None or np.isfinite(fitted.width).sum() < BARS_MIN:
            return replace(estimate, unsmoothed=reason or "too few bars whose sections are known")
        first = prior if errors is None else true_poses(errors, prior, stamp_s)
        bars = Bars(fitted.bars, fitted.across, fitted.turn, fitted.width)
        state = bundle.start(T, first, bars, tilt_sigma_rad, errors, inertial)
        voxels = scans.around(fitted.bars)
        for pixels, steps in stages:
            scans = replace(scans, scans=true_flight(flight, state.errors).scans, T_world_sensor=state.T_world_sensor)
            seen = Observations.gathered(scans.face_points(voxels, state.bars, ratio, pixels))
            for _ in range(steps):
                equations, before = bundle.linearised(state, seen), state.errors
                state = bundle.improve(state, equations, prior, stamp_s)
                if before is not None and state.errors is not None:
                    offset_m, scale = (state.errors.value - before.value)[:RANGE]
                    seen = seen._replace(point=true_points(seen.point, offset_m, scale).astype(np.float32))
        T, ratio, errors, inertial = state.T_world_sensor, state.sigma_ratio, state.errors, state.inertial
    bars, mount = state.bars.sectioned(), true_flight(flight, errors).T_drone_sensor
    pose_covariance, axis_covariance, unsure = None, None, ""
    try:
        pose, bar, of_sensor = uncertainty.marginals(state, equations, prior, stamp_s)
        errors = errors and replace(errors, covariance=of_sensor)
        pose_covariance = uncertainty.pose_covariances(pose, T, mount)
        axis_covariance = uncertainty.axis_covariances(
            bar[state.bars.known], bars.segments, bars.across, state.sigma_ratio
        )
    except InputError as fault:
        unsure = str(fault)
    corrected = Trajectory(stamp_s, T @ np.linalg.inv(mount))
    return replace(
        estimate, corrected=corrected, points=scans.voxels.means(), segments=bars.segments, unsmoothed="",
        pose_covariance=pose_covariance, axis_covariance=axis_covariance, unsure=unsure, sensor_errors=errors,
    )  # fmt: skip
