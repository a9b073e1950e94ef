"""Odometry by segments as the report's program did it: its section 3.2 with the faults of its source.

Facts from the published source (`pointcloud_segmentation_node.cpp`): the segments of a scan are placed at the drifting
position minus the error so far; each is matched with the first bar that is near both its ends and overlaps it; the
error grows by a gain times the mean offset. Position and segments are those before that update. The mount of the sensor
is left out.
"""

import math
import time

import numpy as np

from steelnb.odometry.base import Odometry, nothing_left, scan_of, settings_of
from steelnb.odometry.corrections import GAIN
from steelnb.odometry.segments import points_along, timed_segments
from steelnb.points import preprocess_scan
from steelnb.points.inputs import checked_pose
from steelnb.settings import OdometrySettings, ReportSegmentSettings
from steelnb.types import Array, IntArray, OdometryStep, Scan, Segments

NO_FLOOR_M = -1e6
"""The floor is left to the segments: its points take part in the Hough transform."""
FLOOR_M = 0.3
"""A segment counts if one of its ends is above this height."""
RADIUS_M = 0.05
"""The only radius that the original knew."""
DISTANCE_MAX_M = 2 * RADIUS_M + 4 * math.sqrt(3) * RADIUS_M / 1.5
"""A segment matches a bar whose line is nearer than this to both its ends: two radii, four diagonals of a voxel."""
WEIGHT_MIN = 0.01
"""The least weight of a segment when it is fused with its bar."""


class ReportSegmentOdometry(Odometry):
    """Corrects a drifting position by bars, trait by trait as the report's program. The attitude is the prior's.

    ``error (3,)`` is the position's error so far, metres in the world frame.

    Parameters
    ----------
    settings : of the family ``report_segments``, default ``OdometrySettings.preset("report-segments", "report")``.
    T_drone_sensor : (4, 4), the mount of the sensor, used where ``mount`` is switched; default identity.
    """

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        given = settings or OdometrySettings.preset("report-segments", "report")
        self.settings = settings_of(given, ReportSegmentSettings, "report-segments")
        self.switched = self.settings.switched
        self.preprocess = self.settings.preprocess.replace(floor_m=NO_FLOOR_M)
        mount = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self.T_drone_sensor = mount if "mount" in self.switched else np.eye(4)
        self.bars, self.error = ReportBars("weight" not in self.switched), np.zeros(3)

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Match a scan's segments, correct the position for the next scan, map the segments; see `Odometry.update`."""
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        clock = [time.perf_counter()]
        points = preprocess_scan(scan, prior, self.T_drone_sensor, self.preprocess)
        clock.append(time.perf_counter())
        found, hough_s = timed_segments(points, self.settings.hough)
        before = self._corrected(prior)
        seen = found.transformed(before)
        seen = seen.take(np.maximum(seen.start[:, 2], seen.end[:, 2]) > FLOOR_M)
        clock.append(time.perf_counter())
        offsets = self.bars.offsets(seen)
        if len(offsets):
            self.error = self.error + GAIN * offsets.mean(axis=0)
        after = self._corrected(prior)
        clock.append(time.perf_counter())
        reason = "" if len(offsets) else "no segment of the map seen" if len(self.bars) else "first scan"
        reason = reason if len(seen) else "no segment seen"
        reason = (nothing_left(scan, self.preprocess.crop_m) if not len(points) else "") or reason
        self.bars.insert(seen.moved(after[:3, 3] - before[:3, 3]) if "mapping" in self.switched else seen)
        clock.append(time.perf_counter())
        seconds = dict(zip(("preprocess", "hough", "match", "map"), np.diff(clock).tolist(), strict=True))
        seconds["hough"] = hough_s
        T_world_drone = after if "logging" in self.switched else before
        return OdometryStep(scan.stamp_s, T_world_drone, reason == "", reason, len(offsets), seconds)

    def _corrected(self, T_world_drone_prior: Array) -> Array:
        T = T_world_drone_prior.copy()
        T[:3, 3] -= self.error
        return T

    def map_points(self, spacing_m: float = 0.05) -> Array:
        """Points along the bars of the map, ``(N, 3)`` in the world frame."""
        return points_along(self.bars.segments(), spacing_m)

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.bars.segments()


