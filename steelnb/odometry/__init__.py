"""Scans and a drifting trajectory → the corrected trajectory and a map."""

from steelnb.images import CameraImages
from steelnb.odometry.base import Odometry
from steelnb.odometry.cache import run_kept
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.combined import CombinedOdometry
from steelnb.odometry.deepvo import DeepVoOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.loam import LoamOdometry
from steelnb.odometry.orb import OrbOdometry
from steelnb.odometry.peers import PeerOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.run import run
from steelnb.odometry.segments import SegmentOdometry, shared_segments
from steelnb.settings import OdometrySettings
from steelnb.types import Array, Imu


def make_odometry(
    settings: OdometrySettings, T_drone_sensor: Array, imu: Imu | None = None, images: CameraImages | None = None
) -> Odometry:
    """A new odometry of the method that the settings name; ``T_drone_sensor (4, 4)`` is the mount of the sensor.
    Readings of the ``imu`` are used where the settings have a table ``inertial``, ``images`` where they have ``orb``.
    """
    if settings.orb:
        return OrbOdometry(settings, T_drone_sensor, imu, images)
    if settings.library is not None:
        return PeerOdometry(settings, T_drone_sensor)
    if settings.weights is not None:
        return DeepVoOdometry(settings, T_drone_sensor)
    if settings.report_clouds is not None:
        return ReportCloudOdometry(settings, T_drone_sensor)
    if settings.report_segments is not None:
        return ReportSegmentOdometry(settings, T_drone_sensor)
    if settings.clouds is None:
        return SegmentOdometry(settings, T_drone_sensor)
    if settings.clouds.shape == "features":
        return LoamOdometry(settings, T_drone_sensor)
    if settings.refit_s is not None:
        return FaceOdometry(settings, T_drone_sensor, imu)
    return (CombinedOdometry if settings.clouds.bars_weight else CloudOdometry)(settings, T_drone_sensor, imu)


__all__ = [
    "CloudOdometry", "CombinedOdometry", "DeepVoOdometry", "FaceOdometry", "LoamOdometry", "Odometry", "OrbOdometry",
    "PeerOdometry", "ReportCloudOdometry", "ReportSegmentOdometry", "SegmentOdometry", "make_odometry", "run",
    "run_kept", "shared_segments",
]  # fmt: skip
