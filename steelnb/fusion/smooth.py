"""Smoothing of a whole flight: find bars at the corrected poses, adjust poses and bars together, and repeat.

At the better poses of the second round more bars are found, with more exact sections."""

from dataclasses import replace

import numpy as np

from steelnb.errors import InputError
from steelnb.fusion import problem, solver, uncertainty
from steelnb.fusion.bar_voxels import Observations
from steelnb.fusion.inertial import Inertial, check_imu
from steelnb.fusion.poses import TILT_SIGMA_RAD
from steelnb.fusion.problem import Bars
from steelnb.fusion.reconstruct import map_and_fit
from steelnb.settings import ImuSettings, StructureSettings
from steelnb.types import Estimate, Flight, Trajectory

Stages = tuple[tuple[int, int], ...]
ROUNDS: tuple[tuple[int, Stages], ...] = ((1, ((8, 2),)), (2, ((8, 2), (1, 2))))
"""For each round: how often sections are fitted, and its stages as (one in so many pixels, steps). Chosen
on the zigzag of the development seed 11: half of the pixels in the last steps makes aligned errors larger by a fifth,
sections fitted once in both rounds by half."""
BARS_MIN = 3


def smooth(
    flight: Flight,
    estimate: Estimate,
    settings: StructureSettings | None = None,
    tilt_sigma_rad: float = 0.0,
    imu: ImuSettings | None = None,
) -> Estimate:
    """The estimate of a flight with all its poses and bars adjusted together (`fusion.solver`).

    ``settings`` say what a bar is, as for `reconstruct`; ``tilt_sigma_rad`` is the standard deviation of the prior's
    roll and pitch, which are kept where it is 0; with ``imu``, the errors of its data sheet, the readings of the
    flight's IMU take part (`fusion.inertial`), where it has one. The corrected poses become smooth, the first one the
    prior's, where drift begins; the map's points are those of one in three scans at the poses before the last steps,
    its segments the bars, with their axes through the centroids of their sections. A flight without bars comes back as
    it was, with the reason in ``unsmoothed``. Raises `InputError` for readings in other units or axes.
    """
    settings = settings or StructureSettings()
    stamp_s, mount = flight.prior.stamp_s, flight.T_drone_sensor
    prior, T = flight.prior.T_world_drone @ mount, estimate.corrected.T_world_drone @ mount
    ratio, inertial = None, None
    if imu is not None and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
        inertial = Inertial.started(flight.imu, imu, mount, estimate.corrected)
        tilt_sigma_rad = tilt_sigma_rad or TILT_SIGMA_RAD
    for fits, stages in ROUNDS:
        try:
            scans, fitted, reason = map_and_fit(flight.scans, T, settings, fits)
        except InputError as fault:
            return replace(estimate, unsmoothed=str(fault))
        if fitted is None or np.isfinite(fitted.width).sum() < BARS_MIN:
            return replace(estimate, unsmoothed=reason or "too few bars whose sections are known")
        bars = Bars(fitted.bars, fitted.across, fitted.turn, fitted.width)
        state = problem.start(T, prior, bars, tilt_sigma_rad, inertial)
        voxels = scans.around(fitted.bars)
        for pixels, steps in stages:
            scans = replace(scans, T_world_sensor=state.T_world_sensor)
            observations = Observations.gathered(scans.face_points(voxels, state.bars, ratio, pixels))
            state, equations = solver.adjusted(state, observations, prior, stamp_s, steps)
        T, ratio, inertial = state.T_world_sensor, state.sigma_ratio, state.inertial
    bars = state.bars.sectioned()
    pose_covariance, axis_covariance, unsure = None, None, ""
    try:
        pose, bar = uncertainty.marginals(state, equations, prior, stamp_s)
        pose_covariance = uncertainty.pose_covariances(pose, T, mount)
        axis_covariance = uncertainty.axis_covariances(
            bar[state.bars.known], bars.segments, bars.across, state.sigma_ratio
        )
    except InputError as fault:
        unsure = str(fault)
    corrected = Trajectory(stamp_s, T @ np.linalg.inv(mount))
    return replace(
        estimate, corrected=corrected, points=scans.voxels.means(), segments=bars.segments, unsmoothed="",
        pose_covariance=pose_covariance, axis_covariance=axis_covariance, unsure=unsure,
    )  # fmt: skip
