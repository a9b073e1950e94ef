"""Points → the voxel map that registration and reconstruction share."""

from steelnb.mapping.voxel_map import VoxelGrid, VoxelMap

__all__ = ["VoxelGrid", "VoxelMap"]
