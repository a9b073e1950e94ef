"""Scans and a drifting trajectory → the corrected trajectory and a map."""

import inspect
from collections.abc import Callable

from steelnb.images import CameraImages
from steelnb.odometry.base import Odometry
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.combined import CombinedOdometry, by_clouds
from steelnb.odometry.deepvo import DeepVoOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.loam import LoamOdometry
from steelnb.odometry.orb import OrbOdometry
from steelnb.odometry.peers import PeerOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.run import run
from steelnb.odometry.segments import SegmentOdometry, shared_segments
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
)
from steelnb.types import Array, Imu

ODOMETRIES: dict[type[OdometrySettings], Callable[..., Odometry]] = {
    SegmentSettings: SegmentOdometry,
    CloudSettings: by_clouds,
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
    """A new odometry of the method that the settings name; ``T_drone_sensor (4, 4)`` is the mount of the sensor.
    Readings of the ``imu`` and ``images`` go to those whose constructors take them."""
    make, given = ODOMETRIES[type(settings)], {"imu": imu, "images": images}
    taken = inspect.signature(make).parameters
    return make(settings, T_drone_sensor, **{name: value for name, value in given.items() if name in taken})


__all__ = [
    "CloudOdometry", "CombinedOdometry", "DeepVoOdometry", "FaceOdometry", "LoamOdometry", "Odometry", "OrbOdometry",
    "PeerOdometry", "ReportCloudOdometry", "ReportSegmentOdometry", "SegmentOdometry", "make_odometry", "run",
    "shared_segments",
]  # fmt: skip
