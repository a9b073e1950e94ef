"""Points → the voxel map that registration and reconstruction share."""

from steelnb.mapping.voxel_map import VoxelMap

__all__ = ["VoxelMap"]
