"""Scan → points: invalid returns, pass-through, voxel grid."""

from steelnb.preprocess.points import finite_points, pass_through, preprocess_scan, voxel_grid

__all__ = ["finite_points", "pass_through", "preprocess_scan", "voxel_grid"]
