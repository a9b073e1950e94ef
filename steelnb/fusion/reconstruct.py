"""The final reconstruction: a whole corrected flight, or a plain cloud → `Structure`."""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from steelnb.config import StructureSettings
from steelnb.datatypes import Array, IntArray, Scan, Segments
from steelnb.errors import EmptyCloudError, SettingsError
from steelnb.fusion import sections
from steelnb.fusion.joints import find_joints, trim_bends
from steelnb.fusion.merging import merge_pieces
from steelnb.fusion.ridges import ridge_points
from steelnb.fusion.structure import Structure
from steelnb.hough.blocks import segment_structure, within
from steelnb.mapping import VoxelMap
from steelnb.mapping.kernels import find, pack
from steelnb.preprocess import voxel_grid


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
    little to tell its section has its axis in the middle of its points, and a width of NaN. Returns a `Structure`,
    empty where nothing looks like a bar, with the reason. Raises `SettingsError` for poses that do not fit the scans
    or are not finite, `EmptyCloudError` for scans without any return above the floor.
    """
    settings = settings or StructureSettings()
    T_world_drone = np.asarray(T_world_drone, dtype=np.float64)
    if T_world_drone.shape != (len(scans), 4, 4) or not np.isfinite(T_world_drone).all():
        raise SettingsError(f"T_world_drone of shape {T_world_drone.shape}: expected ({len(scans)}, 4, 4), all finite")
    T_world_sensor = T_world_drone if T_drone_sensor is None else T_world_drone @ T_drone_sensor
    voxels = VoxelMap(settings.voxel_m)
    for scan, T in zip(scans, T_world_sensor, strict=True):
        points, weight = _world(_flat(scan.points), T, settings.range_max_m, settings.floor_m)
        voxels.insert(points, weight)
    if not len(voxels):
        raise EmptyCloudError(f"{len(scans)} scans without a return above the floor at {settings.floor_m} m")
    bars, reason = find_bars(voxels, settings)
    if not len(bars):
        return Structure.empty(reason)
    # Bars led to their joints show more of themselves, so the second look sees more, and more exactly.
    for every in (5, 1):
        some = slice(None, None, every)
        bars = trim_bends(bars, settings.bend_m)
        bars, width, sigma, sightings = _look_at_sections(bars, voxels, scans[some], T_world_sensor[some], settings)
        if every > 1:
            bars = _tied(bars, width, sigma, sightings, settings).segments
            bars = merge_pieces(bars, settings.gap_max_m, settings.copy_distance_m, settings.tube_m)
    return _tied(bars, width, sigma, sightings, settings)


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
    voxels.insert(points[points[:, 2] >= settings.floor_m])
    if not len(voxels):
        raise EmptyCloudError(f"cloud without a point above the floor at {settings.floor_m} m")
    bars, reason = find_bars(voxels, settings)
    if not len(bars):
        return Structure.empty(reason)
    none = np.full(len(bars), np.nan)
    sigma = bars.radius / np.sqrt(np.maximum(bars.count, 1))
    return _tied(bars, none, sigma, np.ones(len(bars), dtype=np.int64), settings)


def find_bars(voxels: VoxelMap, settings: StructureSettings) -> tuple[Segments, str]:
    """Bars of a voxel map, their axes in the middle of their points; and why there are none."""
    s = settings
    points = _ridges(voxels, None, s)
    if len(points) < s.min_votes or not np.linalg.norm(np.ptp(points, axis=0)) > 2 * s.length_min_m:
        return Segments.empty(), f"{len(points)} points on ridges: too few or too close together for a bar"
    bars = segment_structure(points, s.tube_m, s.min_votes, s.length_min_m / s.tube_m)
    bars = merge_pieces(bars, s.gap_max_m, s.copy_distance_m, s.tube_m)
    if not len(bars):
        return bars, f"none of {len(points)} points on ridges lie along a line"
    # A short bar between long ones is weak beside them, and its ends lie within their tubes: look at what they leave.
    means = voxels.means()
    left = _ridges(voxels, within(means, bars, 1.25 * s.tube_m), s)
    if len(left) >= s.min_votes:
        more = segment_structure(left, s.tube_m, max(2, s.min_votes - 3), s.strut_length_min_m / s.tube_m)
        more = more.take(_between_bars(more, bars, s.reach_m, s.tube_m))
        bars = merge_pieces(_together(bars, more), s.gap_max_m, s.copy_distance_m, s.tube_m)
    return bars, ""


def _ridges(voxels: VoxelMap, leave: np.ndarray | None, s: StructureSettings) -> Array:
    points = ridge_points(voxels, s.ridge_radius_m, s.ridge_share, s.contract_m, leave)
    return voxel_grid(points, s.tube_m / math.sqrt(3))


def _together(some: Segments, others: Segments) -> Segments:
    names = ("start", "end", "count", "radius")
    return Segments(*(np.concatenate([getattr(each, name) for each in (some, others)]) for name in names))


def _between_bars(some: Segments, bars: Segments, lead_m: float, aside_m: float) -> np.ndarray:
    """Which of some segments come within ``aside_m`` of a bar at either end, led on by up to ``lead_m``."""
    tied = np.ones(len(some), dtype=bool)
    for end, sign in ((some.start, -1.0), (some.end, 1.0)):
        near = np.zeros(len(some), dtype=bool)
        for step in np.arange(0, lead_m + 1e-9, 0.03):
            near |= within(end + sign * step * some.direction, bars, aside_m)
        tied &= near
    return tied


def _look_at_sections(
    bars: Segments, voxels: VoxelMap, scans: Sequence[Scan], T_world_sensor: Array, settings: StructureSettings
) -> tuple[Segments, Array, Array, IntArray]:
    """Go through the scans again, each bar's points apart; bars with their axes moved, widths, sigma, sightings."""
    grid, _ = voxels.grid()
    owner = _owners(
        bars.start, bars.direction, bars.length, voxels.means(), grid.voxel_m, 2.0 * settings.tube_m,
        0.5 * settings.tube_m, grid.key, grid.slot,
    )  # fmt: skip
    across = sections.frames(bars.direction)
    histogram = sections.empty_histogram(len(bars))
    sightings = np.zeros(len(bars), dtype=np.int64)
    for scan, T in zip(scans, T_world_sensor, strict=True):
        points, _ = _world(_flat(scan.points), T, settings.range_max_m, settings.floor_m)
        bar = _bars_of(points, owner, grid.voxel_m, grid.key, grid.slot)
        sightings += np.bincount(bar[bar >= 0], minlength=len(bars)) >= 10
        sections.look(
            points, T[:3, 3], bar, bars.start, bars.direction, bars.length, across, 2.5 * settings.tube_m, histogram
        )
    centre, slope = np.zeros((len(bars), 2)), np.zeros((len(bars), 2))
    flange, spread = np.zeros(len(bars)), np.zeros(len(bars))
    sections.fit_sections(histogram, bars.length, centre, slope, flange, spread)
    half = 0.5 * bars.length[:, None]
    start = bars.start + np.einsum("bk,bkx->bx", centre - half * slope, across)
    end = bars.end + np.einsum("bk,bkx->bx", centre + half * slope, across)
    sigma = np.where(np.isfinite(spread), spread, bars.radius / np.sqrt(np.maximum(bars.count, 1)))
    return Segments(start, end, bars.count, bars.radius), flange, sigma, sightings