class ReportBars:
    """The original's map: bars as lines a + t b with ``anchor (B, 3)``, ``vector (B, 3)``, ``reach (B, 2)`` in t.

    A bar is never merged with another one. It stays almost where it was first seen: with ``integer_weight`` the points
    of segment and bar are divided as integers, which gives 0, so that `WEIGHT_MIN` is always the weight. The original
    multiplies the weights by shares of variance that are all above 0.995; that is left out. It compares segments by
    their x, which fails for bars across x; here they are compared along the bar.
    """

    def __init__(self, integer_weight: bool = True) -> None:
        self.integer_weight = integer_weight
        self.anchor, self.vector, self.reach = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2))
        self.count = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.count)

    def segments(self) -> Segments:
        """The bars, world frame."""
        ends = self.anchor[:, None] + self.reach[:, :, None] * self.vector[:, None]
        return Segments(ends[:, 0], ends[:, 1], self.count.copy(), np.full(len(self), RADIUS_M))

    def offsets(self, seen: Segments) -> Array:
        """Offsets ``(P, 3)`` of the segments that match: from a bar's anchor straight across to the segment's line.

        The anchor may lie far from the part of the bar that is in sight.
        """
        found = [(k, match[0]) for k in range(len(seen)) if (match := self.match(seen, k))]
        apart = np.array([seen.start[k] - self.anchor[bar] for k, bar in found]).reshape(-1, 3)
        direction = seen.direction[[k for k, _ in found]]
        return apart - (apart * direction).sum(axis=1)[:, None] * direction

    def match(self, seen: Segments, k: int) -> tuple[int, Array, Array, Array] | None:
        """The first bar that segment ``k`` matches, and the anchor, vector and reach of both fused; None for none.

        Near: both ends within `DISTANCE_MAX_M` of the bar's line. The fused line must see both overlap.
        """
        start, end = seen.start[k], seen.end[k]
        foot_start, foot_end = self._foot(start), self._foot(end)
        near = np.linalg.norm(foot_start - start, axis=1) < DISTANCE_MAX_M
        near &= np.linalg.norm(foot_end - end, axis=1) < DISTANCE_MAX_M
        share = np.zeros(len(self)) if self.integer_weight else seen.count[k] / (seen.count[k] + self.count)
        weight = np.maximum(share, WEIGHT_MIN)[:, None]
        anchor = foot_start + weight * (start - foot_start)
        vector = foot_end + weight * (end - foot_end) - anchor
        bars = self.segments()
        ends = np.stack([np.tile(start, (len(self), 1)), np.tile(end, (len(self), 1)), bars.start, bars.end])
        t = ((ends - anchor) * vector).sum(axis=2) / (vector**2).sum(axis=1)
        overlap = (t[:2].min(axis=0) <= t[2:].max(axis=0)) & (t[:2].max(axis=0) >= t[2:].min(axis=0))
        first = np.flatnonzero(near & overlap)[:1]
        if not len(first):
            return None
        bar = int(first[0])
        return bar, anchor[bar], vector[bar], np.array([t[:, bar].min(), t[:, bar].max()])

    def insert(self, seen: Segments) -> IntArray:
        """Fuse each segment with its bar, or start a bar; returns the bar of each ``(M,)``.

        All are matched with the bars of before. Of two segments that match the same bar the later one counts.
        """
        matches = [self.match(seen, k) for k in range(len(seen))]
        new = np.array([match is None for match in matches], dtype=bool)
        bar = np.array([0 if match is None else match[0] for match in matches], dtype=np.int64)
        bar[new] = len(self) + np.arange(np.count_nonzero(new))
        fresh = seen.take(new)
        half = 0.5 * fresh.length
        self.anchor = np.concatenate([self.anchor, fresh.middle])
        self.vector = np.concatenate([self.vector, fresh.direction])
        self.reach = np.concatenate([self.reach, np.stack([-half, half], axis=1)])
        self.count = np.concatenate([self.count, fresh.count])
        for k, match in enumerate(matches):
            if match is not None:
                b, anchor, vector, reach = match
                self.anchor[b], self.vector[b], self.reach[b] = anchor, vector, reach
                self.count[b] += seen.count[k]
        return bar

    def _foot(self, point: Array) -> Array:
        """The nearest point to ``point (3,)`` on each bar's line, ``(B, 3)``."""
        t = ((point - self.anchor) * self.vector).sum(axis=1) / (self.vector**2).sum(axis=1)
        return self.anchor + t[:, None] * self.vector
