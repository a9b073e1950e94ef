"""Odometry by segments: the report's section 3.2, with the report's correction and others."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Array, Scan, Segments
from steelnb.fusion import SegmentMap
from steelnb.hough import detect_segments_with
from steelnb.odometry.base import BaseOdometry, Outcome, Stopwatch
from steelnb.odometry.drift_filter import PRIOR_SIGMA, DriftPrediction
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import RegisteredPose
from steelnb.odometry.segments.corrections import CORRECTIONS, shifted
from steelnb.odometry.sharing import timed
from steelnb.points import preprocess_scan
from steelnb.settings import HoughSettings, OdometrySettings, SegmentSettings


class SegmentOdometry(BaseOdometry):
    """Corrects a drifting pose by the bars of its map.

    ``least_squares_yaw`` corrects position and yaw, moves points by the near-side bias (`near_side`), and estimates the
    drift rate. The other methods correct at most the position, use points as measured, and predict the last correction.
    Roll and pitch are the prior's. If a scan shows no bar of the map, the predicted pose is used.
    """

    kind, method = SegmentSettings, "least_squares_yaw"
    stages = "preprocess", "hough", "match", "map"
    settings: SegmentSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        self.with_yaw = self.settings.method == "least_squares_yaw"
        self.map = SegmentMap(self.settings.fusion)
        self.prediction = DriftPrediction(PRIOR_SIGMA if self.with_yaw else None)
        self.near_side = NearSide()

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> Outcome:
        s, T_world_drone = self.settings, self.prediction.pose(prior, scan.stamp_s)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, s.preprocess)
        if self.with_yaw:
            self.near_side.update(scan.points)
            points = self.near_side.shifted(points, self.T_drone_sensor[:3, 3])
        watch.lap("preprocess")
        found, hough_s = timed(segments_in, points, s.hough)
        observed = found.transformed(T_world_drone)
        watch.lap("hough")
        watch.seconds["hough"] = hough_s
        position = T_world_drone[:3, 3].copy()
        state, matches = CORRECTIONS[s.method](observed, self.map, s.robust_scale_m, position)
        T_world_drone[:3, :3] = Rotation.from_euler("z", state[0]).as_matrix() @ T_world_drone[:3, :3]
        T_world_drone[:3, 3] += state[1:]
        if matches:
            self.prediction.correct(RegisteredPose(T_world_drone))
        else:
            self.prediction.lose()
        watch.lap("match")
        reason = ""
        if s.method == "none":
            reason = "no correction asked for"
        elif not len(observed):
            reason = "no segment seen"
        elif not matches:
            reason = "no segment of the map seen" if len(self.map) else "first scan"
        if len(observed):
            self.map.insert(shifted(observed, state, position))
        watch.lap("map")
        return T_world_drone, reason, matches, 0

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.map.segments


def segments_in(points: Array, settings: HoughSettings) -> Segments:
    """Segments of a scan's points ``(N, 3)``; none if there are too few points or their extent is too small."""
    if len(points) < settings.min_votes or not np.ptp(points, axis=0).max() > settings.dx_m:
        return Segments.empty()
    return detect_segments_with(points, settings)
