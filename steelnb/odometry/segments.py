"""Odometry by segments: the report's section 3.2, with its own rule of correction and others."""

import hashlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion import SegmentMap
from steelnb.hough import detect_segments_with
from steelnb.odometry.base import Odometry, Stopwatch, mount_of, nothing_left, scan_of, settings_of
from steelnb.odometry.corrections import CORRECTIONS, shifted
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import Prediction
from steelnb.points import preprocess_scan
from steelnb.points.inputs import checked_pose
from steelnb.settings import HoughSettings, OdometrySettings, SegmentSettings
from steelnb.types import Array, OdometryStep, Scan, Segments

Found = dict[tuple[bytes, HoughSettings], tuple[Segments, float]]
_shared: ContextVar[Found | None] = ContextVar("shared", default=None)


class SegmentOdometry(Odometry):
    """Corrects a drifting pose by the bars of its map.

    The report's rules correct the position only, at points on the surfaces seen, and assume a constant drift.
    ``least_squares_yaw`` also corrects the yaw, moves points by the near-side bias (`near_side`), and follows the rate
    of the drift. Roll and pitch are the prior's.

    Parameters
    ----------
    settings : of the family of segments, default ``OdometrySettings.preset("least_squares_yaw")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    """

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        self.settings = settings_of(settings, SegmentSettings, "least_squares_yaw")
        self.with_yaw = self.settings.method == "least_squares_yaw"
        self.T_drone_sensor = mount_of(T_drone_sensor)
        self.map = SegmentMap(self.settings.fusion)
        self.prediction = Prediction(self.with_yaw)
        self.near_side = NearSide()

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan and add the scan's segments to the map.

        ``scan`` is a `Scan` or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return;
        ``T_world_drone_prior (4, 4)`` the absolute drifting pose. If a scan shows no bar of the map, the correction
        stays, and ``reason`` says so. Raises `InputError` for arrays of other shapes, and for a prior that is not
        rigid.
        """
        scan, T_world_drone_prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        s, watch = self.settings, Stopwatch("preprocess", "hough", "match", "map")
        T_world_drone = self.prediction.pose(T_world_drone_prior)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, s.preprocess)
        if self.with_yaw:
            self.near_side.update(scan.points)
            points = self.near_side.shifted(points, self.T_drone_sensor[:3, 3])
        watch.lap("preprocess")
        found, hough_s = timed_segments(points, s.hough)
        observed = found.transformed(T_world_drone)
        watch.lap("hough")
        position = T_world_drone[:3, 3].copy()
        correction = CORRECTIONS[s.method](observed, self.map, s.robust_scale_m, position)
        T_world_drone[:3, :3] = Rotation.from_euler("z", correction.yaw_rad).as_matrix() @ T_world_drone[:3, :3]
        T_world_drone[:3, 3] += correction.offset
        if correction.matches:
            self.prediction.correct(T_world_drone, T_world_drone_prior)
        else:
            self.prediction.lose()
        watch.lap("match")
        reason = ""
        if not correction.matches:
            reason = "no segment seen" if not len(observed) else "no segment of the map seen"
            reason = "first scan" if not len(self.map) and len(observed) else reason
            reason = (nothing_left(scan, s.preprocess.crop_m) if not len(points) else "") or reason
            reason = "no correction asked for" if s.method == "none" else reason
        if len(observed):
            self.map.insert(shifted(observed, np.append(correction.yaw_rad, correction.offset), position))
        watch.lap("map")
        seconds = watch.seconds | {"hough": hough_s}
        return OdometryStep(scan.stamp_s, T_world_drone, correction.matches > 0, reason, correction.matches, seconds)

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.map.segments


def segments_in(points: Array, settings: HoughSettings) -> Segments:
    """Segments of a scan's points ``(N, 3)``; none if there are too few points for one."""
    if len(points) < settings.min_votes or not np.ptp(points, axis=0).max() > settings.dx_m:
        return Segments.empty()
    return detect_segments_with(points, settings)


@contextmanager
def shared_segments() -> Iterator[None]:
    """Within this context, equal points are segmented once for all odometries with equal settings: several methods on
    one flight mostly get the same points. Each odometry reports the time of the first segmentation."""
    token = _shared.set({})
    try:
        yield
    finally:
        _shared.reset(token)


def timed_segments(points: Array, settings: HoughSettings) -> tuple[Segments, float]:
    """`segments_in` and its seconds; within `shared_segments`, those of the first call with these arguments."""
    begin, shared = time.perf_counter(), _shared.get()
    if shared is None:
        return segments_in(points, settings), time.perf_counter() - begin
    key = hashlib.sha256(np.ascontiguousarray(points).data).digest(), settings
    if key not in shared:
        begin = time.perf_counter()
        shared[key] = segments_in(points, settings), time.perf_counter() - begin
    return shared[key]
