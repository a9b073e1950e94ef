"""Settings → `Tower`, true flight, scans: the world that the report had in Webots."""

from steelnb.simulation.flight import fly
from steelnb.simulation.tof import scan_flight
from steelnb.simulation.tower import Member, Tower, build_tower
from steelnb.simulation.truth import Truth

__all__ = ["Member", "Tower", "Truth", "build_tower", "fly", "scan_flight"]
