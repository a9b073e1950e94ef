"""Map so far, estimated pose → the next command of a drone. It never sees the truth."""

from steelnb.planning.planner import Decision, Planner

__all__ = ["Decision", "Planner"]
