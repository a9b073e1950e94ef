"""Bundle adjustment: all poses of a flight and all its bars, sections included, as one maximum a posteriori problem.

Odometry places each scan against a map that holds the errors of the scans before it. Here poses and bars move at once
(Triggs et al., "Bundle adjustment: a modern synthesis", 1999). The factors:

- the distance of each point to the front face of its bar (`fusion.sections`) along the line of sight, with the range
  noise as its standard deviation and robust weights;
- the increments of the drifting prior from scan to scan, in the frame of the earlier pose;
- the first pose, which is the prior's: drift begins there;
- the readings of an IMU from scan to scan, where there are any (`fusion.inertial`).

Free are position and yaw of each pose, and place, direction, turn and flange of each bar. Roll and pitch are the
prior's; or free, too, where the prior's have a standard deviation: their error is then a first-order Gauss-Markov
process. With an IMU velocities and biases are free, too.
Poses form a chain and see few bars each, so their block tridiagonal matrix is eliminated first (Schur complement).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from steelnb.fusion import sections
from steelnb.fusion.bar_equations import Bars, Equations, equations, noise_ratio
from steelnb.fusion.bar_voxels import Observations
from steelnb.fusion.chain import Chain
from steelnb.fusion.inertial import STATE, Inertial
from steelnb.fusion.poses import increments, moved_poses, pose_size, yaw_of
from steelnb.types import Array, Segments

BAR_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.003])
"""Standard deviations of a bar: of place and direction for one step, for what its points do not tell, such as the place
of a face seen from one side alone along that face; of turn and flange about those fitted to the outlines, which take no
part here. Chosen on the development seed 11."""
FLANGE_MIN_M, FLANGE_MAX_M = 0.01, 0.4


@dataclass(frozen=True)
class Bundle:
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


def start(
    T_world_sensor: Array,
    prior: Array,
    bars: Bars,
    tilt_sigma_rad: float = 0.0,
    inertial: Inertial | None = None,
) -> Bundle:
    """The state before the first step: the poses laid on the first one of the ``prior (K, 4, 4)``, and the bars with
    them, by a turn about z and a shift."""
    between = prior[0, :3, :3] @ T_world_sensor[0, :3, :3].T
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, yaw_of(between)]).as_matrix()
    turn[:3, 3] = prior[0, :3, 3] - turn[:3, :3] @ T_world_sensor[0, :3, 3]
    segments = bars.segments.transformed(turn)
    moved = Bars(segments, bars.across @ turn[:3, :3].T, bars.turn, bars.flange)
    fitted = np.column_stack([bars.turn, bars.flange])
    inertial = inertial and inertial.turned(turn[:3, :3])
    return Bundle(turn @ T_world_sensor, moved, 1.0, fitted, tilt_sigma_rad, inertial)


def improve(bundle: Bundle, equations: Equations, prior: Array, stamp_s: Array) -> Bundle:
    """One Gauss-Newton step of all poses and bars; ``prior (K, 4, 4)`` are the sensor's drifting poses at ``stamp_s``,
    the equations those of this state (`linearised`).

    The range noise is taken from the residuals before the step (their median).
    """
    T, bars = bundle.T_world_sensor, bundle.bars
    right = equations.right.copy()
    right[:, 4:] -= from_fitted(bundle) * BAR_SIGMA[4:] ** -2.0
    matrix, beside, vector, between = state_equations(bundle, equations, prior, stamp_s)
    poses = Chain.factored(matrix, beside)
    half = poses.half(np.concatenate([between, vector[:, :, None]], axis=2))
    flat = half.reshape(-1, half.shape[2])
    told = flat.T @ flat
    moved = cho_solve(cho_factor(reduced(equations.block, told[:-1, :-1])), right.ravel() - told[:-1, -1])
    step = poses.rest((half[:, :, -1] - half[:, :, :-1] @ moved)[:, :, None])[:, :, 0]
    return replace(
        bundle, T_world_sensor=moved_poses(T, step[:, : pose_size(bundle.tilt_sigma_rad)]),
        bars=_moved_bars(bars, moved.reshape(right.shape)), inertial=bundle.inertial and bundle.inertial.moved(step),
        sigma_ratio=noise_ratio(equations.residuals, bundle.sigma_ratio),
    )  # fmt: skip


def adjusted(bundle: Bundle, seen: Observations, prior: Array, stamp_s: Array, steps: int) -> tuple[Bundle, Equations]:
    """The state after some steps of `improve` with the same points, and the equations of the last one."""
    for _ in range(steps):
        points = linearised(bundle, seen)
        bundle = improve(bundle, points, prior, stamp_s)
    return bundle, points


class StateEquations(NamedTuple):
    """Normal equations of the states of K scans, by points, prior and IMU: ``matrix (K, D, D)``, between each and the
    next ``beside (K − 1, D, D)``, ``vector (K, D)``, and between states and bars ``between (K, D, 6 B)``. A state is a
    pose, D = 4 or 6; with an IMU it has velocity and biases, too, D = 15."""

    matrix: Array
    beside: Array
    vector: Array
    between: Array


def state_equations(bundle: Bundle, equations: Equations, prior: Array, stamp_s: Array) -> StateEquations:
    """The normal equations of all states; the arguments are those of `improve`."""
    T, inertial = bundle.T_world_sensor, bundle.inertial
    matrix, beside, vector = increments(T, prior, stamp_s, bundle.tilt_sigma_rad, inertial is None)
    matrix, vector, between = matrix + equations.matrix, vector + equations.vector, equations.between()
    if inertial is None:
        return StateEquations(matrix, beside, vector, between)
    told, more = inertial.equations(T), (0, STATE - matrix.shape[1])
    return StateEquations(
        told.matrix + np.pad(matrix, ((0, 0), more, more)),
        told.beside + np.pad(beside, ((0, 0), more, more)),
        told.vector + np.pad(vector, ((0, 0), more)),
        np.pad(between, ((0, 0), more, (0, 0))),
    )  # fmt: skip


def from_fitted(bundle: Bundle) -> Array:
    """How far turns and flanges ``(B, 2)`` are from those fitted to outlines; 0 for bars that take no part."""
    return np.nan_to_num(np.column_stack([bundle.bars.turn, bundle.bars.flange]) - bundle.fitted)


def linearised(bundle: Bundle, seen: Observations) -> Equations:
    """The normal equations of all points, without what is known beforehand."""
    bars = bundle.bars
    corner = sections.outlines(bars.turn, np.where(bars.known, bars.flange, 0.05))
    return equations(seen, bundle.T_world_sensor, bars, corner, bundle.sigma_ratio, pose_size(bundle.tilt_sigma_rad))


def reduced(block: Array, told: Array) -> Array:
    """The normal equations of the bars ``(6 B, 6 B)`` once the poses, which ``told`` that much, are eliminated (Schur
    complement)."""
    return np.asarray(block_diag(*(block + np.diag(BAR_SIGMA**-2.0))) - told)


def _moved_bars(bars: Bars, step: Array) -> Bars:
    old, half = bars.segments, 0.5 * bars.segments.length[:, None]
    place, tilt = step[:, :2], step[:, 2:4]
    ends = [each + np.einsum("bk,bkx->bx", place + s * half * tilt, bars.across) for s, each in
            ((-1, old.start), (1, old.end))]  # fmt: skip
    new = Segments(ends[0], ends[1], old.count, old.radius)
    first = bars.across[:, 0] - (bars.across[:, 0] * new.direction).sum(axis=1)[:, None] * new.direction
    first /= np.linalg.norm(first, axis=1)[:, None]
    across = np.stack([first, np.cross(new.direction, first)], axis=1)
    return Bars(new, across, bars.turn + step[:, 4], np.clip(bars.flange + step[:, 5], FLANGE_MIN_M, FLANGE_MAX_M))
