"""Settings → odometry, and flight → estimate."""

import inspect
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from steelnb.fusion.inertial import check_imu
from steelnb.fusion.smooth import smooth
from steelnb.images import CameraImages
from steelnb.odometry.base import Odometry
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.deepvo import DeepVoOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.loam import LoamOdometry
from steelnb.odometry.orb import OrbOdometry
from steelnb.odometry.peers import PeerOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.run import OnStep, run
from steelnb.odometry.segments import SegmentOdometry
from steelnb.settings import (
    CloudSettings,
    DeepVoSettings,
    FaceSettings,
    LibrarySettings,
    LoamSettings,
    OdometrySettings,
    OrbSettings,
    ReportCloudSettings,
    ReportSegmentSettings,
    SegmentSettings,
    StructureSettings,
)
from steelnb.types import Array, Estimate, Flight, Imu

ODOMETRIES: dict[type[OdometrySettings], Callable[..., Odometry]] = {
    SegmentSettings: SegmentOdometry,
    CloudSettings: CloudOdometry,
    FaceSettings: FaceOdometry,
    LoamSettings: LoamOdometry,
    OrbSettings: OrbOdometry,
    DeepVoSettings: DeepVoOdometry,
    LibrarySettings: PeerOdometry,
    ReportCloudSettings: ReportCloudOdometry,
    ReportSegmentSettings: ReportSegmentOdometry,
}
"""Settings of a family → its odometry."""


def make_odometry(
    settings: OdometrySettings, T_drone_sensor: Array, imu: Imu | None = None, images: CameraImages | None = None
) -> Odometry:
    """A new odometry of the settings' family; ``T_drone_sensor (4, 4)`` is the mount of the sensor. ``imu`` and
    ``images`` are passed to the odometries whose constructors take them."""
    make, given = ODOMETRIES[type(settings)], {"imu": imu, "images": images}
    parameters = inspect.signature(make).parameters
    return make(settings, T_drone_sensor, **{name: value for name, value in given.items() if name in parameters})


def correct(
    flight: Flight, settings: OdometrySettings, on_step: OnStep | None = None, odometry: Odometry | None = None
) -> Estimate:
    """Correct a flight with the method of the settings, scan by scan, or with a new ``odometry`` in its place.

    With ``smooth``, all poses and bars are then adjusted together (`steelnb.fusion.smooth`). Smoothing time is divided
    evenly over the scans. ``on_step`` as for `run`. Raises `InputError` as `run` does, and before the first scan if the
    readings of an IMU have other units or axes.
    """
    noise = getattr(settings, "inertial", None)
    if noise and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
    if odometry is None:
        odometry = make_odometry(settings, flight.T_drone_sensor, flight.imu, flight.images)
    estimate = run(flight, odometry, on_step)
    if not settings.smooth:
        return estimate
    begin, preprocess = time.perf_counter(), settings.preprocess
    structure = StructureSettings(floor_m=preprocess.floor_m, range_max_m=preprocess.crop_m)
    estimate = smooth(flight, estimate, structure, getattr(settings, "tilt_sigma_rad", 0.0), noise)
    smooth_s = np.full(len(flight), (time.perf_counter() - begin) / max(len(flight), 1))
    return replace(estimate, seconds={**estimate.seconds, "smooth": smooth_s})
