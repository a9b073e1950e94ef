"""What only metrics and figures may see."""

from dataclasses import dataclass

from steelnb.datatypes import IntArray, Trajectory
from steelnb.simulation.tower import Tower


@dataclass(frozen=True)
class Truth:
    """True trajectory at 125 Hz, the tower, and how many returns each of its members gave in the flight ``(M,)``."""

    trajectory: Trajectory
    tower: Tower
    member_hits: IntArray
