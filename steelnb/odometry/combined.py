"""Odometry by clouds and bars at once: the pairs of both in one solve."""

import numpy as np

from steelnb.fusion import SegmentMap
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.corrections import bar_equations
from steelnb.odometry.segments import segments_in
from steelnb.registration import Term
from steelnb.settings import OdometrySettings, RegistrationSettings
from steelnb.types import Array, Imu, Segments

TWIST = np.array([2, 3, 4, 5, 0, 1])
"""Where yaw, x, y, z, roll and pitch are in a twist (ω, v)."""


class CombinedOdometry(CloudOdometry):
    """`CloudOdometry` with a second map, of bars, whose pairs pull the pose across the bars as well.

    ``bars_weight`` is the weight of a pair of bars, ``robust_scale_m`` that of `bar_equations`. Both use
    the same points, so their information is not independent; but a bar averages over its length, and a point's pair is
    lost where the map has noise.

    Parameters
    ----------
    settings : a method by both, default ``OdometrySettings.preset("combined")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    imu : readings in the axes of the drone, as for `CloudOdometry`.
    """

    settings: RegistrationSettings

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        super().__init__(settings or OdometrySettings.preset("combined"), T_drone_sensor, imu)
        self.bar_map = SegmentMap(self.settings.fusion)
        self._seen: tuple[Array, Segments] = np.zeros((0, 3)), Segments.empty()

    def _bars_of(self, points: Array) -> Segments:
        """The segments of a scan, found once although the solve and the map both need them."""
        if points is not self._seen[0]:
            self._seen = points, segments_in(points, self.settings.hough)
        return self._seen[1]

    def _terms(self, points: Array) -> list[Term]:
        s, seen = self.settings, self._bars_of(points)
        if not len(seen) or not len(self.bar_map):
            return []

        def term(T: Array, centre: Array) -> tuple[Array, Array, float]:
            found = bar_equations(seen.transformed(T), self.bar_map, s.robust_scale_m, centre, self.predictor.tilted)
            H, b, at = np.zeros((6, 6)), np.zeros(6), TWIST[: len(found.b)]
            H[at[:, None], at], b[at] = found.H, found.b
            return s.bars_weight * H, s.bars_weight * b, s.bars_weight * found.loss

        return [term]

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)`` of the drone frame, and their bars, at a pose that is known."""
        super().insert(points, T_world_drone)
        self.bar_map.insert(self._bars_of(points).transformed(T_world_drone))

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.bar_map.segments


def by_clouds(
    settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
) -> CloudOdometry:
    """`CombinedOdometry` where the settings give bars a weight, else `CloudOdometry`."""
    by_bars = isinstance(settings, RegistrationSettings) and settings.bars_weight > 0
    return (CombinedOdometry if by_bars else CloudOdometry)(settings, T_drone_sensor, imu)
