"""Segment odometry as in the report's program: its section 3.2, including the faults of its source code.

Facts from the published source (`pointcloud_segmentation_node.cpp`, `hough_3d_lines.h`): each line of the Hough
transform is taken as a segment or dropped, and never cut at gaps. The segments of a scan are placed at the drifting
position minus the error so far. Each is matched to the first bar that is near both its ends and overlaps it. The error
then grows by a gain times the mean offset, but the logged position and the mapped segments are those before this
update. The sensor's mount is ignored.
"""

import math

import numpy as np

from steelnb.core.types import Array, Scan, Segments
from steelnb.hough import detect_lines
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.odometry.segments import GAIN, across_of, timed
from steelnb.points import preprocess_scan
from steelnb.settings import HoughSettings, OdometrySettings, ReportSegmentSettings
from steelnb.settings.stages import NO_FLOOR_M

RADIUS_M = 0.05
"""Radius of every bar in the original."""
DISTANCE_MAX_M = 2 * RADIUS_M + 4 * math.sqrt(3) * RADIUS_M / 1.5
"""Maximum distance of a segment's ends from the line of its bar: two radii and four voxel diagonals."""
POINTS_PER_M = 5.0
"""Minimum number of points of a segment per metre, rounded down: 0.1 m of width in cells of two voxel diagonals, 1.5
points in each."""
WEIGHT = 0.01
"""Weight of a segment when it is fused with its bar."""


class ReportSegmentOdometry(BaseOdometry):
    """Corrects a drifting position by bars, as the report's program does. The attitude is the prior's.

    The default settings are those of the report's sensor. Segments with both ends below the floor are
    dropped. ``error (3,)``: position error so far, metres, world frame; ``lines``: number of Hough lines in the last
    scan.
    """

    kind, method = ReportSegmentSettings, "report-segments"
    stages = "preprocess", "hough", "match"
    settings: ReportSegmentSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings or OdometrySettings.preset(self.method, "report"), T_drone_sensor)
        self.preprocess = self.settings.preprocess.replace(floor_m=NO_FLOOR_M)  # the transform sees the floor, too
        self.bars, self.error, self.lines = ReportBars(), np.zeros(3), 0

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        points = preprocess_scan(scan, prior, np.eye(4), self.preprocess)
        watch.lap("preprocess")
        (found, self.lines), hough_s = timed(sorted_segments, points, self.settings.hough)
        T_world_drone = prior.copy()
        T_world_drone[:3, 3] -= self.error
        segments = found.transformed(T_world_drone)
        segments = segments.take(
            np.maximum(segments.start[:, 2], segments.end[:, 2]) > self.settings.preprocess.floor_m
        )
        watch.lap("hough")
        watch.seconds["hough"] = hough_s
        reason = "no segment of the map seen" if len(self.bars) else "first scan"
        offsets = self.bars.insert(segments)
        watch.lap("match")
        if len(offsets):
            self.error, reason = self.error + GAIN * offsets.mean(axis=0), ""
        return T_world_drone, reason if len(segments) else "no segment seen", len(offsets), 0

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.bars.segments()


def sorted_segments(points: Array, settings: HoughSettings) -> tuple[Segments, int]:
    """Segments of a scan's points ``(N, 3)``, drone frame, by the program's rule: each Hough line whole, or not at all;
    and the number of lines.

    A line is dropped if the distances of neighbouring points from the *drone* differ by ``gap_max_m`` or more (which is
    less than their gap along the line, near the foot of the perpendicular), if the share of its variance along the line
    is not above ``pca_ratio_min``, or if it has too few points (`POINTS_PER_M`). The program also drops lines with a
    radius above 0.1 m, but the transform gives none.
    """
    if len(points) < settings.min_votes or not np.linalg.norm(np.ptp(points, axis=0)) > settings.dx_m:
        return Segments.empty(), 0
    lines = detect_lines(points, settings.dx_m, settings.min_votes, settings.max_lines, settings.granularity)
    starts, ends, counts, radii = [], [], [], []
    for line, (anchor, direction) in enumerate(zip(lines.anchor, lines.direction, strict=True)):
        own = points[lines.label == line] - anchor
        t = np.sort(own @ direction)
        gap_m = np.abs(np.diff(np.linalg.norm(anchor + t[:, None] * direction, axis=1))).max()
        variance = np.linalg.eigvalsh(np.cov(own.T))
        if (
            gap_m < settings.gap_max_m
            and variance[-1] > settings.pca_ratio_min * variance.sum()
            and len(own) > math.floor(POINTS_PER_M * (t[-1] - t[0]))
        ):
            starts.append(anchor + t[0] * direction)
            ends.append(anchor + t[-1] * direction)
            counts.append(len(own))
            radii.append(math.sqrt(variance[:-1].sum()))
    if not counts:
        return Segments.empty(), len(lines)
    found = Segments(np.array(starts), np.array(ends), np.array(counts, dtype=np.int64), np.array(radii))
    return found, len(lines)


