"""Readers and writers of flights, clouds, trajectories and structures."""

from steelnb.io.bag_writer import write_flight
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.recordings import read_flight, read_truth
from steelnb.io.structures import write_segments, write_structure
from steelnb.io.trajectories import read_trajectory, write_tum

__all__ = [
    "Cloud", "read_cloud", "read_flight", "read_trajectory", "read_truth", "write_flight", "write_segments",
    "write_structure", "write_tum",
]  # fmt: skip
