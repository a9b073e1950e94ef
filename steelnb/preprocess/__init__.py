"""Scan → points: invalid returns, pass-through, voxel grid, less noise."""

from steelnb.preprocess.points import preprocess_scan, voxel_grid
from steelnb.preprocess.ranges import smooth_ranges

__all__ = ["preprocess_scan", "smooth_ranges", "voxel_grid"]
