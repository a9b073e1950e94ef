"""Smoothing of a whole flight: bars found with the corrected poses, poses and bars adjusted together, and again.

Bars are found anew in the second round: at better poses there are more of them, and their sections are more exact."""

from dataclasses import replace

import numpy as np

from steelnb.errors import EmptyCloudError, SingularError
from steelnb.fusion import bundle, uncertainty
from steelnb.fusion.observations import Observations
from steelnb.fusion.reconstruct import map_and_fit, map_scans
from steelnb.settings import StructureSettings
from steelnb.types import Estimate, Flight, Trajectory

COARSE, FINE = (8, 3), (1, 2)
"""One in how many pixels, and how many steps: first few points, then all."""
BARS_MIN = 3


def smooth(flight: Flight, estimate: Estimate, settings: StructureSettings | None = None) -> Estimate:
    """The estimate of a flight with all its poses and bars adjusted together (`fusion.bundle`).

    ``settings`` say what a bar is, as for `reconstruct`. The corrected poses become smooth, the first one the prior's,
    where drift begins; the map's points are those of all scans at them, its segments the bars, with their axes through
    the centroids of their sections. A flight without bars comes back as it was, with the reason in ``unsmoothed``.
    """
    settings = settings or StructureSettings()
    stamp_s, mount = flight.prior.stamp_s, flight.T_drone_sensor
    prior, T = flight.prior.T_world_drone @ mount, estimate.corrected.T_world_drone @ mount
    for last in (False, True):
        try:
            scans, fitted, reason = map_and_fit(flight.scans, T, settings)
        except EmptyCloudError as fault:
            return replace(estimate, unsmoothed=str(fault))
        if fitted is None or np.isfinite(fitted.width).sum() < BARS_MIN:
            return replace(estimate, unsmoothed=reason or "too few bars whose sections are known")
        state = bundle.start(T, prior, bundle.Bars(fitted.bars, fitted.across, fitted.turn, fitted.width))
        for pixels, steps in (COARSE, FINE) if last else (COARSE,):
            seen = Observations.gathered(scans.bar_points(fitted.bars, 1, pixels), T)
            for _ in range(steps):
                state = bundle.improve(state, seen, prior, stamp_s)
        T = state.T_world_sensor
    known = np.isfinite(state.bars.flange)
    segments, across = state.bars.segments.take(known), state.bars.across[known]
    pose_covariance, axis_covariance, unsure = None, None, ""
    try:
        pose, bar = uncertainty.marginals(state, seen, prior, stamp_s)
        pose_covariance = uncertainty.pose_covariances(pose, T, mount)
        axis_covariance = uncertainty.axis_covariances(bar[known], segments, across, state.sigma_ratio)
    except SingularError as fault:
        unsure = str(fault)
    points = map_scans(flight.scans, T, settings, every=3).means()
    corrected = Trajectory(stamp_s, T @ np.linalg.inv(mount))
    return replace(
        estimate, corrected=corrected, points=points, segments=segments, unsmoothed="", pose_covariance=pose_covariance,
        axis_covariance=axis_covariance, unsure=unsure,
    )  # fmt: skip
