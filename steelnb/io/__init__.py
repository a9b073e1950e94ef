"""Files ↔ flights, clouds, estimates and structures. Everything is written beside and then renamed."""

from steelnb.io.bag_writer import write_flight
from steelnb.io.clouds import Cloud, read_cloud
from steelnb.io.flights import read_flight, read_truth
from steelnb.io.structures import read_structure, write_structure
from steelnb.io.trajectories import read_trajectory, write_tum

__all__ = [
    "Cloud", "read_cloud", "read_flight", "read_structure", "read_trajectory", "read_truth", "write_flight",
    "write_structure", "write_tum",
]  # fmt: skip
