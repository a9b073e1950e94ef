"""True trajectory → drifting trajectory."""

from steelnb.noise.drift import drift_errors, drifted, drifting, random_walk_rms_m

__all__ = ["drift_errors", "drifted", "drifting", "random_walk_rms_m"]
