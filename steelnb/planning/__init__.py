"""Map so far, estimated pose, camera → the next command of a drone. It never sees the truth."""

from steelnb.planning.outlook import Camera
from steelnb.planning.planner import Decision, Planner

__all__ = ["Camera", "Decision", "Planner"]
