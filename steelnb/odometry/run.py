"""The loop that drives an odometry over a flight: the only one."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from steelnb.errors import InputError
from steelnb.fusion.inertial import check_imu
from steelnb.fusion.smooth import smooth
from steelnb.odometry.base import Odometry
from steelnb.settings import OdometrySettings, StructureSettings
from steelnb.types import Estimate, Flight, OdometryStep, Scan, Trajectory

OnStep = Callable[[int, Scan, OdometryStep], None]


def run(flight: Flight, odometry: Odometry, on_step: OnStep | None = None) -> Estimate:
    """Correct a flight scan by scan; one scan is in memory at a time.

    Parameters
    ----------
    flight : the scans, the drifting prior at their stamps and the mount of the sensor.
    odometry : a new one; afterwards it holds the map.
    on_step : called after every scan with its number, the scan and its `OdometryStep`; its time is not the odometry's.

    Where the odometry's settings ask for it, the estimate is smoothed at the end (`steelnb.fusion.smooth`).

    Raises `InputError` where fewer scans can be read than the flight has poses, and before the first scan where
    smoothing is to use readings of an IMU that are in other units or axes.
    """
    if getattr(_settings(odometry), "inertial", None) and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
    return smoothed(flight, run_online(flight, odometry, on_step), odometry)


def run_online(flight: Flight, odometry: Odometry, on_step: OnStep | None = None) -> Estimate:
    """`run` without the smoothing at the end."""
    steps: list[OdometryStep] = []
    reason, update_s = [], np.zeros(len(flight))
    for k, scan in enumerate(flight.scans):
        begin = time.perf_counter()
        step = odometry.update(scan, flight.prior.T_world_drone[k])
        update_s[k] = time.perf_counter() - begin
        steps.append(step)
        reason.append("" if step.used else scan.fault or step.reason)
        if on_step:
            on_step(k, scan, step)
    if len(steps) < len(flight):
        raise InputError(f"{flight.name}: {len(steps)} scans could be read; expected {len(flight)}, one a pose")
    stages = steps[0].seconds if steps else ()
    return Estimate(
        prior=flight.prior,
        corrected=Trajectory(flight.prior.stamp_s, np.array([s.T_world_drone for s in steps]).reshape(-1, 4, 4)),
        points=odometry.map_points(),
        segments=odometry.map_segments(),
        matches=np.array([s.matches for s in steps], dtype=np.int64),
        reason=tuple(reason),
        seconds={stage: np.array([s.seconds[stage] for s in steps]) for stage in stages},
        update_s=update_s,
        unobserved=np.array([s.unobserved for s in steps], dtype=np.int64),
    )


def smoothed(flight: Flight, estimate: Estimate, odometry: Odometry) -> Estimate:
    """The estimate smoothed if the odometry's settings ask for it; the stage ``smooth`` has an equal share of the time
    a scan."""
    settings = _settings(odometry)
    if settings is None or not settings.smooth:
        return estimate
    begin, seen = time.perf_counter(), settings.preprocess
    structure = StructureSettings(floor_m=seen.floor_m, range_max_m=seen.crop_m)
    tilt_sigma_rad, noise = getattr(settings, "tilt_sigma_rad", 0.0), getattr(settings, "inertial", None)
    estimate = smooth(flight, estimate, structure, tilt_sigma_rad, noise)
    share_s = np.full(len(flight), (time.perf_counter() - begin) / max(len(flight), 1))
    return replace(estimate, seconds={**estimate.seconds, "smooth": share_s})


def _settings(odometry: Odometry) -> OdometrySettings | None:
    """The settings of an odometry of ours; another one need not have any."""
    settings = getattr(odometry, "settings", None)
    return settings if isinstance(settings, OdometrySettings) else None
