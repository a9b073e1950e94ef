"""The final reconstruction: all scans of a flight with corrected poses → `Structure`."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Scan, Segments
from steelnb.fusion.adjustment import problem
from steelnb.fusion.adjustment.drift_factors import DRIFT_PERIOD_S
from steelnb.fusion.adjustment.imu_factors import Inertial
from steelnb.fusion.adjustment.point_factors import PointEquations, linearised
from steelnb.fusion.adjustment.problem import Bars, Problem
from steelnb.fusion.adjustment.solver import improve
from steelnb.fusion.candidates import TUBE_M, VOXEL_M, find_bars, find_struts, merge_pieces
from steelnb.fusion.joints import between_joints, find_joints, trim_bends
from steelnb.fusion.point_to_bar import BarVoxels, Observations, world_points
from steelnb.fusion.sections import shapes
from steelnb.fusion.sections.choose import fit_sections
from steelnb.fusion.structure import Structure
from steelnb.points import VoxelMap, smooth_ranges
from steelnb.settings import StructureSettings

END_TUBES = 1.2
"""Points within this many tube radii of the ends of a bar take no part in the fit of its section."""
TILT_DETERMINED_RAD, TILT_MAX_RAD = 0.02, 0.1
"""A bar whose direction has a standard deviation above the first keeps its axis when its section is fitted, and finally
runs from joint to joint. Above the second, it is dropped."""
Stages = tuple[tuple[int, int], ...]
"""Stages ``(n, steps)`` of an adjustment: number of steps with one in n pixels."""
REACH_TUBES, MARGIN_TUBES = 2.4, 0.5
"""Reach and margin of `BarVoxels.around`, in tube radii."""
FACE_SIGMAS, FACE_MAX_TUBES, RATIO_MIN = 2.5, 1.3, 0.8
"""Maximum distance of a point from the front face of its bar in an adjustment, in standard deviations of the range
noise and in tube radii; and minimum noise ratio for the first, below which large residuals are due to poses and
sections. With ``starling2``, 2 to 3 standard deviations give similar errors. With the report's sensor, a larger bound
leaves too few points of the first scan, which fixes the world frame."""


def reconstruct(
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Structure:
    """Bars and joints of a structure from all scans of a flight and their smoothed or corrected poses.

    There are two passes: first the dominant bars, then the shorter ones between them, which become visible once the
    sections of the first are fitted. The axis of a bar is the line through the centroids of its sections. A bar with
    too few points for its section or direction is dropped, and so are lines in plates (`fusion.section_choice`).

    Parameters
    ----------
    scans : K scans, points in the sensor frame, NaN for no return; read several times, one in memory at a time.
    T_world_drone : ``(K, 4, 4)``, the corrected poses.
    T_drone_sensor : ``(4, 4)``, the mount of the sensor, default identity.
    settings : see `StructureSettings`. With ``adjust``, poses and bars are adjusted together first (`fusion.problem`);
        smoothing does this more accurately.

    Returns
    -------
    `Structure` in the world frame, metres. An empty one states the reason.

    Raises `InputError` if the poses do not fit the scans or are not finite, or if no scan has a return above the floor.
    """
    settings = settings or StructureSettings()
    T_world_drone = np.asarray(T_world_drone, dtype=np.float64)
    if T_world_drone.shape != (len(scans), 4, 4) or not np.isfinite(T_world_drone).all():
        raise InputError(f"T_world_drone of shape {T_world_drone.shape}: expected ({len(scans)}, 4, 4), all finite")
    T_world_sensor = T_world_drone if T_drone_sensor is None else T_world_drone @ T_drone_sensor
    before = None
    if settings.adjust:
        flight = MappedScans.mapped(scans, T_world_sensor, settings, every=3)
        stamp_s = DRIFT_PERIOD_S * np.arange(len(scans), dtype=np.float64)
        with contextlib.suppress(InputError):  # too few bars
            before, _ = flight.adjusted(T_world_sensor, stamp_s, ((4, 2),), fits=2)
            T_world_sensor = before.T_world_sensor
    flight = MappedScans.mapped(scans, T_world_sensor, settings, before=before)
    segments, reason = find_bars(flight.voxels, rise_m=TUBE_M)
    if not len(segments):
        return Structure.empty(reason)
    _, segments = flight.refined(segments, rise_m=TUBE_M)
    # Now that axes run through centroids, the voxels near bars hide fewer short bars.
    struts = find_struts(flight.voxels, segments, TUBE_M)
    _, segments = flight.refined(merge_pieces(Segments.joined((segments, struts)), rise_m=TUBE_M), rise_m=TUBE_M)
    fitted = flight.fit(trim_bends(segments), every=1)
    fitted = fitted.take(fitted.bars.is_bar & (fitted.tilt <= TILT_MAX_RAD))  # a tilt is NaN if points are too few
    if not len(fitted.tilt):
        return Structure.empty("no bar has enough points to determine its direction")
    structure = _tied(fitted)
    return replace(structure, segments=between_joints(structure, fitted.tilt > TILT_DETERMINED_RAD))


def insert_scan(voxels: VoxelMap, scan: Scan, T_world_sensor: Array, settings: StructureSettings) -> None:
    """Add the points of a scan to the voxels, with weights 1/range².

    Ranges of organised scans are smoothed first: thin bars are then found at twice the distance, with half the voxels.
    """
    points, weight, _ = world_points(
        _flat(smooth_ranges(scan.points)), T_world_sensor, settings.range_max_m, settings.floor_m
    )
    voxels.insert(points, weight)


@dataclass(frozen=True)
class FittedBars:
    """B bars with their fitted sections, flange and tilt NaN for a bar with too few points.

    Standard deviations ``sigma (B,)`` of the position of the axis across, metres, and ``tilt (B,)`` of its direction,
    radians; ``sightings (B,)``: number of scans that observed the bar.
    """

    bars: Bars
    sigma: Array
    tilt: Array
    sightings: IntArray

    def take(self, mask: NDArray[np.bool_]) -> "FittedBars":
        """The bars selected by a mask."""
        return FittedBars(self.bars.take(mask), self.sigma[mask], self.tilt[mask], self.sightings[mask])


@dataclass(frozen=True)
class MappedScans:
    """K scans, the poses ``T_world_sensor (K, 4, 4)`` of the sensor, and the voxels in which they were accumulated.

    ``before``: an earlier adjustment of the same flight, whose range noise and thickness are the first estimates.
    """

    scans: Sequence[Scan]
    T_world_sensor: Array
    voxels: VoxelMap
    settings: StructureSettings
    before: Problem | None = None

    @classmethod
    def mapped(
        cls, scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings, every: int = 1,
        before: Problem | None = None,
    ) -> "MappedScans":  # fmt: skip
        """Accumulate one in ``every`` scans in voxels (`insert_scan`). Raises `InputError` if there is no return above
        the floor."""
        voxels = VoxelMap(VOXEL_M)
        for k, scan in zip(range(0, len(scans), every), scans[::every], strict=True):
            insert_scan(voxels, scan, T_world_sensor[k], settings)
        if not len(voxels):
            raise InputError(f"{len(scans)} scans without a return above the floor at {settings.floor_m} m")
        return cls(scans, T_world_sensor, voxels, settings, before)

    def around(self, bars: Segments) -> BarVoxels:
        """The voxels around bars."""
        return BarVoxels.around(bars, REACH_TUBES * TUBE_M, MARGIN_TUBES * TUBE_M, self.voxels.voxel_m)

    def bar_points(
        self, voxels: BarVoxels, every: int = 1, pixels: int = 1, bars: Bars | None = None, sigma_ratio: float = 1.0
    ) -> Iterator[tuple[int, Array, IntArray]]:
        """Yield, for one in ``every`` scans, its number, its points on bars in the sensor frame, and their bars; one in
        ``pixels`` points is used. With ``bars``, only points within `FACE_SIGMAS` of their front faces are taken
        (`BarVoxels.on_face`); ``sigma_ratio``: range noise as a multiple of that in `points.ranges`."""
        s, sigmas = self.settings, FACE_SIGMAS * max(sigma_ratio, RATIO_MIN)
        for k, scan in zip(range(0, len(self.scans), every), self.scans[::every], strict=True):
            points, T = _flat(scan.points)[k % pixels :: pixels], self.T_world_sensor[k]
            world, _, index = world_points(points, T, s.range_max_m, s.floor_m)
            bar = voxels.bar_of(world)
            points, bar = points[index[bar >= 0]], bar[bar >= 0]
            if bars is not None:
                on_face = voxels.on_face(points, bar, T, bars, sigmas, FACE_MAX_TUBES * TUBE_M)
                points, bar = points[on_face], bar[on_face]
            yield k, points, bar

    def adjusted(
        self, prior: Array, stamp_s: Array, stages: Stages, fits: int, every: int = 5, bars_min: int = 1,
        tilt_sigma_rad: float = 0.0, inertial: Inertial | None = None,
    ) -> tuple[Problem, PointEquations]:  # fmt: skip
        """Adjust the poses and the bars of `find_and_fit` together; returns also the equations of the last step.

        ``prior`` and ``stamp_s`` as for `solver.improve`, ``tilt_sigma_rad`` and ``inertial`` as for `Problem`. All
        steps of a stage use the same `bar_points`. Without an earlier adjustment, these include points far from the
        front faces.

        Raises `InputError` if fewer than ``bars_min`` bars have a known section.
        """
        bars = self.find_and_fit(fits, every).bars
        if bars.has_section.sum() < bars_min:
            raise InputError("too few bars whose sections are known")
        state = problem.start(self.T_world_sensor, prior, bars, tilt_sigma_rad, inertial)
        voxels = self.around(bars.segments)
        for pixels, steps in stages:
            flight = replace(self, T_world_sensor=state.T_world_sensor)
            chosen = (state.bars, self.before.sigma_ratio) if self.before else ()
            observations = Observations.gathered(flight.bar_points(voxels, 1, pixels, *chosen))
            for _ in range(steps):
                equations = linearised(state, observations)
                state = improve(state, equations, prior, stamp_s)
        return state, equations

    def fit(self, bars: Segments, every: int) -> FittedBars:
        """Fit a section (angle, circle or plane) to the points on each bar in one in ``every`` scans. The axes move
        to the centroids."""
        across, n = shapes.frames(bars.direction), len(bars)
        histogram, sightings = np.zeros((n, *shapes.HISTOGRAM)), np.zeros(n, dtype=np.int64)
        for k, points, bar in self.bar_points(self.around(bars), every):
            sightings += np.bincount(bar, minlength=n) >= 10
            shapes.accumulate(
                points, self.T_world_sensor[k], bar, bars.start, bars.direction, bars.length, across,
                END_TUBES * TUBE_M, histogram,
            )  # fmt: skip
        thickness = self.before.bars.thickness if self.before else self.settings.thickness or shapes.THICKNESS
        centre, slope, flange, turn, spread, tilt = fit_sections(histogram, bars.length, thickness)
        half = 0.5 * bars.length[:, None]
        start = bars.start + np.einsum("bk,bkx->bx", centre - half * slope, across)
        end = bars.end + np.einsum("bk,bkx->bx", centre + half * slope, across)
        sigma = np.where(np.isfinite(spread), spread, bars.radius / np.sqrt(np.maximum(bars.count, 1)))
        fitted = Bars(replace(bars, start=start, end=end), across, turn, flange, thickness)
        return FittedBars(fitted, sigma, tilt, sightings)

    def find_and_fit(self, fits: int, every: int = 5) -> FittedBars:
        """The bars of the voxels, fitted ``fits`` times to one in ``every`` scans. Bars extended to their joints have
        more points, so a second fit is more accurate. Raises `InputError` if there are no bars."""
        segments, reason = find_bars(self.voxels, grids=1)
        if not len(segments):
            raise InputError(reason)
        for _ in range(fits):
            fitted, segments = self.refined(segments, every)
        return fitted

    def refined(self, bars: Segments, every: int = 5, rise_m: float = math.inf) -> tuple[FittedBars, Segments]:
        """Fit the bars, then extend them to their joints and merge them (`merge_pieces`). With a finite ``rise_m``,
        bars whose direction is poorly determined keep their axes."""
        bars = trim_bends(bars)
        fitted = self.fit(bars, every)
        if rise_m < math.inf:
            is_weak, moved = ~(fitted.tilt <= TILT_DETERMINED_RAD), fitted.bars.segments
            moved.start[is_weak], moved.end[is_weak] = bars.start[is_weak], bars.end[is_weak]
        tied = _tied(fitted)
        return fitted, merge_pieces(tied.segments, tied.width_m, rise_m)


def _tied(fitted: FittedBars) -> Structure:
    """The structure of fitted bars after extending them to their joints."""
    bars = fitted.bars
    width = np.where(bars.is_bar, bars.flange, 2 * bars.segments.radius)
    joint, tie, segments = find_joints(bars.segments, width)
    angle = bars.turn + math.pi / 4  # of the bisector of the flanges
    opening = np.einsum("kb,bkx->bx", [np.cos(angle), np.sin(angle)], bars.across)
    tube = bars.has_section & np.isnan(bars.turn)
    return Structure(
        segments, bars.width_m, fitted.sightings, fitted.sigma, joint, tie, opening=opening,
        tube=tube if tube.any() else None,
    )  # fmt: skip


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
