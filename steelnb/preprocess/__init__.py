"""Scan → points: invalid returns, pass-through, voxel grid."""

from steelnb.preprocess.points import preprocess_scan, voxel_grid

__all__ = ["preprocess_scan", "voxel_grid"]
