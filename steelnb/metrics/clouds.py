"""Bend of a cloud built at estimated poses, basin of convergence of a registration, and slips of an odometry."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion.poses import yaw_of
from steelnb.types import Array, IntArray


@dataclass(frozen=True)
class Bend:
    """Rigid motion from the true to the built cloud in each of S horizontal slices.

    ``height_m (S,)`` of the middles of the slices; ``T_built_true (S, 4, 4)``; ``blur_m (S,)``: root mean square
    residual of that motion, which doubled surfaces raise; ``count (S,)`` points.
    """

    height_m: Array
    T_built_true: Array
    blur_m: Array
    count: IntArray

    @property
    def tilt_deg(self) -> Array:
        """Angle ``(S,)`` between the vertical of the built and of the true cloud."""
        up = self.T_built_true[:, :3, 2]
        return np.asarray(np.degrees(np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])))

    @property
    def yaw_deg(self) -> Array:
        """Rotation ``(S,)`` about the vertical, anticlockwise from above."""
        return np.degrees(yaw_of(self.T_built_true[:, :3, :3]))

    @property
    def bend_deg(self) -> float:
        """Angle of the rotation from the lowest slice to the highest."""
        rotation = self.T_built_true[-1, :3, :3] @ self.T_built_true[0, :3, :3].T
        return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))

    def offset_m(self, axis: Array) -> Array:
        """Displacement ``(S, 3)``, metres, of the vertical through ``axis (2,)`` at the height of each slice."""
        axis_points = np.column_stack([np.tile(axis, (len(self.height_m), 1)), self.height_m])
        displaced = np.einsum("sij,sj->si", self.T_built_true[:, :3, :3], axis_points) + self.T_built_true[:, :3, 3]
        return np.asarray(displaced - axis_points)

    def slices(self, axis: Array) -> dict[str, Array]:
        """Columns of a table with a row a slice: height, tilt, yaw, the length of `offset_m`, and blur."""
        offset_m = np.linalg.norm(self.offset_m(axis), axis=1)
        return {
            "height_m": self.height_m, "tilt_deg": self.tilt_deg, "yaw_deg": self.yaw_deg, "offset_m": offset_m,
            "blur_m": self.blur_m,
        }  # fmt: skip

    def metrics(self, axis: Array) -> dict[str, float]:
        """``bend_deg``, the maximum tilt, yaw and offset of a slice, and the mean blur."""
        most = {name: float(np.abs(values).max()) for name, values in self.slices(axis).items()}
        blur_m = float(np.average(self.blur_m, weights=self.count))
        return {
            "bend_deg": self.bend_deg, "tilt_max_deg": most["tilt_deg"], "yaw_max_deg": most["yaw_deg"],
            "offset_max_m": most["offset_m"], "blur_mean_m": blur_m,
        }  # fmt: skip


def bend(built: Array, true: Array, slice_m: float = 1.0, points_min: int = 200) -> Bend:
    """Fit a rigid motion (Kabsch 1976) to each horizontal slice of two clouds ``(N, 3)``, metres, world frame.

    Row k of ``built`` and ``true`` is the same return at the estimated and at the true pose. Slices of ``slice_m``
    start at true height zero. Those with fewer than ``points_min`` points are dropped. Raises ValueError if no slice
    remains, or if the shapes differ.
    """
    if built.shape != true.shape:
        raise ValueError(f"built {built.shape} and true {true.shape}: expected pairs of points")
    level = np.floor(true[:, 2] / slice_m).astype(int)
    levels, counts = np.unique(level, return_counts=True)
    levels, counts = levels[counts >= points_min], counts[counts >= points_min]
    if not len(levels):
        raise ValueError(f"no slice of {slice_m} m has {points_min} points")
    fits = [_rigid_fit(true[level == each], built[level == each]) for each in levels]
    return Bend((levels + 0.5) * slice_m, np.array([T for T, _ in fits]), np.array([blur for _, blur in fits]), counts)


def _rigid_fit(source: Array, target: Array) -> tuple[Array, float]:
    """Least-squares ``T_target_source (4, 4)``, and the root mean square residual."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(target - target_mean, source - source_mean)[0].as_matrix()
    T[:3, 3] = target_mean - T[:3, :3] @ source_mean
    residual = source @ T[:3, :3].T + T[:3, 3] - target
    return T, float(np.sqrt((residual**2).sum(axis=1).mean()))


def basin_radius_m(offset_m: Array, converged: np.ndarray) -> float:
    """Radius of the basin of convergence, metres: every start within it converges to the true pose.

    ``offset_m (N, k)``: starts relative to the true position; ``converged (N,)``: whether each converged to it. The
    radius is the distance of the farthest start that is nearer than all failures, or zero.
    """
    distance = np.linalg.norm(offset_m, axis=1)
    nearest_failure = distance[~converged].min(initial=np.inf)
    return float(distance[distance < nearest_failure - 1e-9].max(initial=0.0))


def largest_slip(error_m: Array, scans: int) -> tuple[int, float]:
    """Largest growth of an error ``(N,)`` over ``scans`` scans: (scan at its end, growth in metres)."""
    scans = min(scans, len(error_m) - 1)
    growth = error_m[scans:] - error_m[:-scans]
    k = int(growth.argmax())
    return k + scans, float(growth[k])
