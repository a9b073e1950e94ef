"""The problem of an adjustment: all poses of a flight and all its bars, sections included, as unknowns of one maximum a
posteriori estimate.

Odometry places each scan against a map that holds the errors of the scans before it. Here poses and bars move at once
(Triggs et al., "Bundle adjustment: a modern synthesis", 1999). The factors (`fusion.factors`, `fusion.inertial`):

- the distance of each point to the front face of its bar (`fusion.sections`) along the line of sight, with the range
  noise as its standard deviation and robust weights;
- the increments of the drifting prior from scan to scan, in the frame of the earlier pose;
- the first pose, which is the prior's: drift begins there;
- the readings of an IMU from scan to scan, where there are any.

Free are position and yaw of each pose, and place, direction, turn and flange of each bar. Roll and pitch are the
prior's; or free, too, where the prior's have a standard deviation: their error is then a first-order Gauss-Markov
process. With an IMU velocities and biases are free, too. `fusion.solver` takes the steps.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.fusion.inertial import Inertial
from steelnb.fusion.poses import moved_poses, pose_size, yaw_of
from steelnb.types import Array, Segments

BAR = 6
"""Degrees of freedom of a bar: two of place, two of direction, turn, flange."""
BAR_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.003])
"""Standard deviations of a bar: of place and direction for one step, for what its points do not tell, such as the place
of a face seen from one side alone along that face; of turn and flange about those fitted to the outlines, which take no
part here. Chosen on the development seed 11."""
FLANGE_MIN_M, FLANGE_MAX_M = 0.01, 0.4


@dataclass(frozen=True)
class Bars:
    """B bars with their sections: ``segments`` along their centroids, frames ``across (B, 2, 3)``, ``turn (B,)`` in
    radians and ``flange (B,)`` in metres as in `fusion.sections`, round tubes among them; a bar with a flange of NaN
    takes no part."""

    segments: Segments
    across: Array
    turn: Array
    flange: Array

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which of them take part ``(B,)``."""
        return np.isfinite(self.flange)

    def sectioned(self) -> "Bars":
        """Those that take part."""
        known = self.known
        return Bars(self.segments.take(known), self.across[known], self.turn[known], self.flange[known])


@dataclass(frozen=True)
class Problem:
    """The state of an adjustment: ``T_world_sensor (K, 4, 4)``, the bars, ``sigma_ratio``, by which the range noise of
    these scans exceeds that of `points.ranges`, the bars' ``fitted (B, 2)`` turns and flanges, and the standard
    deviation of the prior's roll and pitch, 0 where they are kept.
    ``inertial`` is None without an IMU.
    """

    T_world_sensor: Array
    bars: Bars
    sigma_ratio: float
    fitted: Array
    tilt_sigma_rad: float = 0.0
    inertial: Inertial | None = None

    def from_fitted(self) -> Array:
        """How far turns and flanges ``(B, 2)`` are from those fitted to outlines; 0 for bars that take no part."""
        return np.nan_to_num(np.column_stack([self.bars.turn, self.bars.flange]) - self.fitted)

    def moved(self, state_step: Array, bar_step: Array, sigma_ratio: float) -> "Problem":
        """After steps ``(K, D)`` of the states, D as in `solver.StateEquations`, and ``(B, 6)`` of the bars."""
        pose_step = state_step[:, : pose_size(self.tilt_sigma_rad)]
        return replace(
            self, T_world_sensor=moved_poses(self.T_world_sensor, pose_step), bars=_moved_bars(self.bars, bar_step),
            inertial=self.inertial and self.inertial.moved(state_step), sigma_ratio=sigma_ratio,
        )  # fmt: skip


def start(
    T_world_sensor: Array,
    prior: Array,
    bars: Bars,
    tilt_sigma_rad: float = 0.0,
    inertial: Inertial | None = None,
) -> Problem:
    """The state before the first step: the poses laid on the first one of the ``prior (K, 4, 4)``, and the bars with
    them, by a turn about z and a shift."""
    between = prior[0, :3, :3] @ T_world_sensor[0, :3, :3].T
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, yaw_of(between)]).as_matrix()
    turn[:3, 3] = prior[0, :3, 3] - turn[:3, :3] @ T_world_sensor[0, :3, 3]
    segments = bars.segments.transformed(turn)
    turned = Bars(segments, bars.across @ turn[:3, :3].T, bars.turn, bars.flange)
    fitted = np.column_stack([bars.turn, bars.flange])
    inertial = inertial and inertial.turned(turn[:3, :3])
    return Problem(turn @ T_world_sensor, turned, 1.0, fitted, tilt_sigma_rad, inertial)


def _moved_bars(bars: Bars, step: Array) -> Bars:
    old, half_length = bars.segments, 0.5 * bars.segments.length[:, None]
    place, tilt = step[:, :2], step[:, 2:4]
    ends = [each + np.einsum("bk,bkx->bx", place + s * half_length * tilt, bars.across) for s, each in
            ((-1, old.start), (1, old.end))]  # fmt: skip
    new = Segments(ends[0], ends[1], old.count, old.radius)
    first = bars.across[:, 0] - (bars.across[:, 0] * new.direction).sum(axis=1)[:, None] * new.direction
    first /= np.linalg.norm(first, axis=1)[:, None]
    across = np.stack([first, np.cross(new.direction, first)], axis=1)
    return Bars(new, across, bars.turn + step[:, 4], np.clip(bars.flange + step[:, 5], FLANGE_MIN_M, FLANGE_MAX_M))
