"""The least-squares problem of an adjustment: one maximum a posteriori estimate of all poses and all bars of a flight,
including their sections (Triggs et al., "Bundle adjustment: a modern synthesis", 1999).

The factors (`factors`, `imu_factors`):

- the distance of each point to the front face of its bar along the line of sight, with the range noise as its standard
  deviation and robust weights;
- the increments of the drifting prior from scan to scan, in the frame of the earlier pose;
- the first pose, fixed to the prior's, since drift begins there;
- the readings of an IMU between scans, if there are any.

The unknowns are position and yaw of each pose, and position, direction, rotation and flange of each bar. Roll and pitch
are unknowns, too, if those of the prior have a standard deviation; with an IMU, so are velocities and biases.

If the thickness is wrong by 1 mm, a horizontal bar seems to move by as much between a view from below and one from
above, and an adjustment moves the poses instead. So the thickness is estimated, too (`factors.common_thickness`).
`adjustment.solver` takes the steps.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import POSE_DOF, UPRIGHT_DOF, exp_about, moved_poses, yaw_of
from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.adjustment.imu_factors import Inertial
from steelnb.fusion.adjustment.mount import WORLD_DOF, Mount
from steelnb.fusion.sections import shapes

BAR_DOF = 6
"""Degrees of freedom of a bar: two of position, two of direction, rotation, flange; compiled into kernels (njit)."""
BAR_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.003])
"""Prior standard deviations of a bar. Those of position and direction apply to each step. They constrain what no point
determines, such as the position of a single face along itself. Those of rotation and flange are about the values fitted
to outlines, since outlines are not factors here."""
FLANGE_MIN_M, FLANGE_MAX_M = 0.01, 0.4


def pose_size(tilt_sigma_rad: float) -> int:
    """The degrees of freedom of a pose: six if the prior's roll and pitch have a standard deviation, else four."""
    return POSE_DOF if tilt_sigma_rad > 0 else UPRIGHT_DOF


@dataclass(frozen=True)
class Bars:
    """B bars with their sections: ``segments`` along their centroids, with frames ``across (B, 2, 3)``; ``kind (B,)``,
    ``turn (B,)``, radians, and ``flange (B,)``, metres, of each section (`sections.shapes`). A bar of unknown kind has
    no factors. ``thickness`` of all angle sections: share of the flange."""

    segments: Segments
    across: Array
    kind: IntArray
    turn: Array
    flange: Array
    thickness: float = shapes.THICKNESS

    @property
    def has_section(self) -> NDArray[np.bool_]:
        """Mask ``(B,)`` of the bars with a known section."""
        return self.kind != shapes.UNKNOWN

    @property
    def is_bar(self) -> NDArray[np.bool_]:
        """Mask ``(B,)`` of the bars with a known section that are not plates."""
        return (self.kind == shapes.ANGLE) | (self.kind == shapes.TUBE)

    def faces(self) -> tuple[Array, Array, Array, Array, IntArray, Array]:
        """Start, direction, length, frame, kind and outline of each bar, the arguments of `shapes.face_distance`."""
        s, corner = self.segments, shapes.outlines(self.kind, self.turn, self.flange, self.thickness)
        return s.start, s.direction, s.length, self.across, self.kind, corner

    def take(self, mask: NDArray[np.bool_] | NDArray[np.int64]) -> "Bars":
        """The bars selected by a mask or an index."""
        return replace(
            self, segments=self.segments.take(mask), across=self.across[mask], kind=self.kind[mask],
            turn=self.turn[mask], flange=self.flange[mask],
        )  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """The state of an adjustment of K scans and B bars.

    ``T_world_sensor (K, 4, 4)``; ``sigma_ratio``: range noise as a multiple of that in `points.ranges`; ``fitted
    (B, 2)``: rotations and flanges of the bars as fitted to outlines; ``tilt_sigma_rad``: standard deviation of the
    prior's roll and pitch, 0 if they are fixed; ``inertial``: None without an IMU; ``mount``: None if it is
    known; ``drift``: `factors.drift_ratio` of the prior.
    """

    T_world_sensor: Array
    bars: Bars
    sigma_ratio: float
    fitted: Array
    tilt_sigma_rad: float = 0.0
    inertial: Inertial | None = None
    mount: Mount | None = None
    drift: Array | float = 1.0

    @property
    def poses(self) -> Array:
        """The poses ``(K, 4, 4)`` that are unknowns: of the sensor, or of the drone if the mount is unknown."""
        return self.mount.drones(self.T_world_sensor) if self.mount else self.T_world_sensor

    def moved(
        self, state_step: Array, bar_step: Array, sigma_ratio: float, thickness: float, mount_step: Array | None = None
    ) -> "Problem":
        """After steps ``(K, D)`` of the states, D as in `solver.normal_equations`, ``(B, 6)`` of the bars and ``(S,)``
        of the mount and all bars together (`Mount.of_drone`)."""
        poses = moved_poses(self.poses, state_step[:, : pose_size(self.tilt_sigma_rad)])
        mount, bars = self.mount, replace(_moved_bars(self.bars, bar_step), thickness=thickness)
        if mount and mount_step is not None:
            mount = mount.moved(mount_step[:-WORLD_DOF])
            T_correction = exp_about(np.zeros(3), mount_step[-WORLD_DOF:])
            segments = bars.segments.transformed(T_correction)
            bars = replace(bars, segments=segments, across=bars.across @ T_correction[:3, :3].T)
        return replace(
            self, T_world_sensor=poses @ mount.at_scans() if mount else poses, mount=mount,
            bars=bars, inertial=self.inertial and self.inertial.moved(state_step), sigma_ratio=sigma_ratio,
        )  # fmt: skip


