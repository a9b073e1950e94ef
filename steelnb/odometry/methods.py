"""Settings → odometry, and flight → estimate."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from steelnb.core.estimates import Estimate
from steelnb.core.types import Array, CameraImages, Flight, Imu
from steelnb.fusion.adjustment.smooth import smooth, with_range_sigmas
from steelnb.odometry.base import BaseOdometry, Odometry, OnStep, make_own, run
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.deepvo import DeepVoOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.libraries import PeerOdometry
from steelnb.odometry.loam import LoamOdometry
from steelnb.odometry.orb import OrbOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.segments import SegmentOdometry
from steelnb.settings import MountSettings, OdometrySettings, StructureSettings

ODOMETRIES: dict[str, type[BaseOdometry]] = {
    "segments": SegmentOdometry,
    "clouds": CloudOdometry,
    "faces": FaceOdometry,
    "loam": LoamOdometry,
    "orb": OrbOdometry,
    "deepvo": DeepVoOdometry,
    "library": PeerOdometry,
    "report_clouds": ReportCloudOdometry,
    "report_segments": ReportSegmentOdometry,
}
"""Family of settings → its odometry."""


def make_odometry(
    settings: OdometrySettings, T_drone_sensor: Array, imu: Imu | None = None, images: CameraImages | None = None
) -> BaseOdometry:
    """A new odometry of the settings' family; ``T_drone_sensor (4, 4)`` is the mount of the sensor. Families that have
    no use for ``imu`` or ``images`` ignore them. Raises `InputError`."""
    kind, parts = ODOMETRIES[settings.family], {"imu": imu, "images": images}
    return kind(settings, T_drone_sensor, **{name: parts[name] for name in kind.uses})


def correct(
    flight: Flight,
    settings: OdometrySettings,
    on_step: OnStep | None = None,
    own: Callable[..., Odometry] | None = None,
    before: Flight | None = None,
) -> Estimate:
    """Correct a flight with the method of the settings, scan by scan.

    With ``smooth``, all poses and bars are then adjusted together (`fusion.adjustment.smooth`). Smoothing time is
    divided evenly over the scans. If the mount is unknown, the flight is corrected twice before that: with a mount that
    is some degrees off, an odometry gets lost, or its map turns while the mount is being found. ``on_step`` and
    ``before`` as for `run`.
    ``own`` is a class that replaces the odometry of the settings (`load_odometry`). Raises `InputError` as `run` does.

    Poses far from zero, such as in UTM, are moved near it for the work (`Flight.origin`), and results back."""
    if (origin := flight.origin).any():
        near, near_before = flight.moved(-origin), before and before.moved(-origin)
        shown = on_step and (lambda k, scan, step: on_step(k, scan, step.moved(origin)))
        found = correct(near, settings, shown, own, near_before)
        return found.moved(origin, flight.prior)
    noise = getattr(settings, "inertial", None)
    odometry: Odometry
    T_drone_sensor, in_flight = flight.T_drone_sensor, settings
    if own is None:
        if settings.corrects_twice:
            T_drone_sensor, in_flight = (
                mount_in_flight(flight, settings, on_step),
                settings.replace(mount=MountSettings()),
            )
        odometry = make_odometry(in_flight, T_drone_sensor, flight.imu, flight.images)
    else:
        odometry = make_own(own, flight)
    estimate, structure = run(flight, odometry, on_step, before), StructureSettings.of(settings.preprocess)
    if estimate.pose_covariance is not None:
        T = estimate.corrected.T_world_drone @ T_drone_sensor
        estimate = replace(estimate, pose_covariance=with_range_sigmas(estimate.pose_covariance, flight, T, structure))
    if not settings.smooth:
        return estimate
    begin = time.perf_counter()
    tilt_sigma_rad = getattr(settings, "tilt_sigma_rad", 0.0)
    estimate = smooth(flight, estimate, structure, tilt_sigma_rad, noise, settings.mount, T_drone_sensor)
    smooth_s = np.full(len(flight), (time.perf_counter() - begin) / max(len(flight), 1))
    return replace(estimate, seconds={**estimate.seconds, "smooth": smooth_s})


def mount_in_flight(flight: Flight, settings: OdometrySettings, on_step: OnStep | None) -> Array:
    """The mount ``(4, 4)`` that an odometry with these settings ends with; the stated one if it estimates none."""
    odometry = make_odometry(settings, flight.T_drone_sensor, flight.imu, flight.images)
    run(flight, odometry, on_step)
    return odometry.T_drone_sensor
