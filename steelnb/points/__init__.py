"""Scan → points → voxel map: filters, voxel grids, neighbours and covariances."""

from steelnb.points.filters import preprocess_scan, voxel_grid
from steelnb.points.ranges import smooth_ranges
from steelnb.points.voxel_map import VoxelMap

__all__ = ["VoxelMap", "preprocess_scan", "smooth_ranges", "voxel_grid"]