class ReportBars:
    """The original's map: bars as lines ``anchor + t * vector``, each ``(B, 3)``, with ends ``reach (B, 2)`` in t.

    Bars are never merged with each other. The original computes the weight of a segment by an integer division of its
    points by all points. The result is 0, so the minimum (`WEIGHT`) always applies, and a bar hardly moves. Its factors
    for the weights are all above 0.995, and are omitted. It tests overlap along x, which fails for bars perpendicular
    to x; here the test is along the bar.
    """

    def __init__(self) -> None:
        self.anchor, self.vector, self.reach = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2))
        self.count = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.count)

    def segments(self) -> Segments:
        """The bars as segments, world frame."""
        ends = self.anchor[:, None] + self.reach[:, :, None] * self.vector[:, None]
        return Segments(ends[:, 0], ends[:, 1], self.count.copy(), np.full(len(self), RADIUS_M))

    def match(self, segments: Segments, k: int) -> tuple[int, Array, Array, Array] | None:
        """The first bar that segment ``k`` matches, with the anchor, vector and reach of the fused bar; None without a
        match.

        Both ends must lie within `DISTANCE_MAX_M` of the bar's line, and segment and bar must overlap along the fused
        line.
        """
        start, end = segments.start[k], segments.end[k]
        foot_start, foot_end = self._foot(start), self._foot(end)
        near = np.linalg.norm(foot_start - start, axis=1) < DISTANCE_MAX_M
        near &= np.linalg.norm(foot_end - end, axis=1) < DISTANCE_MAX_M
        anchor = foot_start + WEIGHT * (start - foot_start)
        vector = foot_end + WEIGHT * (end - foot_end) - anchor
        bars = self.segments()
        ends = np.stack([np.tile(start, (len(self), 1)), np.tile(end, (len(self), 1)), bars.start, bars.end])
        t = ((ends - anchor) * vector).sum(axis=2) / (vector**2).sum(axis=1)
        overlap = (t[:2].min(axis=0) <= t[2:].max(axis=0)) & (t[:2].max(axis=0) >= t[2:].min(axis=0))
        first = np.flatnonzero(near & overlap)[:1]
        if not len(first):
            return None
        bar = int(first[0])
        return bar, anchor[bar], vector[bar], np.array([t[:, bar].min(), t[:, bar].max()])

    def insert(self, segments: Segments) -> Array:
        """Fuse each segment with its bar, or start a new bar. All segments are matched to the bars before this call. If
        two match the same bar, the later one determines its line.

        Returns the offsets ``(P, 3)`` of the matched segments: perpendicular to the segment, from the bar's anchor to
        its line. The anchor may lie far from the visible part of the bar.
        """
        matches = {k: match for k in range(len(segments)) if (match := self.match(segments, k))}
        is_known = np.isin(np.arange(len(segments)), list(matches))
        known, added = segments.take(is_known), segments.take(~is_known)
        bars = np.array([match[0] for match in matches.values()], dtype=np.int64)
        offsets = across_of(known.start - self.anchor[bars], known.direction)
        for k, (bar, anchor, vector, reach) in matches.items():
            self.anchor[bar], self.vector[bar], self.reach[bar] = anchor, vector, reach
            self.count[bar] += segments.count[k]
        half_length = 0.5 * added.length
        self.anchor = np.concatenate([self.anchor, added.middle])
        self.vector = np.concatenate([self.vector, added.direction])
        self.reach = np.concatenate([self.reach, np.stack([-half_length, half_length], axis=1)])
        self.count = np.concatenate([self.count, added.count])
        return offsets

    def _foot(self, point: Array) -> Array:
        """The closest point on each bar's line to ``point (3,)``, ``(B, 3)``."""
        t = ((point - self.anchor) * self.vector).sum(axis=1) / (self.vector**2).sum(axis=1)
        return self.anchor + t[:, None] * self.vector
