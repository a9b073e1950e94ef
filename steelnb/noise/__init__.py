"""True trajectory → drifting trajectory."""

from steelnb.noise.drift import drifting, random_walk_rms_m

__all__ = ["drifting", "random_walk_rms_m"]
