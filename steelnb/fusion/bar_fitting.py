"""Bars fitted to the points of mapped scans: their sections, and their axes through the centroids of these."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.adjustment.problem import Bars
from steelnb.fusion.candidates import find_bars, merge_pieces
from steelnb.fusion.joints import TILT_DETERMINED_RAD, find_joints, trim_bends
from steelnb.fusion.mapped_scans import MappedScans
from steelnb.fusion.ridges import TUBE_M, Ridges
from steelnb.fusion.sections.choose import fit_sections
from steelnb.fusion.sections.histogram import HISTOGRAM, accumulate
from steelnb.fusion.sections.shapes import THICKNESS, TUBE, frames
from steelnb.fusion.structure import Structure

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
        segments, reason = find_bars(Ridges.of(self.scans.voxels), grids=1)
        if not len(segments):
            raise InputError(reason)
        for _ in range(fits):
            fitted, segments = self.refine(segments, every)
        return fitted
