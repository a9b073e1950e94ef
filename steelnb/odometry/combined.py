"""Odometry by clouds and bars at once: the pairs of both in one solve."""

import numpy as np

from steelnb.config import CloudSettings, FusionSettings, HoughSettings, OdometrySettings, PreprocessSettings
from steelnb.datatypes import Array, Segments
from steelnb.fusion import SegmentMap
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.corrections import bar_equations
from steelnb.odometry.segments import segments_in
from steelnb.registration import Term


class CombinedOdometry(CloudOdometry):
    """`CloudOdometry` with a second map, of bars, whose pairs pull the pose across the bars as well.

    ``clouds.bars_weight`` says how much a pair of bars counts; ``bars`` are the settings of `bar_equations`. Both say
    the same of the same points, so their information is not independent; but a bar averages over its length, and a
    point's pair is lost where the map has noise.
    """

    def __init__(
        self,
        clouds: CloudSettings | None = None,
        preprocess: PreprocessSettings | None = None,
        hough: HoughSettings | None = None,
        fusion: FusionSettings | None = None,
        bars: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
    ) -> None:
        super().__init__(clouds or CloudSettings.preset("combined"), preprocess, T_drone_sensor)
        self.hough = hough or HoughSettings()
        self.bars = bars or OdometrySettings()
        self.bar_map = SegmentMap(fusion)
        self._seen: tuple[Array, Segments] = np.zeros((0, 3)), Segments.empty()

    def _bars_of(self, points: Array) -> Segments:
        """The segments of a scan, found once although the solve and the map both need them."""
        if points is not self._seen[0]:
            self._seen = points, segments_in(points, self.hough)
        return self._seen[1]

    def _other_term(self, points: Array) -> Term | None:
        seen = self._bars_of(points)
        if not len(seen) or not len(self.bar_map):
            return None

        def term(T: Array, centre: Array) -> tuple[Array, Array, float]:
            found = bar_equations(seen.transformed(T), self.bar_map, self.bars, centre)
            H, b = np.zeros((6, 6)), np.zeros(6)
            H[2:, 2:], b[2:] = found.H, found.b  # of yaw and position; bars say nothing here of roll and pitch
            return self.settings.bars_weight * H, self.settings.bars_weight * b, self.settings.bars_weight * found.loss

        return term

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)`` of the drone frame, and their bars, at a pose that is known."""
        super().insert(points, T_world_drone)
        self.bar_map.insert(self._bars_of(points).transformed(T_world_drone))

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.bar_map.segments