def _tied(bars: Segments, width: Array, sigma: Array, sightings: IntArray, settings: StructureSettings) -> Structure:
    known = np.where(np.isfinite(width), width, 2 * bars.radius)
    joint, tie, bars = find_joints(bars, known, settings.slack_m, settings.reach_m, settings.same_m, settings.bend_m)
    return Structure(bars, width, sightings, sigma, joint, tie)


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)


@njit(cache=True)
def _world(points, T, range_max, floor):  # type: ignore[no-untyped-def]
    """Points ``(N, 3)`` of a scan in the world frame and their weights, 1/range²; no NaN, nothing below the floor."""
    placed, weight = np.empty((len(points), 3)), np.empty(len(points))
    n = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y + z * z
        if not 0.0 < square <= range_max * range_max:  # NaN too
            continue
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if height < floor:
            continue
        placed[n, 0] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        placed[n, 1] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        placed[n, 2] = height
        weight[n] = 1.0 / square
        n += 1
    return placed[:n], weight[:n]


@njit(cache=True)
def _owners(start, direction, length, mean, voxel, radius, margin, table_key, table_slot):  # type: ignore[no-untyped-def]
    """The bar of each voxel: the nearest within ``radius``, or −1 where another is nearly as near (``margin``)."""
    owner = np.full(len(mean), -1, np.int64)
    first, second = np.full(len(mean), np.inf), np.full(len(mean), np.inf)
    last = np.full(len(mean), -1, np.int64)
    reach = int(radius / voxel) + 1
    for b in range(len(length)):
        steps = int(length[b] / voxel) + 1
        for k in range(steps + 1):
            at = start[b] + length[b] * k / steps * direction[b]
            i0, j0, k0 = int(np.floor(at[0] / voxel)), int(np.floor(at[1] / voxel)), int(np.floor(at[2] / voxel))
            for i in range(i0 - reach, i0 + reach + 1):
                for j in range(j0 - reach, j0 + reach + 1):
                    for m in range(k0 - reach, k0 + reach + 1):
                        slot = find(pack(i, j, m), table_key, table_slot)
                        if slot < 0 or last[slot] == b:
                            continue
                        last[slot] = b
                        r = mean[slot] - start[b]
                        t = min(max((r * direction[b]).sum(), 0.0), length[b])
                        r = r - t * direction[b]
                        distance = math.sqrt((r * r).sum())
                        if distance < first[slot]:
                            first[slot], second[slot] = distance, first[slot]
                            owner[slot] = b
                        elif distance < second[slot]:
                            second[slot] = distance
    for slot in range(len(owner)):
        if first[slot] > radius or second[slot] - first[slot] < margin:
            owner[slot] = -1
    return owner


@njit(cache=True)
def _bars_of(points, owner, voxel, table_key, table_slot):  # type: ignore[no-untyped-def]
    bar = np.full(len(points), -1, np.int64)
    inverse = 1.0 / voxel
    for n in range(len(points)):
        i, j, k = (
            np.int64(np.floor(points[n, 0] * inverse)), np.int64(np.floor(points[n, 1] * inverse)),
            np.int64(np.floor(points[n, 2] * inverse)),
        )  # fmt: skip
        slot = find(pack(i, j, k), table_key, table_slot)
        if slot >= 0:
            bar[n] = owner[slot]
    return bar
