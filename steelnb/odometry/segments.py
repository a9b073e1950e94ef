"""Odometry by segments: the report's section 3.2, with its own correction and a better one."""

import time

import numpy as np

from steelnb.config import FusionSettings, HoughSettings, OdometrySettings, PreprocessSettings
from steelnb.datatypes import Array, OdometryStep, Scan, Segments
from steelnb.fusion import SegmentMap
from steelnb.hough import detect_segments_with
from steelnb.odometry.corrections import CORRECTIONS, check_prior
from steelnb.preprocess import preprocess_scan


class SegmentOdometry:
    """Corrects the position of a drifting pose by the bars that it has mapped so far.

    ``T_drone_sensor (4, 4)`` is the sensor's mount. The settings are those of the rooms that it calls; their defaults
    are the report's. Only the position is corrected: roll, pitch and yaw are the prior's.
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
        self.offset = np.zeros(3)

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan and add the scan's segments to the map.

        ``scan`` is a `Scan` or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, NaN for no return;
        ``T_world_drone_prior (4, 4)`` the absolute drifting pose. A scan without a bar that the map knows leaves the
        correction as it was, and says so. Raises `SettingsError` for a prior that is not a finite ``(4, 4)`` array.
        """
        scan = scan if isinstance(scan, Scan) else Scan(0.0, scan)
        check_prior(T_world_drone_prior)
        clock = [time.perf_counter()]
        T_world_drone = T_world_drone_prior.copy()
        T_world_drone[:3, 3] += self.offset
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, self.preprocess)
        clock.append(time.perf_counter())
        seen = self._segments(points).transformed(T_world_drone)
        clock.append(time.perf_counter())
        correction = CORRECTIONS[self.odometry.correction](seen, self.map, self.odometry)
        self.offset = self.offset + correction.offset
        T_world_drone[:3, 3] += correction.offset
        clock.append(time.perf_counter())
        reason = ""
        if not correction.matches:
            reason = "no segment seen" if not len(seen) else "no segment of the map seen"
            reason = "first scan" if not len(self.map) and len(seen) else reason
            reason = "no correction asked for" if self.odometry.correction == "none" else reason
        if len(seen):
            shift = correction.offset
            self.map.insert(Segments(seen.start + shift, seen.end + shift, seen.count, seen.radius))
        clock.append(time.perf_counter())
        seconds = dict(zip(("preprocess", "hough", "match", "map"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T_world_drone, correction.matches > 0, reason, correction.matches, seconds)

    def _segments(self, points: Array) -> Segments:
        """Segments of the points; none where there are too few points for one to pass."""
        if len(points) < self.hough.min_votes or not np.ptp(points, axis=0).max() > self.hough.dx_m:
            return Segments.empty()
        return detect_segments_with(points, self.hough)

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
