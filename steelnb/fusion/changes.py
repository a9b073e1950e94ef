"""Changes of a known structure, bar by bar, from the scans of a new flight that was localised in it.

A bar is missing where rays went through its place, and stands where they ended there; what is hidden by others or out
of sight tells nothing. It has moved or is bent where the front faces and the outline of its points lie beside the
mapped ones by more than both flights' errors. Bars that no mapped one explains are new.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import stats

from steelnb.errors import EmptyCloudError, SettingsError
from steelnb.fusion import sections
from steelnb.fusion.known import KnownBars
from steelnb.fusion.point_association import world_points
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.structure import Structure
from steelnb.settings import StructureSettings
from steelnb.types import Array, IntArray, Scan, Segments

SIGNIFICANCE, BENT = 0.05, 0.01
"""A bar has changed if its p-value, corrected for the number of bars, is smaller; one of those is bent, and has not
moved, if the p-value of no bow is smaller than the second."""
SIGMA_DEPTH_M, SIGMA_BESIDE_M, SIGMA_POINT_M = 0.004, 0.008, 0.02
"""Standard deviations of the place of a bar as seen from one direction, along a sixth of it: of its front faces, and of
the middle of its outline, which do not average out over points; and that of one point, which does."""
SIGMA_SHARE, SIGMA_M, SIGMA_BOW_M = 0.25, 0.003, 0.003
"""Systematic errors of the front faces of a mapped bar: a share of that of its axis, which sections seen from few sides
leave open, and a floor; and that of its straightness."""
FREE_SIGMA_M = 0.1
"""How far a bar may have moved in directions that its points do not tell."""
END_M, BESIDE_MAX_M, DEPTH_MAX_M = 0.15, 0.03, 0.1
"""Points so near the ends of a bar, so far beside its outline, or before or behind its faces are those of others."""
GROUP_POINTS_MIN, GROUPS_MIN, WHOLE_SHARE, STEP_MAX_M, STEPS = 20, 3, 0.8, 0.04, 8
STATION_M, STATIONS_MIN, GATE_M, PIXEL_SLACK = 0.05, 3, 0.12, 1
"""A bar is looked for every 5 cm along its axis, within so much of the expected range and so many pixels around."""
SCANS_ALIKE, VIEWS_MIN, THROUGH_SHARE, GONE_SHARE = 5, 2, 0.03, 0.25
"""So many scans that see a bar count as one view; fewer views tell nothing; of a bar that stands, at most this share of
the views goes through it, of one that is missing more than the last, and of one that has moved something between. All
settings were chosen on the development seeds 11 and 12."""
PINHOLE_SCANS = 20
KINDS = ("same", "missing", "moved", "bent", "not seen", "new")


@dataclass(frozen=True)
class Changes:
    """The bars of a map in a later flight.

    ``kind``: for each of the B bars of the map "same", "missing", "moved", "bent" or "not seen", then "new" for each
    bar of ``new``, which the map does not hold. ``offset_m``: mean offset across a bar, of a bent one that of its
    middle, of a new one the distance of its middle from the nearest bar of the map; ``sigma_m`` its standard deviation;
    both NaN where a bar is missing or not measured. ``significance``: p-value of the hypothesis that the bar is as it
    was, corrected for the number of bars; NaN where it was not seen. All ``(B + new,)``.
    """

    known: Structure
    new: Structure
    kind: tuple[str, ...]
    offset_m: Array
    sigma_m: Array
    significance: Array

    def of(self, kind: str) -> IntArray:
        """The bars of a kind, counted through the map and then the new ones."""
        return np.flatnonzero(np.array(self.kind) == kind)

    @property
    def segments(self) -> Segments:
        """The axes of the map's bars and then of the new ones."""
        return Segments.joined((self.known.segments, self.new.segments))


