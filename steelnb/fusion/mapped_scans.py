"""The scans of a flight, their poses, and the voxels in which they were accumulated: what bars are found in and fitted
to."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Scan, Segments
from steelnb.fusion.point_to_bar import BarVoxels, world_points
from steelnb.fusion.ridges import TUBE_M, VOXEL_M
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
