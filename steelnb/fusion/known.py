"""The bars of a known structure, as points of new scans are measured against them.

A bar with an angle section or a tube has the outline of `fusion.sections`. One whose section is not known, such as a
bar of a plain cloud, has that of a round tube of the radius of its points.
"""

import math

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.fusion import sections
from steelnb.fusion.bar_equations import BAR, Bars, equations
from steelnb.fusion.bar_voxels import BarVoxels
from steelnb.fusion.observations import Observations
from steelnb.fusion.poses import POSE
from steelnb.fusion.structure import Structure
from steelnb.types import Array, IntArray

VOXEL_M, REACH_M, MARGIN_M = 0.04, 0.15, 0.03
"""A point belongs to the bar nearest to its voxel, within reach; not where a second bar is hardly further away."""
SIGMA_MIN_M, TURN_SIGMA, FLANGE_SIGMA_M = 0.003, 0.05, 0.003
"""Least standard deviations of a bar of the map: of its place, which is biased alike in all scans, of the turn of its
section, radians, and of its flange. Chosen on the development seeds 11 and 12."""
MATCH_SIGMAS = 3.0


class KnownBars:
    """Bars with outlines, and the voxels around them.

    ``bars``: B bars as `fusion.bar_equations` has them; ``sigma_m (B,)``: standard deviations of their place, at least
    `SIGMA_MIN_M` of which are added. ``corner (B, 6, 2)``: their outlines.
    """

    def __init__(self, bars: Bars, sigma_m: Array) -> None:
        self.bars, self.sigma_m = bars, np.hypot(sigma_m, SIGMA_MIN_M)
        self.corner = sections.outlines(bars.turn, bars.flange)
        self.voxels = BarVoxels.around(bars.segments, REACH_M, MARGIN_M, VOXEL_M)

    @classmethod
    def of(cls, structure: Structure) -> "KnownBars":
        """The bars of a structure. Raises `InputError` for one without bars."""
        if not len(structure):
            raise InputError("the map has no bars; expected at least one to localise in")
        segments, n = structure.segments, len(structure)
        opening = np.full((n, 3), np.nan) if structure.opening is None else structure.opening
        first = opening - (opening * segments.direction).sum(axis=1)[:, None] * segments.direction
        with np.errstate(invalid="ignore"):
            first = first / np.linalg.norm(first, axis=1)[:, None]
        sectioned = np.isfinite(first).all(axis=1) & (structure.width_m > 0)
        first = np.where(sectioned[:, None], first, sections.frames(segments.direction)[:, 0])
        across = np.stack([first, np.cross(segments.direction, first)], axis=1)
        tube = np.zeros(n, dtype=bool) if structure.tube is None else structure.tube & (structure.width_m > 0)
        flange = np.where(sectioned | tube, structure.width_m, 2 * np.maximum(segments.radius, 0.01))
        sigma_m = np.where(np.isfinite(structure.sigma_m), structure.sigma_m, flange / 4)
        return cls(Bars(segments, across, np.where(sectioned, -math.pi / 4, np.nan), flange), sigma_m)

    def __len__(self) -> int:
        return len(self.sigma_m)

    def equations(
        self, points: Array, T_world_sensor: Array, ratio: float, size: int = POSE
    ) -> tuple[Array, Array, Array]:
        """Normal equations ``(size, size)``, ``(size,)`` of the pose of a scan (x, y, z, yaw, and if size is 6 roll and
        pitch) from its ``points (N, 3)``, sensor frame, and the histogram of their residuals
        (`fusion.bar_equations.equations`).

        Each bar may lie, run, turn and be as wide otherwise as its standard deviations say, in all points of the scan
        alike: the points of one bar tell no more than its place is known. ``ratio``: the range noise as a multiple of
        that in `points.ranges`.
        """
        bar = self.voxels.bar_of(points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3])
        points, bar = points[bar >= 0], bar[bar >= 0]
        whole = Observations.gathered([(0, points, bar)])
        seen, b = whole.pair_bar, self.bars
        n, segments = len(seen), b.segments.take(seen)
        among = Bars(segments, b.across[seen], b.turn[seen], b.flange[seen])
        own = whole._replace(pair_bar=np.arange(n))
        found = equations(own, T_world_sensor[None], among, self.corner[seen], ratio, size)
        sigma = np.empty((n, BAR))
        sigma[:, :2] = self.sigma_m[seen, None]
        sigma[:, 2:4] = sigma[:, :2] / np.maximum(0.5 * segments.length, 0.1)[:, None]
        sigma[:, 4:] = TURN_SIGMA, FLANGE_SIGMA_M
        found.block[:, np.arange(BAR), np.arange(BAR)] += sigma**-2.0
        beside = np.concatenate([found.cross.transpose(0, 2, 1), found.right[:, :, None]], axis=2)
        freed = (found.cross @ np.linalg.solve(found.block, beside)).sum(axis=0)
        return found.matrix[0] - freed[:, :size], found.vector[0] - freed[:, size], found.residuals

    def matched(self, points: Array, T_world_sensor: Array, ratio: float) -> tuple[IntArray, IntArray]:
        """For each bar, how many of a scan's ``points (N, 3)``, sensor frame, belong to it, and how many of them lie on
        its front face within `MATCH_SIGMAS` standard deviations, both ``(B,)``."""
        world = points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        bar, b = self.voxels.bar_of(world), self.bars
        distance = _face_sigmas(
            world, T_world_sensor[:3, 3], bar, b.segments.start, b.segments.direction, b.segments.length, b.across,
            self.corner, ratio,
        )  # fmt: skip
        on = (bar >= 0) & (np.abs(distance) < MATCH_SIGMAS)
        return np.bincount(bar[bar >= 0], minlength=len(self)), np.bincount(bar[on], minlength=len(self))


@njit(cache=True, error_model="numpy")
def _face_sigmas(points, sensor, bar, start, direction, length, across, corner, ratio):  # type: ignore[no-untyped-def]
    """Distance ``(N,)`` of points in the world frame from the front faces of their bars in standard deviations of the
    range noise; NaN for none."""
    result = np.full(len(points), np.nan)
    for i in range(len(points)):
        b = bar[i]
        if b >= 0:
            x, c = points[i] - start[b], sensor - points[i]
            u, v, t = sections.in_frame(direction[b], across[b], x[0], x[1], x[2])
            p, q, w = sections.in_frame(direction[b], across[b], c[0], c[1], c[2])
            found = sections.face_distance(u, v, t, p, q, w, corner[b], length[b])
            result[i] = found[0] / (ratio * found[1])
    return result
