"""Smoothing of a whole flight: find bars at the corrected poses, adjust poses and bars together, and repeat.

The second round starts from better poses, so it finds more bars and fits their sections more accurately.
"""

from dataclasses import replace

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import check_same_stamps, checked_number
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate
from steelnb.core.types import Flight, Trajectory
from steelnb.fusion.adjustment import uncertainty
from steelnb.fusion.adjustment.adjust import Stages, adjust
from steelnb.fusion.adjustment.drift_factors import TILT_SIGMA_RAD
from steelnb.fusion.adjustment.imu_factors import Inertial, check_imu
from steelnb.fusion.mapped_scans import MappedScans
from steelnb.settings import ImuSettings, StructureSettings

ROUNDS: tuple[tuple[int, Stages], ...] = ((1, ((8, 2),)), (2, ((8, 2), (1, 2))))
"""Number of times that sections are fitted, and stages, for each round. With half of the pixels in the last stage,
aligned errors are larger by a fifth; with one fit of sections in both rounds, by half."""
BARS_MIN = 3
"""Minimum number of bars with a section."""


@checks_arguments
def smooth(
    flight: Flight,
    estimate: Estimate,
    settings: StructureSettings | None = None,
    tilt_sigma_rad: float = 0.0,
    imu: ImuSettings | None = None,
) -> Estimate:
    """The estimate of a flight with all its poses and bars adjusted together (`adjustment.solver`).

    Parameters
    ----------
    flight : K scans, the drifting poses, and the readings of an IMU if it has one.
    estimate : the corrected poses.
    settings : of the bars, as for `reconstruct`.
    tilt_sigma_rad : standard deviation of the prior's roll and pitch; if 0, they are fixed.
    imu : errors from the IMU's data sheet; if given, its readings are factors (`imu_factors`).

    Returns
    -------
    The estimate with new poses, of which the first is the prior's, since drift begins there. The points of the map are
    those of one in three scans, at the poses before the last round. Its segments are the bars, with axes through the
    centroids of their sections. With too few bars, the old estimate is returned, with the reason in ``unsmoothed``.

    Raises `InputError` if the readings have other units, axes or another clock (`check_imu`), and if the estimate is
    not of the flight. Poses far from zero are moved near it for the work (`Flight.origin`).
    """
    settings = StructureSettings() if settings is None else settings
    tilt_sigma_rad = checked_number(tilt_sigma_rad, "tilt_sigma_rad", 0.0)
    check_same_stamps(estimate.corrected.stamp_s, "estimate", flight.prior.stamp_s, "the scans of the flight")
    if (origin := flight.origin).any():
        near = flight.moved(-origin)
        found = smooth(near, estimate.moved(-origin, near.prior), settings, tilt_sigma_rad, imu)
        return found.moved(origin, estimate.prior)
    stamp_s, mount = flight.prior.stamp_s, flight.T_drone_sensor
    prior, T = flight.prior.T_world_drone @ mount, estimate.corrected.T_world_drone @ mount
    before, inertial = None, None
    if imu is not None and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
        inertial = Inertial.started(flight.imu, imu, mount, estimate.corrected)
        tilt_sigma_rad = tilt_sigma_rad or TILT_SIGMA_RAD
    for fits, stages in ROUNDS:
        try:
            scans = MappedScans.mapped(flight.scans, T, settings, every=3)
            state, equations = adjust(
                scans, prior, stamp_s, stages, fits, bars_min=BARS_MIN, tilt_sigma_rad=tilt_sigma_rad,
                inertial=inertial, before=before,
            )  # fmt: skip
        except InputError as fault:
            return replace(estimate, unsmoothed=str(fault))
        T, before, inertial = state.T_world_sensor, state, state.inertial
    bars = state.bars.take(state.bars.is_bar)
    pose_covariance, axis_covariance, unsure = None, None, ""
    try:
        pose, bar = uncertainty.marginals(state, equations, prior, stamp_s)
        pose_covariance = uncertainty.pose_covariances(pose, T, mount)
        pose_covariance = uncertainty.with_range_sigmas(pose_covariance, flight, T, settings)
        axis_covariance = uncertainty.axis_covariances(
            bar[state.bars.is_bar], bars.segments, bars.across, state.sigma_ratio
        )
    except InputError as fault:
        unsure = str(fault)
    return replace(
        estimate, corrected=Trajectory(stamp_s, T @ np.linalg.inv(mount)), points=scans.voxels.means(),
        segments=bars.segments, unsmoothed="", pose_covariance=pose_covariance, axis_covariance=axis_covariance,
        unsure=unsure, thickness=state.bars.thickness,
    )  # fmt: skip
