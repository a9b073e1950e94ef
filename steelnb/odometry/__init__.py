"""Scans and a drifting trajectory → the corrected trajectory."""

from collections.abc import Callable
from typing import Protocol

from steelnb.config import CloudSettings, ExperimentSettings, OdometrySettings
from steelnb.datatypes import Array, OdometryStep, Scan, Segments
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.combined import CombinedOdometry
from steelnb.odometry.segments import SegmentOdometry


class Odometry(Protocol):
    """What every odometry is to an experiment, a live replay and a recorded flight."""

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan and add the scan to the map."""

    def map_points(self) -> Array:
        """The map as points ``(N, 3)``, world frame."""

    def map_segments(self) -> Segments:
        """The bars of the map; none where the map is a cloud."""


def make_odometry(settings: ExperimentSettings, T_drone_sensor: Array) -> Odometry:
    """The odometry that an experiment's settings ask for."""
    return _MAKERS[type(settings.odometry)](settings, T_drone_sensor)


_MAKERS: dict[type, Callable[[ExperimentSettings, Array], Odometry]] = {
    OdometrySettings: lambda s, T: SegmentOdometry(s.preprocess, s.hough, s.fusion, s.odometry, T),  # type: ignore[arg-type]
    CloudSettings: lambda s, T: _by_clouds(s, s.odometry, T),  # type: ignore[arg-type]
}


def _by_clouds(s: ExperimentSettings, clouds: CloudSettings, T_drone_sensor: Array) -> Odometry:
    if not clouds.bars_weight:
        return CloudOdometry(clouds, s.preprocess, T_drone_sensor)
    bars = OdometrySettings.preset(s.sensor, "least_squares_yaw")
    return CombinedOdometry(clouds, s.preprocess, s.hough, s.fusion, bars, T_drone_sensor)


__all__ = ["CloudOdometry", "CombinedOdometry", "Odometry", "SegmentOdometry", "make_odometry"]