def start(
    T_world_sensor: Array, prior: Array, bars: Bars, tilt_sigma_rad: float = 0.0, inertial: Inertial | None = None,
    mount: Mount | None = None, drift: Array | float = 1.0,
) -> Problem:  # fmt: skip
    """The state before the first step: poses ``(K, 4, 4)`` and bars, moved together by the yaw and translation that
    take the first pose to that of the ``prior (K, 4, 4)``, which is the drone's if there is a ``mount``."""
    T_correction, first = np.eye(4), mount.drones(T_world_sensor)[0] if mount else T_world_sensor[0]
    yaw = yaw_of(prior[0, :3, :3] @ first[:3, :3].T)
    T_correction[:3, :3] = R = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
    T_correction[:3, 3] = prior[0, :3, 3] - R @ first[:3, 3]
    corrected = replace(bars, segments=bars.segments.transformed(T_correction), across=bars.across @ R.T)
    fitted = np.column_stack([bars.turn, bars.flange])
    inertial = inertial and inertial.rotated(R)
    return Problem(T_correction @ T_world_sensor, corrected, 1.0, fitted, tilt_sigma_rad, inertial, mount, drift)


def _moved_bars(bars: Bars, step: Array) -> Bars:
    old, half_length = bars.segments, 0.5 * bars.segments.length[:, None]
    position, direction = step[:, :2], step[:, 2:4]
    start, end = (
        at + np.einsum("bk,bkx->bx", position + s * half_length * direction, bars.across)
        for s, at in ((-1, old.start), (1, old.end))
    )
    segments = replace(old, start=start, end=end)
    first = bars.across[:, 0] - (bars.across[:, 0] * segments.direction).sum(axis=1)[:, None] * segments.direction
    first /= np.linalg.norm(first, axis=1)[:, None]
    across = np.stack([first, np.cross(segments.direction, first)], axis=1)
    flange = np.clip(bars.flange + step[:, 5], FLANGE_MIN_M, FLANGE_MAX_M)  # NaN stays
    return replace(bars, segments=segments, across=across, turn=bars.turn + step[:, 4], flange=flange)
