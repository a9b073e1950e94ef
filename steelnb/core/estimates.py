"""What an odometry gives: the result of one scan, and that of a flight."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from steelnb.core.types import Array, IntArray, Segments, Trajectory


@dataclass(frozen=True)
class OdometryStep:
    """The result of one scan.

    ``T_world_drone (4, 4)``: corrected pose; ``used``: whether the scan was used for it; ``reason``: why it was not,
    else empty; ``matches``: number of correspondences; ``seconds``: duration of each stage; ``unobserved``: number of
    directions, 0 to 3, that a used scan does not constrain; along these the pose follows the prediction.
    """

    stamp_s: float
    T_world_drone: Array
    used: bool = True
    reason: str = ""
    matches: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    unobserved: int = 0


@dataclass(frozen=True)
class Estimate:
    """A corrected flight of K scans and the map built on the way.

    ``prior`` and ``corrected``: poses at the scans; ``points (N, 3)`` and ``segments``: the map in the world frame. Per
    scan: number of correspondences ``matches (K,)``; ``reason`` why it was not used, else empty; duration of each
    stage, ``seconds``, each ``(K,)``; ``update_s (K,)``, wall time of the whole update; ``unobserved (K,)``, number of
    directions, 0 to 3, that a used scan does not constrain (empty if unknown). ``unsmoothed``: why smoothing failed,
    else empty.

    Covariances of a smoothed flight, else None: ``pose_covariance (K, 6, 6)`` of x, y, z, roll, pitch, yaw of the
    corrected poses, metres and radians, in world axes (`fusion.adjustment.uncertainty`; zero for the first pose),
    and ``axis_covariance (M, 4, 4)`` of position and direction of each segment.
    ``unsure``: why a smoothed flight has no covariances, else empty. ``thickness`` of angle sections, a share of
    their flanges, as estimated by smoothing, else None.
    """

    prior: Trajectory
    corrected: Trajectory
    points: Array
    segments: Segments
    matches: IntArray
    reason: tuple[str, ...]
    seconds: Mapping[str, Array]
    update_s: Array
    unsmoothed: str = ""
    pose_covariance: Array | None = None
    axis_covariance: Array | None = None
    unsure: str = ""
    thickness: float | None = None
    unobserved: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def on_time_share(self) -> float:
        """Share of the updates, 0 to 1, that end before the next scan; for the last one, the median interval counts."""
        gaps = np.diff(self.prior.stamp_s)
        deadline_s = np.append(gaps, np.median(gaps) if len(gaps) else np.inf)
        return float((self.update_s <= deadline_s).mean())
