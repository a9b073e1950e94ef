"""The final reconstruction: all scans of a flight with corrected poses → `Structure`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import InputError
from steelnb.fusion import problem, sections, solver
from steelnb.fusion.bar_voxels import BarVoxels, Observations, world_points
from steelnb.fusion.joints import between_joints, find_joints, trim_bends
from steelnb.fusion.merging import COPY_M, GAP_MAX_M, merge_pieces
from steelnb.fusion.poses import DRIFT_PERIOD_S
from steelnb.fusion.problem import Bars
from steelnb.fusion.proposals import TUBE_M, VOXEL_M, find_bars, find_struts
from steelnb.fusion.round_fit import fit_rounds
from steelnb.fusion.section_fit import fit_sections
from steelnb.fusion.structure import Structure
from steelnb.points import VoxelMap, smooth_ranges
from steelnb.settings import StructureSettings
from steelnb.types import Array, IntArray, Scan, Segments

END_TUBES = 1.2
"""Points within this many tubes of the ends of a bar are left out of the fit of its section."""
TILT_DETERMINED_RAD, TILT_MAX_RAD = 0.02, 0.1
"""A bar whose direction has a standard deviation above the first is not turned by the fit of its section, and runs from
joint to joint in the end; above the second it is left out. Chosen on the development seed 11."""
ADJUST_STEPS, ADJUST_PIXELS = 2, 4
REACH_TUBES, MARGIN_TUBES = 2.4, 0.5
"""A point belongs to the bar that its voxel is nearest to, within reach; not where a second one is hardly farther."""
FACE_SIGMAS, FACE_MAX_TUBES, RATIO_MIN = 2.5, 1.3, 0.8
"""How far from the front face of its bar a point of an adjustment may lie, in standard deviations of the range noise,
and at most. On the development seeds 11 and 12 errors are alike from 2 to 3 of them with ``starling2``; with the
report's sensor a larger bound leaves too few points of the first scan, which says where the whole stands. With a range
noise below `RATIO_MIN` times that of `points.ranges` it is the poses and sections that are off, not the points."""


def reconstruct(
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Structure:
    """Bars and joints of a structure from all scans of a flight and their smoothed or corrected poses.

    Two passes: the bars that stand out, and the shorter ones that show between them once their sections are fitted.

    Parameters
    ----------
    scans: K scans, points in the sensor frame, NaN for no return; read several times, one in memory at a time.
    T_world_drone: ``(K, 4, 4)``, the corrected poses.
    T_drone_sensor: ``(4, 4)``, the sensor's mount; by default the drone frame itself.
    settings: see `StructureSettings`.

    The axis of a bar is the line through the centroids of its sections, angles (`fusion.section_fit`) or circles
    (`fusion.round_fit`); a bar with too few points to tell its section and its direction is left out. With ``adjust``,
    poses and bars are adjusted together first (`fusion.problem`), as smoothing does better. Returns a `Structure` in
    the world frame, metres; an empty one has the reason. Raises `InputError` for poses that do not fit the scans or are
    not finite, and for scans without any return above the floor.
    """
    settings = settings or StructureSettings()
    T_world_sensor = sensor_poses(T_world_drone, T_drone_sensor, len(scans))
    if settings.adjust:
        flight, fitted, _ = map_and_fit(scans, T_world_sensor, settings)
        if fitted is not None:
            T_world_sensor = flight.adjusted(fitted)
    flight = MappedScans(scans, T_world_sensor, map_scans(scans, T_world_sensor, settings), settings)
    bars, reason = find_bars(flight.voxels, rise_m=TUBE_M)
    if not len(bars):
        return Structure.empty(reason)
    bars = flight.refine_closely(bars)
    # Short bars that the first axes hid, through the middles of their points, show between those of fitted sections.
    more = find_struts(flight.voxels, bars, TUBE_M)
    bars = flight.refine_closely(merged(Segments.joined((bars, more))))
    fitted = flight.fit(trim_bends(bars), every=1)
    fitted = fitted.take(fitted.tilt <= TILT_MAX_RAD)  # not NaN: too few points to tell a section
    if not len(fitted.bars):
        return Structure.empty("no bar was seen well enough to tell its direction")
    structure = _tied(fitted)
    return replace(structure, segments=between_joints(structure, fitted.tilt > TILT_DETERMINED_RAD))


def sensor_poses(T_world_drone: Array, T_drone_sensor: Array | None, count: int) -> Array:
    """Poses of the sensor ``(K, 4, 4)`` from those of the drone and the mount of the sensor, None for the drone frame.

    Raises `InputError` for poses of the drone that are not ``count`` or not finite.
    """
    T_world_drone = np.asarray(T_world_drone, dtype=np.float64)
    if T_world_drone.shape != (count, 4, 4) or not np.isfinite(T_world_drone).all():
        raise InputError(f"T_world_drone of shape {T_world_drone.shape}: expected ({count}, 4, 4), all finite")
    return T_world_drone if T_drone_sensor is None else T_world_drone @ T_drone_sensor


def map_scans(scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings, every: int = 1) -> VoxelMap:
    """One in ``every`` scans at the poses ``(K, 4, 4)`` of the sensor, accumulated in voxels with weights 1/range².

    Ranges of organised scans are smoothed first: thin bars are then found at twice the distance, in half the voxels.
    Raises `InputError` where no return is left above the floor.
    """
    voxels = VoxelMap(VOXEL_M)
    for k, scan in zip(range(0, len(scans), every), scans[::every], strict=True):
        image = scan.points
        points = _flat(smooth_ranges(image))
        voxels.insert(*world_points(points, T_world_sensor[k], settings.range_max_m, settings.floor_m))
    if not len(voxels):
        raise InputError(f"{len(scans)} scans without a return above the floor at {settings.floor_m} m")
    return voxels


@dataclass(frozen=True)
class FittedBars:
    """B bars with their fitted sections: frames ``across (B, 2, 3)``, ``width`` of the flange, ``turn``, standard
    deviations ``sigma`` of the axis and ``tilt`` of its direction, ``sightings``; width and tilt NaN for too few
    points. A round tube has its diameter for a width, and a turn of NaN."""

    bars: Segments
    across: Array
    width: Array
    turn: Array
    sigma: Array
    tilt: Array
    sightings: IntArray

    def take(self, mask: NDArray[np.bool_]) -> "FittedBars":
        return FittedBars(
            self.bars.take(mask), *(column[mask] for name, column in vars(self).items() if name != "bars")
        )


@dataclass(frozen=True)
class MappedScans:
    """The scans, and the poses of the sensor at which they were accumulated in the voxels."""

    scans: Sequence[Scan]
    T_world_sensor: Array
    voxels: VoxelMap
    settings: StructureSettings

    def around(self, bars: Segments) -> BarVoxels:
        """The voxels around bars, in which their points are looked up."""
        return BarVoxels.around(bars, REACH_TUBES * TUBE_M, MARGIN_TUBES * TUBE_M, self.voxels.voxel_m)

    def bar_points(self, voxels: BarVoxels, every: int, pixels: int) -> Iterator[tuple[int, Array, IntArray]]:
        """For one in ``every`` scans, of one in ``pixels`` of its points: the number of the scan, the points on bars in
        the sensor frame, and their bars."""
        s = self.settings
        for k, scan in zip(range(0, len(self.scans), every), self.scans[::every], strict=True):
            some = _flat(scan.points)[k % pixels :: pixels]
            yield k, *voxels.points_on_bars(some, self.T_world_sensor[k], s.range_max_m, s.floor_m)

    def face_points(
        self, voxels: BarVoxels, bars: Bars, sigma_ratio: float | None, pixels: int = 1
    ) -> Iterator[tuple[int, Array, IntArray]]:
        """As `bar_points` of all scans, only those within `FACE_SIGMAS` standard deviations of the front faces of bars,
        whose choice does not depend on their noise (`fusion.bar_voxels`). The range noise is ``sigma_ratio`` times that
        of `points.ranges`; with None it is unknown, and all points are taken."""
        if sigma_ratio is None:
            yield from self.bar_points(voxels, 1, pixels)
            return
        corner, sigmas = sections.outlines(bars.turn, bars.flange), FACE_SIGMAS * max(sigma_ratio, RATIO_MIN)
        most_m = FACE_MAX_TUBES * TUBE_M
        for k, points, bar in self.bar_points(voxels, 1, pixels):
            T = self.T_world_sensor[k]
            on_face = voxels.on_face(points, bar, T, bars.segments, bars.across, corner, sigmas, most_m)
            yield k, points[on_face], bar[on_face]

    def adjusted(self, fitted: "FittedBars") -> Array:
        """The poses after `ADJUST_STEPS` of them and the bars together (`fusion.problem`), by one in `ADJUST_PIXELS` of
        the points. The poses themselves stand for the prior's increments, and the first one stays."""
        T, stamp_s = self.T_world_sensor, DRIFT_PERIOD_S * np.arange(len(self.scans), dtype=np.float64)
        state = problem.start(T, T, Bars(fitted.bars, fitted.across, fitted.turn, fitted.width))
        observations = Observations.gathered(self.bar_points(self.around(fitted.bars), 1, ADJUST_PIXELS))
        return solver.adjusted(state, observations, T, stamp_s, ADJUST_STEPS)[0].T_world_sensor

    def fit(self, bars: Segments, every: int, pixels: int = 1) -> FittedBars:
        """Fit sections, angles or circles, to the points of each bar; the axes of the bars move to their centroids."""
        across, n = sections.frames(bars.direction), len(bars)
        histogram, sightings = sections.empty_histogram(n), np.zeros(n, dtype=np.int64)
        for k, points, bar in self.bar_points(self.around(bars), every, pixels):
            sightings += np.bincount(bar, minlength=n) >= 10 // pixels
            sections.accumulate(
                points, self.T_world_sensor[k], bar, bars.start, bars.direction, bars.length, across,
                END_TUBES * TUBE_M, histogram,
            )  # fmt: skip
        fitted = fit_sections(histogram, bars.length)
        fit_rounds(histogram, bars.length, fitted)
        centre, slope, flange, turn, spread, tilt = fitted
        half = 0.5 * bars.length[:, None]
        start = bars.start + np.einsum("bk,bkx->bx", centre - half * slope, across)
        end = bars.end + np.einsum("bk,bkx->bx", centre + half * slope, across)
        sigma = np.where(np.isfinite(spread), spread, bars.radius / np.sqrt(np.maximum(bars.count, 1)))
        return FittedBars(Segments(start, end, bars.count, bars.radius), across, flange, turn, sigma, tilt, sightings)

    def refine(self, bars: Segments, every: int = 5) -> tuple[FittedBars, Segments]:
        """Fit bars cut at bends to one in ``every`` scans; and those bars tied at joints, their pieces and copies
        merged."""
        fitted = self.fit(trim_bends(bars), every)
        return fitted, merge_pieces(_tied(fitted).segments, GAP_MAX_M, COPY_M, TUBE_M, fitted.width)

    def refine_closely(self, bars: Segments) -> Segments:
        """As `refine` for the last passes: a fit that does not tell the direction of a bar does not turn it, and braces
        at an acute angle to their chord are no copies of it (`merged`)."""
        bars = trim_bends(bars)
        fitted = self.fit(bars, every=5)
        is_determined = (fitted.tilt <= TILT_DETERMINED_RAD)[:, None]
        start = np.where(is_determined, fitted.bars.start, bars.start)
        end = np.where(is_determined, fitted.bars.end, bars.end)
        fitted = replace(fitted, bars=Segments(start, end, bars.count, bars.radius))
        return merged(_tied(fitted).segments, fitted.width)

    def find_and_fit(self, fits: int, every: int = 5) -> tuple[FittedBars | None, str]:
        """The bars of the voxels, fitted ``fits`` times to one in ``every`` scans; or None, and the reason."""
        bars, reason = find_bars(self.voxels, grids=1)
        fitted = None
        for _ in range(fits if len(bars) else 0):
            # Bars extended to their joints have more points, so a second fit is more exact.
            fitted, bars = self.refine(bars, every)
        return fitted if len(bars) else None, reason


