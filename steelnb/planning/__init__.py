"""Map, estimated pose and camera → velocity: the planner, and the pilot of a closed loop."""

from steelnb.planning.pilot import OnboardPilot
from steelnb.planning.planner import Decision, Planner

__all__ = ["Decision", "OnboardPilot", "Planner"]
