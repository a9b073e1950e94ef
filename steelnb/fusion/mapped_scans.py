"""The scans of a flight, with poses and the voxels in which they were accumulated, and bars fitted to their points.

A bar has a section, and its axis runs through the centroids of this.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Scan, Segments
from steelnb.fusion.adjustment.problem import Bars
from steelnb.fusion.bars import TUBE_M, VOXEL_M, Ridges, find_bars, merge_pieces
from steelnb.fusion.joints import TILT_DETERMINED_RAD, find_joints, trim_bends
from steelnb.fusion.point_to_bar import BarVoxels, world_points
from steelnb.fusion.sections.fit import fit_sections
from steelnb.fusion.sections.histogram import HISTOGRAM, accumulate
from steelnb.fusion.sections.shapes import THICKNESS, TUBE, frames
from steelnb.fusion.structure import Structure
from steelnb.points import VoxelMap, smooth_ranges
from steelnb.settings import StructureSettings

REACH_TUBES, MARGIN_TUBES = 2.4, 0.5
"""Reach and margin of `BarVoxels.around`, in tube radii."""


@dataclass(frozen=True)
class MappedScans:
    """K scans, the poses ``T_world_sensor (K, 4, 4)`` of the sensor, and the voxels in which they were accumulated."""

    scans: Sequence[Scan]
    T_world_sensor: Array
    voxels: VoxelMap
    settings: StructureSettings

    @classmethod
    def mapped(
        cls, scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings, every: int = 1
    ) -> "MappedScans":
        """Accumulate one in ``every`` scans in voxels (`insert_scan`). Raises `InputError` if there is no return above
        the floor."""
        voxels = VoxelMap(VOXEL_M)
        for k, scan in zip(range(0, len(scans), every), scans[::every], strict=True):
            insert_scan(voxels, scan, T_world_sensor[k], settings)
        if not len(voxels):
            raise InputError(f"{len(scans)} scans without a return above the floor at {settings.floor_m} m")
        return cls(scans, T_world_sensor, voxels, settings)

    def around(self, bars: Segments) -> BarVoxels:
        """The voxels around bars."""
        return BarVoxels.around(bars, REACH_TUBES * TUBE_M, MARGIN_TUBES * TUBE_M, self.voxels.voxel_m)

    def bar_points(self, voxels: BarVoxels, every: int = 1, pixels: int = 1) -> Iterator[tuple[int, Array, IntArray]]:
        """Yield, for one in ``every`` scans, its number, its points on bars in the sensor frame, and their bars; one in
        ``pixels`` points is used."""
        s = self.settings
        for k, scan in zip(range(0, len(self.scans), every), self.scans[::every], strict=True):
            points = _flat(scan.points)[k % pixels :: pixels]
            world, _, index = world_points(points, self.T_world_sensor[k], s.range_max_m, s.floor_m)
            bar = voxels.bar_of(world)
            yield k, points[index[bar >= 0]], bar[bar >= 0]


def median_range_m(scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings, every: int = 20) -> float:
    """Median range of the returns above the floor and within range in one of ``every`` scans, metres; NaN without."""
    ranges = [np.zeros(0)]
    for T, scan in zip(T_world_sensor[::every], scans[::every], strict=True):
        world, *_ = world_points(_flat(scan.points), T, settings.range_max_m, settings.floor_m)
        ranges.append(np.linalg.norm(world - T[:3, 3], axis=1))
    found = np.concatenate(ranges)
    return float(np.median(found)) if len(found) else np.nan


def insert_scan(voxels: VoxelMap, scan: Scan, T_world_sensor: Array, settings: StructureSettings) -> None:
    """Add the points of a scan to the voxels, with weights 1/range².

    Ranges of organised scans are smoothed first: thin bars are then found at twice the distance, with half the voxels.
    """
    points, weight, _ = world_points(
        _flat(smooth_ranges(scan.points)), T_world_sensor, settings.range_max_m, settings.floor_m
    )
    voxels.insert(points, weight)


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)


END_TUBES = 1.2
"""Points within this many tube radii of the ends of a bar take no part in the fit of its section."""


@dataclass(frozen=True)
class FittedBars:
    """B bars with their fitted sections, unknown and with a tilt of NaN for a bar with too few points.

    Standard deviations ``sigma (B,)`` of the position of the axis across, metres, and ``tilt (B,)`` of its direction,
    radians; ``sightings (B,)``: number of scans that observed the bar.
    """

    bars: Bars
    sigma: Array
    tilt: Array
    sightings: IntArray

    @property
    def is_weak(self) -> NDArray[np.bool_]:
        """Mask ``(B,)`` of the bars whose points do not determine their direction."""
        return ~(self.tilt <= TILT_DETERMINED_RAD)

    def take(self, mask: NDArray[np.bool_]) -> "FittedBars":
        """The bars selected by a mask."""
        return FittedBars(self.bars.take(mask), self.sigma[mask], self.tilt[mask], self.sightings[mask])

    def tied(self) -> Structure:
        """The structure of these bars after extending them to their joints."""
        bars = self.bars
        width = np.where(np.isnan(bars.flange), 2 * bars.segments.radius, bars.flange)
        joint, tie, segments = find_joints(bars.segments, width)
        angle = bars.turn + math.pi / 4  # of the bisector of the flanges
        opening = np.einsum("kb,bkx->bx", [np.cos(angle), np.sin(angle)], bars.across)
        tube = bars.kind == TUBE
        return Structure(
            segments, bars.flange, self.sightings, self.sigma, joint, tie, opening=opening,
            tube=tube if tube.any() else None,
        )  # fmt: skip


@dataclass(frozen=True)
class BarFitter:
    """Fits bars to the points of ``scans``; ``thickness`` of angle sections: share of the flange."""

    scans: MappedScans
    thickness: float = THICKNESS

    def fit(self, bars: Segments, every: int) -> FittedBars:
        """Fit a section (angle, circle or plane) to the points on each bar in one in ``every`` scans. The axes move
        to the centroids."""
        across, n = frames(bars.direction), len(bars)
        histogram, sightings = np.zeros((n, *HISTOGRAM)), np.zeros(n, dtype=np.int64)
        for k, points, bar in self.scans.bar_points(self.scans.around(bars), every):
            sightings += np.bincount(bar, minlength=n) >= 10
            accumulate(
                points, self.scans.T_world_sensor[k], bar, bars.start, bars.direction, bars.length, across,
                END_TUBES * TUBE_M, histogram,
            )  # fmt: skip
        kind, centre, slope, flange, turn, spread, tilt = fit_sections(histogram, bars.length, self.thickness)
        half_length = 0.5 * bars.length[:, None]
        start = bars.start + np.einsum("bk,bkx->bx", centre - half_length * slope, across)
        end = bars.end + np.einsum("bk,bkx->bx", centre + half_length * slope, across)
        sigma = np.where(np.isfinite(spread), spread, bars.radius / np.sqrt(np.maximum(bars.count, 1)))
        fitted = Bars(replace(bars, start=start, end=end), across, kind, turn, flange, self.thickness)
        return FittedBars(fitted, sigma, tilt, sightings)

    def refine(self, bars: Segments, every: int = 5, rise_m: float = math.inf) -> tuple[FittedBars, Segments]:
        """Fit the bars, then extend them to their joints and merge them (`merge_pieces`). With a finite ``rise_m``,
        bars whose direction is poorly determined keep their axes."""
        bars = trim_bends(bars)
        fitted = self.fit(bars, every)
        if rise_m < math.inf:
            is_weak, axes = fitted.is_weak, fitted.bars.segments
            axes.start[is_weak], axes.end[is_weak] = bars.start[is_weak], bars.end[is_weak]
        tied = fitted.tied()
        return fitted, merge_pieces(tied.segments, tied.width_m, rise_m)

    def find_and_fit(self, fits: int, every: int = 5) -> FittedBars:
        """The bars of the voxels, fitted ``fits`` times to one in ``every`` scans. Bars extended to their joints have
        more points, so a second fit is more accurate. Raises `InputError` if there are no bars."""
        segments, reason = find_bars(Ridges.of(self.scans.voxels))
        if not len(segments):
            raise InputError(reason)
        for _ in range(fits):
            fitted, segments = self.refine(segments, every)
        return fitted