def find_changes(
    known: Structure,
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Changes:
    """Compare a known structure with the scans of a later flight.

    Parameters
    ----------
    known: the map; world frame, metres. Raises `EmptyStructureError` for one without bars.
    scans: K scans, points in the sensor frame, NaN for no return. That a bar is missing can be told from images
        ``(H, W, 3)`` of a pinhole camera alone, since the rays without a return must be known.
    T_world_drone: ``(K, 4, 4)``, poses in the frame of the map, as `KnownStructureOdometry` gives them. Raises
        `SettingsError` for poses that do not fit the scans or are not finite.
    T_drone_sensor: ``(4, 4)``, the sensor's mount; by default the drone frame itself.
    settings: the floor and the range; what a new bar is.
    """
    settings, bars = settings or StructureSettings(), KnownBars(known)
    if T_world_drone.shape != (len(scans), 4, 4) or not np.isfinite(T_world_drone).all():
        raise SettingsError(f"T_world_drone of shape {T_world_drone.shape}: expected ({len(scans)}, 4, 4), all finite")
    T = T_world_drone if T_drone_sensor is None else T_world_drone @ T_drone_sensor
    views = _Views(bars, settings)
    camera = _pinhole(scans)
    for k, scan in enumerate(scans):
        views.add(scan, T[k], camera)
    kind, p = np.full(len(bars), "same", dtype=object), np.ones(len(bars))
    offset_m, sigma_m, p_moved, p_bent = _displaced(views.histogram, bars)
    through, seen = views.looks.T // SCANS_ALIKE
    p_missing = np.where(seen >= VIEWS_MIN, stats.binom.sf(through - 1, seen, THROUGH_SHARE), 1.0)
    gone = through > GONE_SHARE * seen
    measured = np.isfinite(p_moved) & ~gone
    p = np.where(gone, p_missing, np.where(measured, p_moved, 1.0))
    told = measured | (seen >= VIEWS_MIN)
    p[told] = holm(p[told])
    kind[(p < SIGNIFICANCE) & measured] = "moved"
    kind[(p < SIGNIFICANCE) & measured & (p_bent < BENT)] = "bent"
    kind[(p < SIGNIFICANCE) & gone] = "missing"
    kind[~told] = "not seen"
    p[~told] = np.nan
    offset_m, sigma_m = (np.where(measured, each, np.nan) for each in (offset_m, sigma_m))
    new = _new_bars(scans, T_world_drone, T_drone_sensor, T, bars, settings)
    beside, beside_sigma = _beside(new, known)
    return Changes(
        known, new, (*kind.tolist(), *["new"] * len(new)), np.append(offset_m, beside),
        np.append(sigma_m, beside_sigma), np.append(p, holm(stats.chi2.sf((beside / beside_sigma) ** 2, 2))),
    )  # fmt: skip


def holm(p_values: Sequence[float] | Array) -> list[float]:
    """P-values adjusted for being many (Holm, Scand. J. Statist. 6, 1979), in the order given."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted.tolist()


class _Views:
    """The points of the map's bars by viewing direction, and how often each bar was looked for and not found."""

    def __init__(self, bars: KnownBars, settings: StructureSettings) -> None:
        self.bars, self.settings = bars, settings
        self.histogram, self.looks = sections.empty_histogram(len(bars)), np.zeros((len(bars), 2), dtype=np.int64)

    def add(self, scan: Scan, T_world_sensor: Array, camera: "_Pinhole | None") -> None:
        """Add a scan at the pose of its sensor."""
        b, s, segments = self.bars.bars, self.settings, self.bars.bars.segments
        flat = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
        world, _ = world_points(flat, T_world_sensor, s.range_max_m, s.floor_m)
        sections.accumulate(
            world, T_world_sensor[:3, 3], self.bars.bar_of(world), segments.start, segments.direction, segments.length,
            b.across, END_M, self.histogram,
        )  # fmt: skip
        if camera is not None and scan.points.shape == camera.shape:
            _look(
                np.linalg.norm(scan.points, axis=2), camera.pixel, T_world_sensor, segments.start, segments.direction,
                segments.length, b.across, self.bars.corner, s.range_max_m, s.floor_m, self.looks,
            )  # fmt: skip


class _Pinhole(NamedTuple):
    """Where a direction is in the images of a pinhole camera: ``shape`` of its scans, and ``pixel (2, 3)``, which takes
    (y/x, z/x, 1) to (row, column)."""

    shape: tuple[int, ...]
    pixel: Array


def _pinhole(scans: Sequence[Scan]) -> _Pinhole | None:
    """The camera of organised scans, from their returns; None for others, and where no pinhole fits them."""
    at, slope, shape = [np.zeros((0, 2))], [np.zeros((0, 3))], tuple[int, ...]()
    for scan in scans[:: max(1, len(scans) // PINHOLE_SCANS)]:
        points, shape = scan.points, shape or scan.points.shape
        if points.ndim != 3 or points.shape != shape:
            return None
        row, column = np.nonzero(points[..., 0] > 0)
        x, y, z = points[row, column].T
        at.append(np.column_stack([row, column]))
        slope.append(np.column_stack([y / x, z / x, np.ones_like(x)]))
    pixels, slopes = np.concatenate(at), np.concatenate(slope)
    if len(pixels) < GROUP_POINTS_MIN:
        return None
    found, *_ = np.linalg.lstsq(slopes, pixels, rcond=None)
    if np.abs(slopes @ found - pixels).max() > PIXEL_SLACK:
        return None
    return _Pinhole(shape, np.ascontiguousarray(found.T))


@njit(cache=True)
def _look(image, pixel, T, start, direction, length, across, corner, range_max, floor, looks):  # type: ignore[no-untyped-def]
    """Look for each bar in a range image ``(H, W)``: add to ``looks (B, 2)`` whether the rays at most of its stations
    went through its place, and whether it could be seen at all."""
    rows, columns = image.shape
    a, c = np.empty(3), np.empty(3)
    for b in range(len(length)):
        through, hit = 0, 0
        for s in range(1, int(length[b] / STATION_M)):
            square, along = 0.0, 0.0
            for k in range(3):
                a[k] = start[b, k] + s * STATION_M * direction[b, k]
                c[k] = T[k, 3] - a[k]
                square += c[k] * c[k]
                along += c[k] * direction[b, k]
            if square > range_max * range_max or square - along * along < 0.25 * square or a[2] < floor + GATE_M:
                continue
            x = -(T[0, 0] * c[0] + T[1, 0] * c[1] + T[2, 0] * c[2])
            if x <= 0.0:
                continue
            y = -(T[0, 1] * c[0] + T[1, 1] * c[1] + T[2, 1] * c[2]) / x
            z = -(T[0, 2] * c[0] + T[1, 2] * c[1] + T[2, 2] * c[2]) / x
            i = round(pixel[0, 0] * y + pixel[0, 1] * z + pixel[0, 2])
            j = round(pixel[1, 0] * y + pixel[1, 1] * z + pixel[1, 2])
            if i < PIXEL_SLACK or j < PIXEL_SLACK or i >= rows - PIXEL_SLACK or j >= columns - PIXEL_SLACK:
                continue
            # A line of sight through the axis meets the section, whose centroid lies on it.
            p = c[0] * across[b, 0, 0] + c[1] * across[b, 0, 1] + c[2] * across[b, 0, 2]
            q = c[0] * across[b, 1, 0] + c[1] * across[b, 1, 1] + c[2] * across[b, 1, 2]
            distance = math.sqrt(p * p + q * q)
            front, _ = sections.front_face(corner[b], p / distance, q / distance, 0.0)
            expected = math.sqrt(square) * (1.0 - max(front, 0.0) / distance)
            if expected > range_max - GATE_M:
                continue
            hits, nearer = 0, 0
            for di in range(-PIXEL_SLACK, PIXEL_SLACK + 1):
                for dj in range(-PIXEL_SLACK, PIXEL_SLACK + 1):
                    apart = image[i + di, j + dj] - expected
                    hits += abs(apart) <= GATE_M
                    nearer += apart < -GATE_M
            if hits:
                hit += 1
            elif not nearer:
                through += 1
        if through + hit >= STATIONS_MIN:
            looks[b, 0] += through > hit
            looks[b, 1] += 1


def _displaced(histogram: Array, bars: KnownBars) -> tuple[Array, Array, Array, Array]:
    """Offset of each bar and its standard deviation, metres, and the p-values of no shift and of no bow, ``(B,)``; NaN
    for a bar with too few points.

    A displacement is a shift, a tilt and half a sine, across the bar. Whether there is any is told by the shift alone,
    which is the mean over the bar, also of a bent one: the ends of a bar hold points of others, above all where the map
    takes two bars for one, and would pass for a bow. Covariances are those of the measurements, enlarged where they
    contradict each other, and the systematic errors of the map.
    """
    n = len(bars)
    offset, sigma, p_moved, p_bent = np.full((4, n), np.nan)
    share = (np.arange(sections.PARTS) + 0.5) / sections.PARTS
    shape = np.stack([np.ones_like(share), 2 * share - 1, np.sin(np.pi * share)])  # (3, PARTS)
    for b in range(n):
        x, H, misfit, groups = _displacement(histogram[b], bars.corner[b], shape)
        if groups < GROUPS_MIN:
            continue
        spread, place = max(1.0, misfit / max(2 * groups - 6, 1)), (SIGMA_SHARE * bars.sigma_m[b]) ** 2 + SIGMA_M**2
        shift = np.linalg.solve(H[:2, :2], (H @ x)[:2])
        C = spread * np.linalg.inv(H[:2, :2]) + place * np.eye(2)
        bow = spread * np.linalg.inv(H)[4:, 4:] + SIGMA_BOW_M**2 * np.eye(2)
        p_moved[b] = stats.chi2.sf(shift @ np.linalg.solve(C, shift), 2)
        p_bent[b] = stats.chi2.sf(x[4:] @ np.linalg.solve(bow, x[4:]), 2)
        if p_bent[b] < BENT:
            shift, C = x[:2] + x[4:], C + bow
        offset[b] = np.linalg.norm(shift)
        sigma[b] = math.sqrt(shift @ C @ shift) / max(offset[b], 1e-12)
    return offset, sigma, p_moved, p_bent


@njit(cache=True)
def _displacement(histogram, corner, shape):  # type: ignore[no-untyped-def]
    """Least squares of the displacement (shift, tilt, bow; two coordinates each) of a bar from its histogram: the
    estimate ``(6,)``, its information ``(6, 6)``, the sum of squared residuals, and the number of groups of points,
    each seen from one direction on one part of the bar."""
    parts = len(histogram)
    x, H, g = np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    J, misfit, groups = np.zeros(6), 0.0, 0
    for step in range(STEPS):
        H[:], g[:], misfit, groups = 0.0, 0.0, 0.0, 0
        for k in range(6):
            H[k, k] = FREE_SIGMA_M**-2.0
            g[k] = -x[k] * H[k, k]
        for part in range(parts):
            du = shape[0, part] * x[0] + shape[1, part] * x[2] + shape[2, part] * x[4]
            dv = shape[0, part] * x[1] + shape[1, part] * x[3] + shape[2, part] * x[5]
            for view in range(sections.VIEWS):
                h = histogram[part, view]
                angle = (view + 0.5) * 2.0 * math.pi / sections.VIEWS - math.pi
                cosine, sine = math.cos(angle), math.sin(angle)
                low, high = 1e9, -1e9
                for k in range(6):
                    edge = -sine * corner[k, 0] + cosine * corner[k, 1]
                    low, high = min(low, edge), max(high, edge)
                # The front faces: mean depth behind them, and mean derivatives.
                total, count, depth, au, av, beside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                left, right = 1e9, -1e9
                for cell in range(sections.CELLS):
                    if h[cell, 0] < 1.0:
                        continue
                    u, v = h[cell, 2] / h[cell, 1] - du, h[cell, 3] / h[cell, 1] - dv
                    across = -sine * u + cosine * v
                    if across < low - BESIDE_MAX_M or across > high + BESIDE_MAX_M:
                        continue
                    total += h[cell, 0]
                    beside += h[cell, 0] * across
                    left, right = min(left, across), max(right, across)
                    front, rise = sections.front_face(corner, cosine, sine, across)
                    residual = cosine * u + sine * v - front
                    if front < -1e8 or abs(rise) > 2.0 or abs(residual) > DEPTH_MAX_M:
                        continue
                    before, _ = sections.front_face(corner, cosine, sine, across - sections.CELL_M)
                    after, _ = sections.front_face(corner, cosine, sine, across + sections.CELL_M)
                    if abs(after - before) > STEP_MAX_M:  # an edge: the mean of the cell is that of two faces
                        continue
                    count += h[cell, 0]
                    depth += h[cell, 0] * residual
                    au += h[cell, 0] * (cosine + rise * sine)
                    av += h[cell, 0] * (sine - rise * cosine)
                if total < GROUP_POINTS_MIN:
                    continue
                groups += 1
                for kind in range(2):
                    if kind == 0:
                        if count < 0.3 * total:
                            continue
                        r, a, b = depth / count, au / count, av / count
                        variance = SIGMA_DEPTH_M**2 + SIGMA_POINT_M**2 / count
                    else:
                        if right - left < WHOLE_SHARE * (high - low):  # partly hidden: its middle is not the outline's
                            continue
                        r, a, b = beside / total - 0.5 * (low + high), -sine, cosine
                        variance = SIGMA_BESIDE_M**2 + SIGMA_POINT_M**2 / total
                    for k in range(3):
                        J[2 * k], J[2 * k + 1] = shape[k, part] * a, shape[k, part] * b
                    misfit += r * r / variance
                    for k in range(6):
                        g[k] += J[k] * r / variance
                        for m in range(6):
                            H[k, m] += J[k] * J[m] / variance
        if step < STEPS - 1:
            x += np.linalg.solve(H, g)
    return x, H, misfit, groups


class _Unexplained(Sequence[Scan]):
    """Scans without the points near bars of the map."""

    def __init__(self, scans: Sequence[Scan], T_world_sensor: Array, bars: KnownBars) -> None:
        self.scans, self.T_world_sensor, self.bars = scans, T_world_sensor, bars

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        for k, scan in enumerate(self.scans):
            yield self._without(scan, k)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return _Unexplained(self.scans[index], self.T_world_sensor[index], self.bars)
        return self._without(self.scans[index], index)

    def _without(self, scan: Scan, k: int) -> Scan:
        R, t = self.T_world_sensor[k, :3, :3], self.T_world_sensor[k, :3, 3]
        points = np.array(scan.points, dtype=np.float64)
        flat = points.reshape(-1, 3)
        seen = np.flatnonzero(np.isfinite(flat).all(axis=1))
        flat[seen[self.bars.near(flat[seen] @ R.T + t)]] = np.nan
        return replace(scan, points=points)


def _new_bars(
    scans: Sequence[Scan], T_world_drone: Array, T_drone_sensor: Array | None, T_world_sensor: Array, bars: KnownBars,
    settings: StructureSettings,
) -> Structure:  # fmt: skip
    """The bars that `reconstruct` finds in the points that lie near no bar of the map."""
    left = _Unexplained(scans, T_world_sensor, bars)
    try:
        return reconstruct(left, T_world_drone, T_drone_sensor, settings.replace(adjust=False))
    except EmptyCloudError as fault:
        return Structure.empty(str(fault))


def _beside(new: Structure, known: Structure) -> tuple[Array, Array]:
    """Distance of the middle of each new bar from the nearest one of the map, and its standard deviation, metres."""
    s = known.segments
    apart = new.segments.middle[:, None] - s.start
    along = np.clip((apart * s.direction).sum(axis=2), 0, s.length)
    distance = np.linalg.norm(apart - along[..., None] * s.direction, axis=2)
    nearest = distance.argmin(axis=1)
    sigma = np.hypot(new.sigma_m, np.nan_to_num(known.sigma_m)[nearest])
    return distance.min(axis=1), np.maximum(sigma, SIGMA_BOW_M)
