"""Covariances of a smoothed flight: of its poses and its bars, from the equations of `fusion.solver`.

The inverse of all normal equations is needed in its diagonal blocks alone. Those of the chain of poses come from its
factors (`fusion.solver`); what the bars add to them has the rank of the bars: A⁻¹B S⁻¹ (A⁻¹B)ᵀ with their Schur
complement S. Nothing is approximated.

Points of one bar in one scan share an error: its section is fitted, mixed pixels lie at its edges, and a sensor sees
the near side. Each scan therefore sees a bar displaced across by an unknown vector, which is eliminated: the
information of a bar in a scan saturates, however many pixels it has. The drift enters by the increments of the prior.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from steelnb.errors import InputError
from steelnb.fusion.factors import PointEquations, summed
from steelnb.fusion.poses import POSE, pose_size
from steelnb.fusion.problem import BAR, Problem
from steelnb.fusion.sections import frames
from steelnb.fusion.solver import Chain, schur, state_equations
from steelnb.types import Array, Segments

SHARED_SIGMA_M = 0.001
"""Standard deviation, an axis, of the displacement that all points of a bar in a scan share, at the range noise of
`points.ranges`; it grows with the square of that noise, which is what two sensors show. Calibrated on seeds
11 to 15."""
END_SIGMA_M = 0.006
"""Standard deviation, an axis, of the error that a bar's model has at either end whatever the scan: of a section type
that is not modelled, or fitted to a part of the bar. Added to the covariance of an axis; calibrated with the former.
It grows with the range noise."""
ATTITUDE_SIGMA_RAD = 0.01
"""Standard deviation of roll and pitch where they are the prior's: half a degree, as of attitude filters on small
drones. Simulated attitudes are exact unless the noise has tilt, so there it is too large. The position does not contain
it."""
FREE_SIGMA = 10.0
"""A larger standard deviation, metres or radians, means that nothing holds that direction."""
HOLD = 1e-6
"""Information that keeps free directions of poses from breaking the factorisation: a standard deviation of 1 km."""


class Marginals(NamedTuple):
    """Marginal covariances: ``pose (K, D, D)`` of the steps of the sensor's poses (`fusion.poses`), the first one zero
    since it is held there; ``bar (B, 6, 6)`` of the position of a bar's middle (2) and its direction (2) in the frame
    ``across``, of its turn and flange. What no point of a bar determines has the standard deviation of
    `problem.BAR_SIGMA`, for directions half a metre per metre."""

    pose: Array
    bar: Array


def marginals(
    problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array, shared_sigma_m: float | None = None
) -> Marginals:
    """The marginal covariances of the state of an adjustment; the arguments are those of `solver.improve`.

    ``shared_sigma_m``: by default `SHARED_SIGMA_M` times the square of the state's ``sigma_ratio``. Raises
    `InputError` where the equations are not finite or nothing holds a pose, with the direction that is free.
    """
    sigma_m = SHARED_SIGMA_M * problem.sigma_ratio**2 if shared_sigma_m is None else shared_sigma_m
    equations = _displaced(equations, sigma_m) if sigma_m else equations
    n = len(equations.block)
    matrix, beside, _, between = state_equations(problem, equations, prior, stamp_s)
    matrix = matrix + HOLD * np.eye(matrix.shape[1])
    if not (np.isfinite(matrix).all() and np.isfinite(beside).all() and np.isfinite(equations.cross).all()):
        raise InputError("normal equations that are not finite: expected finite poses, stamps and points")
    chain = Chain.factored(matrix, beside)
    forward = chain.forward(between)
    flat = forward.reshape(-1, forward.shape[2])
    inverse = cho_solve(cho_factor(schur(equations.block, flat.T @ flat)), np.eye(flat.shape[1]))
    size = pose_size(problem.tilt_sigma_rad)
    by_bars = chain.backward(forward)[:, :size]
    pose = chain.inverse_blocks()[:, :size, :size] + (by_bars @ inverse) @ by_bars.transpose(0, 2, 1)
    pose[0] = 0.0
    check_covariances(pose[1:], "pose", ("roll", "pitch", "yaw", "x", "y", "z")[-size:], first=1)
    bars = np.arange(n)
    return Marginals(pose, inverse.reshape(n, BAR, n, BAR)[bars, :, bars])


def _displaced(equations: PointEquations, sigma_m: float) -> PointEquations:
    """The equations where all points of a bar in one scan are displaced across by an unknown vector."""
    cross, shares, scan = equations.cross, equations.shares, equations.pair_scan
    unknown = np.linalg.inv(shares[:, :2, :2] + np.eye(2) / sigma_m**2)
    lost = cross[:, :, :2] @ unknown
    of_poses, of_bars = lost @ cross[:, :, :2].transpose(0, 2, 1), shares[:, :, :2] @ unknown @ shares[:, :2]
    return equations._replace(
        matrix=equations.matrix - summed(of_poses, scan, len(equations.matrix)),
        block=equations.block - summed(of_bars, equations.pair_bar, len(equations.block)),
        cross=cross - lost @ shares[:, :2],
        shares=shares - of_bars,
    )


def pose_covariances(pose: Array, T_world_sensor: Array, T_drone_sensor: Array) -> Array:
    """Covariances ``(K, 6, 6)`` of the drone's poses, from those of the sensor's ``(K, D, D)``; metres and radians.

    In the order x, y, z, roll, pitch, yaw of the perturbation δ by which the true pose is that of the estimate:
    t + δ[:3] and exp(δ[3:]) R, both in the axes of the world. The first pose defines the world, so its block is zero.
    """
    arm = (T_world_sensor @ np.linalg.inv(T_drone_sensor))[:, :3, 3] - T_world_sensor[:, :3, 3]
    size = pose.shape[1]
    by_step = np.tile(np.eye(size), (len(pose), 1, 1))
    for column, axis in enumerate(range(6 - size, 3)):
        by_step[:, -3:, column] = np.cross(np.eye(3)[axis], arm)
    result, order = np.zeros((len(pose), 6, 6)), np.array([3, 4, 5, 0, 1, 2])[-size:]
    result[:, order[:, None], order] = by_step @ pose @ by_step.transpose(0, 2, 1)
    if size == POSE:
        result[1:, [3, 4], [3, 4]] = ATTITUDE_SIGMA_RAD**2
    return result


def axis_covariances(bar: Array, segments: Segments, across: Array, sigma_ratio: float = 1.0) -> Array:
    """Covariances ``(B, 4, 4)`` of the axes of bars, from their marginals in the frames ``across``.

    They contain `END_SIGMA_M` times ``sigma_ratio``, the range noise as a multiple of that of `points.ranges`.
    In the frame `sections.frames` of each segment's direction: two of the place of its middle across, metres, and two
    of its direction, metres across for a metre along.
    """
    turn = frames(segments.direction) @ across.transpose(0, 2, 1)
    both = np.zeros((len(bar), 4, 4))
    both[:, :2, :2] = both[:, 2:, 2:] = turn
    result = both @ bar[:, :4, :4] @ both.transpose(0, 2, 1)
    end_m2 = (END_SIGMA_M * sigma_ratio) ** 2
    result[:, [0, 1], [0, 1]] += 0.5 * end_m2
    result[:, [2, 3], [2, 3]] += 2.0 * end_m2 / np.maximum(segments.length, 1e-9)[:, None] ** 2
    return np.asarray(result)


def axis_sigma_m(covariance: Array, along_m: Array) -> Array:
    """Standard deviation ``(B,)`` of axes across, metres, in the direction in which it is largest, from their
    covariances ``(B, 4, 4)`` at places ``along_m (B,)`` from their middles."""
    at = np.concatenate([np.tile(np.eye(2), (len(along_m), 1, 1)), along_m[:, None, None] * np.eye(2)], axis=2)
    return np.sqrt(np.linalg.eigvalsh(at @ covariance @ at.transpose(0, 2, 1))[:, -1])


def check_covariances(covariance: Array, what: str, axes: tuple[str, ...], first: int = 0) -> None:
    """Raise `InputError` for the first of N covariances ``(N, D, D)`` that is not finite, not positive definite, or
    so large that nothing holds it (`FREE_SIGMA`); with its number from ``first`` on, and the direction."""
    bad = ~np.isfinite(covariance).all(axis=(1, 2))
    if bad.any():
        raise InputError(f"covariance of {what} {first + int(np.argmax(bad))} is not finite")
    value, vector = np.linalg.eigh(covariance)
    for end, wrong, says in (
        (-1, value[:, -1] > FREE_SIGMA**2, "singular: nothing holds it"),
        (0, value[:, 0] <= 0.0, "not positive definite"),
    ):
        if wrong.any():
            k = int(np.argmax(wrong))
            raise InputError(f"covariance of {what} {first + k} is {says} along {_named(vector[k, :, end], axes)}")


def _named(direction: Array, axes: tuple[str, ...]) -> str:
    """A direction as the names of its components, largest first, such as ``0.96 z + 0.28 x``."""
    sign = np.sign(direction[np.argmax(np.abs(direction))])
    order = [k for k in np.argsort(-np.abs(direction), kind="stable") if abs(direction[k]) > 0.05]
    return " + ".join(f"{sign * direction[k]:.2f} {axes[k]}" for k in order).replace("+ -", "- ")
