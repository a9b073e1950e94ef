"""Looking for the bars of a map in the scans of a flight: the points of each, and the rays that went through its
place."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.fusion import sections
from steelnb.fusion.known import KnownBars
from steelnb.settings import StructureSettings
from steelnb.types import Array, Scan

END_M = 0.15
"""Points so near the ends of a bar are those of others."""
STATION_M, STATIONS_MIN, GATE_M, PIXEL_SLACK = 0.05, 3, 0.12, 1
"""A bar is looked for every 5 cm along its axis, within so much of the expected range and so many pixels around."""
PINHOLE_SCANS, RETURNS_MIN = 20, 20
"""Scans that tell the camera, and the fewest returns in them."""


class Views:
    """The points of the map's bars by viewing direction, and how often each bar was looked for and not found."""

    def __init__(self, bars: KnownBars, settings: StructureSettings) -> None:
        self.bars, self.settings = bars, settings
        self.histogram, self.looks = sections.empty_histogram(len(bars)), np.zeros((len(bars), 2), dtype=np.int64)

    def add(self, scan: Scan, T_world_sensor: Array, camera: "Pinhole | None") -> None:
        """Add a scan at the pose of its sensor."""
        b, s, segments = self.bars.bars, self.settings, self.bars.bars.segments
        flat = np.ascontiguousarray(scan.points, dtype=np.float64).reshape(-1, 3)
        points, bar = self.bars.voxels.points_on_bars(flat, T_world_sensor, s.range_max_m, s.floor_m)
        sections.accumulate(
            points, T_world_sensor, bar, segments.start, segments.direction, segments.length, b.across, END_M,
            self.histogram,
        )  # fmt: skip
        if camera is not None and scan.points.shape == camera.shape:
            _look(
                np.linalg.norm(scan.points, axis=2), camera.pixel, T_world_sensor, segments.start, segments.direction,
                segments.length, b.across, self.bars.corner, s.range_max_m, s.floor_m, self.looks,
            )  # fmt: skip


class Pinhole(NamedTuple):
    """Where a direction is in the images of a pinhole camera: ``shape`` of its scans, and ``pixel (2, 3)``, which takes
    (y/x, z/x, 1) to (row, column)."""

    shape: tuple[int, ...]
    pixel: Array


def pinhole(scans: Sequence[Scan]) -> Pinhole | None:
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
    if len(pixels) < RETURNS_MIN:
        return None
    found, *_ = np.linalg.lstsq(slopes, pixels, rcond=None)
    if np.abs(slopes @ found - pixels).max() > PIXEL_SLACK:
        return None
    return Pinhole(shape, np.ascontiguousarray(found.T))


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