def map_and_fit(
    scans: Sequence[Scan],
    T_world_sensor: Array,
    settings: StructureSettings,
    fits: int = 2,
) -> tuple[MappedScans, FittedBars | None, str]:
    """A quick reconstruction, enough to know the sections of most bars: one in three scans at the poses ``(K, 4, 4)``
    of the sensor mapped, and the bars fitted, ``fits`` times; or None, and the reason. Raises `InputError` as
    `map_scans`."""
    flight = MappedScans(scans, T_world_sensor, map_scans(scans, T_world_sensor, settings, every=3), settings)
    return flight, *flight.find_and_fit(fits)


def merged(bars: Segments, width_m: Array | None = None) -> Segments:
    """Pieces and copies merged; a bar that rises by more than a tube across a stronger one is no copy of it."""
    return merge_pieces(bars, GAP_MAX_M, COPY_M, TUBE_M, width_m, TUBE_M)


def _tied(fitted: FittedBars) -> Structure:
    width = np.where(np.isfinite(fitted.width), fitted.width, 2 * fitted.bars.radius)
    joint, tie, bars = find_joints(fitted.bars, width)
    angle = fitted.turn + math.pi / 4  # the flanges are alike, so their bisector tells the turn of a section
    opening = np.einsum("kb,bkx->bx", [np.cos(angle), np.sin(angle)], fitted.across)
    tube = np.isfinite(fitted.width) & np.isnan(fitted.turn)
    return Structure(
        bars, fitted.width, fitted.sightings, fitted.sigma, joint, tie, opening=opening,
        tube=tube if tube.any() else None,
    )  # fmt: skip


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
