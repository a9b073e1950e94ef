"""Files ↔ clouds and segments. Everything is written beside and then renamed, so that nothing half-written stays."""

from steelnb.recordings.clouds import Cloud, read_cloud
from steelnb.recordings.segments import new_folder, write_segments

__all__ = ["Cloud", "new_folder", "read_cloud", "write_segments"]
