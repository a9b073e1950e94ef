"""Odometry by segments: the report's section 3.2, with its own correction and a better one."""

import time

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.config import FusionSettings, HoughSettings, OdometrySettings, PreprocessSettings
from steelnb.datatypes import Array, OdometryStep, Scan, Segments
from steelnb.fusion import SegmentMap
from steelnb.hough import detect_segments_with
from steelnb.odometry.corrections import CORRECTIONS, moved
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import Prediction
from steelnb.preprocess import preprocess_scan


class SegmentOdometry:
    """Corrects a drifting pose by the bars that it has mapped so far.

    ``T_drone_sensor (4, 4)`` is the sensor's mount. The settings are those of the rooms that it calls; their defaults
    are the report's. The report's rules correct the position only, ``least_squares_yaw`` also the yaw; roll and pitch
    are the prior's.
    """

    def __init__(
        self,
        preprocess: PreprocessSettings | None = None,
        hough: HoughSettings | None = None,
        fusion: FusionSettings | None = None,
        odometry: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
    ) -> None:
        self.preprocess = preprocess or PreprocessSettings()
        self.hough = hough or HoughSettings()
        self.odometry = odometry or OdometrySettings()
        self.T_drone_sensor = np.eye(4) if T_drone_sensor is None else T_drone_sensor
        self.map = SegmentMap(fusion)
        self.prediction = Prediction(self.odometry.drift_gain)
        self.near_side = NearSide()

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan and add the scan's segments to the map.

        ``scan`` is a `Scan` or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, NaN for no return;
        ``T_world_drone_prior (4, 4)`` the absolute drifting pose. A scan without a bar that the map knows leaves the
        correction as it was, and says so. Raises `SettingsError` for a prior that is not a finite ``(4, 4)`` array.
        """
        scan = scan if isinstance(scan, Scan) else Scan(0.0, scan)
        clock = [time.perf_counter()]
        T_world_drone = self.prediction.pose(T_world_drone_prior)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, self.preprocess)
        if self.odometry.near_side:
            self.near_side.look(scan.points)
            points = self.near_side.behind(points, self.T_drone_sensor[:3, 3])
        clock.append(time.perf_counter())
        seen = segments_in(points, self.hough).transformed(T_world_drone)
        clock.append(time.perf_counter())
        position = T_world_drone[:3, 3].copy()
        correction = CORRECTIONS[self.odometry.correction](seen, self.map, self.odometry, position)
        T_world_drone[:3, :3] = Rotation.from_euler("z", correction.yaw_rad).as_matrix() @ T_world_drone[:3, :3]
        T_world_drone[:3, 3] += correction.offset
        if correction.matches:
            self.prediction.correct(T_world_drone, T_world_drone_prior)
        else:
            self.prediction.lose()
        clock.append(time.perf_counter())
        reason = ""
        if not correction.matches:
            reason = "no segment seen" if not len(seen) else "no segment of the map seen"
            reason = "first scan" if not len(self.map) and len(seen) else reason
            reason = "no correction asked for" if self.odometry.correction == "none" else reason
        if len(seen):
            self.map.insert(moved(seen, np.append(correction.yaw_rad, correction.offset), position))
        clock.append(time.perf_counter())
        seconds = dict(zip(("preprocess", "hough", "match", "map"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T_world_drone, correction.matches > 0, reason, correction.matches, seconds)

    def map_points(self, spacing_m: float = 0.05) -> Array:
        """Points along the bars of the map, ``(N, 3)`` in the world frame."""
        bars = self.map.segments
        pieces = [
            start + np.linspace(0, 1, max(2, int(length / spacing_m) + 1))[:, None] * (end - start)
            for start, end, length in zip(bars.start, bars.end, bars.length, strict=True)
        ]
        return np.concatenate(pieces) if pieces else np.zeros((0, 3))

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.map.segments


def segments_in(points: Array, settings: HoughSettings) -> Segments:
    """Segments of a scan's points ``(N, 3)``; none where there are too few points for one to pass."""
    if len(points) < settings.min_votes or not np.ptp(points, axis=0).max() > settings.dx_m:
        return Segments.empty()
    return detect_segments_with(points, settings)
