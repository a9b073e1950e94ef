"""The final reconstruction: a whole corrected flight, or a plain cloud → `Structure`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.config import StructureSettings
from steelnb.datatypes import Array, IntArray, Scan, Segments
from steelnb.errors import EmptyCloudError, SettingsError
from steelnb.fusion import sections, sights
from steelnb.fusion.adjust import adjust
from steelnb.fusion.dimension import free_share, stands_out
from steelnb.fusion.joints import find_joints, trim_bends
from steelnb.fusion.merging import merge_pieces
from steelnb.fusion.ridges import ridge_points
from steelnb.fusion.section_fit import fit_sections
from steelnb.fusion.structure import Structure
from steelnb.hough.blocks import SHIFTS, segment_structure, within
from steelnb.mapping import VoxelMap
from steelnb.preprocess import smooth_ranges, voxel_grid

MARGIN = 1.2
"""Of the ends of a bar, in tubes: points this near to them do not tell its section."""
CHUNK = 1 << 17
GRIDS = 4
"""Of blocks in which bars are proposed. On flights eight find no more."""
FREE_SHARE_MIN = 0.5
"""Of the length of all lines, least share that runs free of surfaces and volumes (`dimension.free_share`)."""


def reconstruct(
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Structure:
    """Bars and joints of a structure from all scans of a flight and their corrected poses.

    Parameters
    ----------
    scans: K scans, points in the sensor frame, NaN for no return.
    T_world_drone: ``(K, 4, 4)``, the corrected poses.
    T_drone_sensor: ``(4, 4)``, the sensor's mount; by default the drone frame itself.
    settings: see `StructureSettings`.

    The axis of a bar is the line through the centroids of its sections (`fusion.sections`); a bar that was seen too
    little to tell its section and its direction is left out. With ``adjust``, poses and bars are adjusted together
    (`fusion.adjust`). Returns a `Structure`, empty where nothing looks like a bar, with the reason. Raises
    `SettingsError` for poses that do not fit the scans or are not finite, `EmptyCloudError` for scans without any
    return above the floor.
    """
    settings = settings or StructureSettings()
    T_world_drone = np.asarray(T_world_drone, dtype=np.float64)
    if T_world_drone.shape != (len(scans), 4, 4) or not np.isfinite(T_world_drone).all():
        raise SettingsError(f"T_world_drone of shape {T_world_drone.shape}: expected ({len(scans)}, 4, 4), all finite")
    T_world_sensor = T_world_drone if T_drone_sensor is None else T_world_drone @ T_drone_sensor
    # A quick reconstruction first: enough to know the sections of most bars, and by them to adjust the poses.
    if settings.adjust:
        flight = _Flight(scans, T_world_sensor, map_scans(scans, T_world_sensor, settings, every=3), settings)
        bars, _ = find_bars(flight.voxels, settings, grids=1)
        for _ in range(2 if len(bars) else 0):
            # Bars led to their joints show more of themselves, so a second look sees more, and more exactly.
            look, bars = flight.look_again(bars, T_world_sensor)
        if len(bars):
            T_world_sensor, _ = flight.adjust(look, T_world_sensor)
    flight = _Flight(scans, T_world_sensor, map_scans(scans, T_world_sensor, settings), settings)
    bars, reason = find_bars(flight.voxels, settings)
    if not len(bars):
        return Structure.empty(reason)
    _, bars = flight.look_again(bars, T_world_sensor)
    look = flight.look(trim_bends(bars, settings.bend_m), T_world_sensor, every=1, pixels=2)
    look = look.take(look.tilt <= settings.tilt_max_rad)  # not NaN: seen too little to tell a section
    if not len(look.bars):
        return Structure.empty("no bar was seen well enough to tell its direction")
    return _tied(look, settings)


def map_scans(scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings, every: int = 1) -> VoxelMap:
    """Scans at the poses ``(K, 4, 4)`` of the sensor as voxels, weights 1/range²; one in ``every`` scans.

    Ranges of organised scans are smoothed first: thin bars then stand out at twice the distance, in half the voxels.
    Raises `EmptyCloudError` where no return is left above the floor.
    """
    voxels = VoxelMap(settings.voxel_m)
    for k in range(0, len(scans), every):
        image = scans[k].points
        points = _flat(smooth_ranges(image) if image.ndim == 3 else image)
        voxels.insert(*sights.world(points, T_world_sensor[k], settings.range_max_m, settings.floor_m))
    if not len(voxels):
        raise EmptyCloudError(f"{len(scans)} scans without a return above the floor at {settings.floor_m} m")
    return voxels


def reconstruct_cloud(points: Array, settings: StructureSettings | None = None) -> Structure:
    """Bars and joints from a plain cloud ``(N, 3)``, in metres and finite, without a sensor's path.

    Nothing tells from where a point was seen, so the axis of a bar runs in the middle of its points; a cloud that was
    taken from all around has them around its bars. Raises `EmptyCloudError` for an empty cloud or one with
    coordinates that are not finite; returns an empty structure with a reason for a cloud without lines.
    """
    settings = settings or StructureSettings(floor_m=-1e6)
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingsError(f"points of shape {points.shape}: expected (N, 3)")
    bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
    if bad or not len(points):
        raise EmptyCloudError(f"cloud of {len(points)} points, {bad} of them not finite: expected some, all finite")
    voxels = VoxelMap(settings.voxel_m)
    for first in range(0, len(points), CHUNK):  # the map makes room for all points of a call
        some = points[first : first + CHUNK]
        voxels.insert(some[some[:, 2] >= settings.floor_m])
    if not len(voxels):
        raise EmptyCloudError(f"cloud without a point above the floor at {settings.floor_m} m")
    bars, reason = find_bars(voxels, settings, len(SHIFTS), coarse=True)
    if not len(bars):
        return Structure.empty(reason)
    none = np.full(len(bars), np.nan)
    sigma = bars.radius / np.sqrt(np.maximum(bars.count, 1))
    return _tied(
        _Look(bars, np.zeros((0, 2, 3)), none, none, sigma, none, np.ones(len(bars), dtype=np.int64)), settings
    )


def find_bars(
    voxels: VoxelMap, settings: StructureSettings, grids: int = GRIDS, coarse: bool = False
) -> tuple[Segments, str]:
    """Bars of a voxel map, their axes in the middle of their points; and why there are none.

    ``coarse``: bars may be only a few tubes apart.
    """
    s = settings
    points = _ridges(voxels, None, s.contract_m, s.tube_m, s)
    if len(points) < s.min_votes or not np.linalg.norm(np.ptp(points, axis=0)) > 2 * s.length_min_m:
        return Segments.empty(), f"{len(points)} points on ridges: too few or too close together for a bar"
    lines = segment_structure(points, s.tube_m, s.min_votes, s.length_min_m / s.tube_m, grids)
    bars = merge_pieces(lines, s.gap_max_m, s.copy_distance_m, s.tube_m)
    if not len(bars):
        return bars, f"none of {len(points)} points on ridges lie along a line"
    # A short bar between long ones is weak beside them, and its ends lie within their tubes: look at what they leave.
    hidden = within(voxels.means(), bars, s.strut_hide_m)
    left = _ridges(voxels, hidden, s.strut_contract_m, s.strut_tube_m, s)
    if len(left) >= s.min_votes:
        more = segment_structure(left, s.strut_tube_m, s.min_votes, s.strut_length_min_m / s.strut_tube_m, grids)
        more = more.take(_between_bars(more, bars, s.reach_m, s.tube_m))
        bars = merge_pieces(Segments.joined((bars, more)), s.gap_max_m, s.copy_distance_m, s.tube_m)
    # Lines can be laid through any cloud. A bar in the thick of others looks solid, but not most of a structure; unless
    # the cloud is so coarse that all its bars are near others.
    if free_share(points, bars, 2 * s.tube_m) < FREE_SHARE_MIN and not (
        coarse and stands_out(points, lines, s.tube_m, s.min_votes, s.length_min_m / s.tube_m)
    ):
        return Segments.empty(), f"most of {len(bars)} lines run in surfaces or in solid stuff"
    return bars, ""


def _ridges(
    voxels: VoxelMap, leave: np.ndarray | None, contract_m: float, tube_m: float, s: StructureSettings
) -> Array:
    points = ridge_points(voxels, s.ridge_radius_m, s.ridge_share, contract_m, leave)
    return voxel_grid(points, tube_m / math.sqrt(3))


def _between_bars(some: Segments, bars: Segments, lead_m: float, aside_m: float) -> np.ndarray:
    """Which of some segments come within ``aside_m`` of a bar at either end, led on by up to ``lead_m``."""
    step = np.arange(0, lead_m + 1e-9, 0.03)[:, None, None]
    led = np.stack([some.start - step * some.direction, some.end + step * some.direction])
    near = within(led.reshape(-1, 3), bars, aside_m).reshape(led.shape[:3])
    return np.asarray(near.any(axis=1).all(axis=0))


@dataclass(frozen=True)
class _Look:
    """Bars after a look at their sections: width NaN and turn of no meaning where there was too little to see."""

    bars: Segments
    across: Array
    width: Array
    turn: Array
    sigma: Array
    tilt: Array
    sightings: IntArray

    def take(self, mask: NDArray[np.bool_]) -> "_Look":
        return _Look(
            self.bars.take(mask), self.across[mask], self.width[mask], self.turn[mask], self.sigma[mask],
            self.tilt[mask], self.sightings[mask],
        )  # fmt: skip


@dataclass(frozen=True)
class _Flight:
    """The scans with the poses at which they went into the voxels."""

    scans: Sequence[Scan]
    T_world_sensor: Array
    voxels: VoxelMap
    settings: StructureSettings

    def sights(self, bars: Segments, poses: Array, every: int, pixels: int) -> Iterator[tuple[int, Array, IntArray]]:
        """Scans' numbers, points in the world at other ``poses``, and their bars, which the voxels know."""
        s, (grid, _) = self.settings, self.voxels.grid()
        owner = sights.owners(
            bars.start, bars.direction, bars.length, self.voxels.means(), 2.0 * s.tube_m, 0.5 * s.tube_m
        )
        for k in range(0, len(self.scans), every):
            points = _flat(self.scans[k].points)[k % pixels :: pixels]
            placed, bar = sights.on_bars(
                points, self.T_world_sensor[k], poses[k], s.range_max_m, s.floor_m, owner, grid.voxel_m, grid.key,
                grid.slot,
            )  # fmt: skip
            yield k, placed, bar

    def look(self, bars: Segments, poses: Array, every: int, pixels: int = 1) -> _Look:
        """Go through the scans, each bar's points apart; the bars with their axes moved to their centroids."""
        across, n = sections.frames(bars.direction), len(bars)
        histogram, sightings = sections.empty_histogram(n), np.zeros(n, dtype=np.int64)
        for k, points, bar in self.sights(bars, poses, every, pixels):
            sightings += np.bincount(bar, minlength=n) >= 10 // pixels
            sections.look(
                points, poses[k, :3, 3], bar, bars.start, bars.direction, bars.length, across,
                MARGIN * self.settings.tube_m, histogram,
            )  # fmt: skip
        centre, slope = np.zeros((n, 2)), np.zeros((n, 2))
        flange, turn, spread, tilt = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        fit_sections(histogram, bars.length, centre, slope, flange, turn, spread, tilt)
        half = 0.5 * bars.length[:, None]
        start = bars.start + np.einsum("bk,bkx->bx", centre - half * slope, across)
        end = bars.end + np.einsum("bk,bkx->bx", centre + half * slope, across)
        sigma = np.where(np.isfinite(spread), spread, bars.radius / np.sqrt(np.maximum(bars.count, 1)))
        return _Look(Segments(start, end, bars.count, bars.radius), across, flange, turn, sigma, tilt, sightings)

    def look_again(self, bars: Segments, poses: Array) -> tuple[_Look, Segments]:
        """A quick look at bars cut at bends; and those bars tied at joints, their pieces and copies merged."""
        s, look = self.settings, self.look(trim_bends(bars, self.settings.bend_m), poses, every=5)
        return look, merge_pieces(_tied(look, s).segments, s.gap_max_m, s.copy_distance_m, s.tube_m, look.width)

    def adjust(self, look: _Look, poses: Array) -> tuple[Array, Segments]:
        return adjust(look.bars, look.turn, look.width, look.across, poses, lambda T: self.sights(look.bars, T, 1, 4))


def _tied(look: _Look, settings: StructureSettings) -> Structure:
    known = np.where(np.isfinite(look.width), look.width, 2 * look.bars.radius)
    joint, tie, bars = find_joints(
        look.bars, known, settings.slack_m, settings.reach_m, settings.same_m, settings.bend_m
    )
    return Structure(bars, look.width, look.sightings, look.sigma, joint, tie)


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
