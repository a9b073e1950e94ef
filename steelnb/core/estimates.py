"""What an odometry gives: the result of one scan, and that of a flight."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from steelnb.core.checks import (
    check_length,
    check_same_stamps,
    checked_array,
    checked_integer,
    checked_number,
    checked_pose,
    set_checked,
)
from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Segments, Trajectory, translated


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """The result of one scan.

    ``T_world_drone (4, 4)``: corrected pose; ``used``: whether the scan was used for it; ``reason``: why it was not,
    else empty; ``matches``: number of correspondences; ``seconds``: duration of each stage; ``unobserved``: number of
    directions, 0 to 3, that a used scan does not constrain; along these the pose follows the prediction.
    ``covariance (6, 6)`` of x, y, z, roll, pitch, yaw of the pose, metres and radians, in world axes; None if the
    odometry does not know it, as those without an IMU.
    """

    stamp_s: float
    T_world_drone: Array
    used: bool = True
    reason: str = ""
    matches: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    unobserved: int = 0
    covariance: Array | None = None

    def __post_init__(self) -> None:
        if self.covariance is not None:
            C = checked_array(self.covariance, "OdometryStep.covariance", (6, 6))
            least, largest = np.linalg.eigvalsh(C)[[0, -1]]
            if max(-least, np.abs(C - C.T).max()) > 1e-6 * max(largest, 0.0):
                raise InputError("OdometryStep.covariance: expected a symmetric matrix without negative eigenvalues")
            set_checked(self, covariance=C)
        set_checked(
            self,
            stamp_s=checked_number(self.stamp_s, "OdometryStep.stamp_s"),
            T_world_drone=checked_pose(self.T_world_drone, "OdometryStep.T_world_drone"),
            matches=checked_integer(self.matches, "OdometryStep.matches", 0),
            unobserved=checked_integer(self.unobserved, "OdometryStep.unobserved", 0, 3),
        )

    def moved(self, by: Array) -> "OdometryStep":
        """The step with its pose translated by ``by (3,)``, metres."""
        T_world_drone = self.T_world_drone.copy()
        T_world_drone[:3, 3] = translated(T_world_drone[:3, 3], by)
        return replace(self, T_world_drone=T_world_drone)

    def __repr__(self) -> str:
        did = f"{self.matches} matches" if self.used else f"not used: {self.reason}"
        return f"OdometryStep({self.stamp_s:.3f} s, at {self.T_world_drone[:3, 3].round(3).tolist()}, {did})"


@dataclass(frozen=True, eq=False)
class MountEstimate:
    """The mount of the sensor as a smoothed flight shows it.

    ``T_drone_sensor (4, 4)``; ``late_s``: time by which stamps are later than the measurements; ``step (7,)``: rotation
    vector (rad) and translation (m) in the frame of the drone from the stated mount, and the delay; ``covariance
    (7, 7)`` of that step, with zeros for what is known, None if it is not determined. ``T_world_sensor (K, 4, 4)``:
    the sensor when it took the scans.
    """

    T_drone_sensor: Array
    late_s: float
    step: Array
    covariance: Array | None
    T_world_sensor: Array

    def moved(self, by: Array) -> "MountEstimate":
        """The same mount in a flight translated by ``by (3,)``, metres."""
        T_world_sensor = self.T_world_sensor.copy()
        T_world_sensor[:, :3, 3] = translated(T_world_sensor[:, :3, 3], by)
        return replace(self, T_world_sensor=T_world_sensor)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A corrected flight of K scans and the map built on the way.

    ``prior`` and ``corrected``: poses at the scans; ``points (N, 3)`` and ``segments``: the map in the world frame. Per
    scan: number of correspondences ``matches (K,)``; ``reason`` why it was not used, else empty; duration of each
    stage, ``seconds``, each ``(K,)``; ``update_s (K,)``, wall time of the whole update; ``unobserved (K,)``, number of
    directions, 0 to 3, that a used scan does not constrain (empty if unknown). ``unsmoothed``: why smoothing failed,
    else empty.

    Covariances, None if they are not known: ``pose_covariance (K, 6, 6)`` of x, y, z, roll, pitch, yaw of the corrected
    poses, metres and radians, in world axes, of a smoothed flight (`fusion.adjustment.uncertainty`; zero for the first
    pose) or of an odometry with an IMU, which knows the scans so far; and ``axis_covariance (M, 4, 4)`` of position and
    direction of each segment of a smoothed flight.
    ``unsure``: why a smoothed flight has no covariances, else empty. ``thickness`` of angle sections, a share of
    their flanges, as estimated by smoothing, else None. ``mount``: as estimated by smoothing, None if it is known.
    ``mount_cost (6,)``: how far a wrong mount would move the positions of a smoothed flight, root mean square, metres
    per radian about each axis of the drone and per metre along it, else None.
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
    mount: MountEstimate | None = None
    mount_cost: Array | None = None
    unobserved: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        name, k, bars = type(self).__name__, len(self.prior), len(self.segments)
        check_same_stamps(self.corrected.stamp_s, f"{name}.corrected", self.prior.stamp_s, f"the poses in {name}.prior")
        shapes: dict[str, tuple[str | int, ...]] = {
            "points": ("N", 3), "matches": (k,), "update_s": (k,), "pose_covariance": (k, 6, 6),
            "axis_covariance": (bars, 4, 4), "unobserved": (k if len(self.unobserved) else 0,),
        }  # fmt: skip
        for field_name, shape in shapes.items():
            if (values := getattr(self, field_name)) is not None:
                checked_array(values, f"{name}.{field_name}", shape)
        for stage, seconds in self.seconds.items():
            checked_array(seconds, f"{name}.seconds[{stage!r}]", (k,))
        check_length(self.reason, f"{name}.reason", k, "one a scan")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._summary()})"

    def _summary(self) -> str:
        used = sum(not reason for reason in self.reason)
        return f"{len(self.prior)} scans, {used} used, {len(self.points)} map points, {len(self.segments)} segments"

    def moved(self, by: Array, prior: Trajectory) -> "Estimate":
        """The estimate translated by ``by (3,)``, metres, where the uncorrected poses are ``prior``."""
        return replace(
            self, prior=prior, corrected=self.corrected.moved(by), points=self.points + by,
            segments=self.segments.moved(by), mount=self.mount and self.mount.moved(by),
        )  # fmt: skip

    def sensor_poses(self, T_drone_sensor: Array) -> Array:
        """Poses ``(K, 4, 4)`` of the sensor when it took the scans, where its mount is ``T_drone_sensor (4, 4)`` unless
        it was estimated."""
        return self.mount.T_world_sensor if self.mount else self.corrected.T_world_drone @ T_drone_sensor

    @property
    def on_time_share(self) -> float:
        """Share of the updates, 0 to 1, that end before the next scan; for the last one, the median interval counts.
        NaN without scans."""
        if not len(self.prior):
            return math.nan
        gaps = np.diff(self.prior.stamp_s)
        deadline_s = np.append(gaps, np.median(gaps) if len(gaps) else np.inf)
        return float((self.update_s <= deadline_s).mean())
