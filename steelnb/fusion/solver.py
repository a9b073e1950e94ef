"""Gauss-Newton on the problem of an adjustment (`fusion.problem`): normal equations and steps.

Poses form a chain and see few bars each, so their block tridiagonal matrix is eliminated first (Schur complement).
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import block_diag, cho_factor, cho_solve

from steelnb.fusion.bar_voxels import Observations
from steelnb.fusion.factors import PointEquations, increments, linearised, noise_ratio
from steelnb.fusion.inertial import STATE
from steelnb.fusion.problem import BAR_SIGMA, Problem
from steelnb.types import Array

TINY = 1e-12
"""What is smaller counts as zero: what a bar tells fades from pose to pose once it is out of view, and numbers that
fade on until they are denormal take long."""


def adjusted(
    problem: Problem, observations: Observations, prior: Array, stamp_s: Array, steps: int
) -> tuple[Problem, PointEquations]:
    """The problem after some steps of `improve` with the same points, and the equations of the last one."""
    for _ in range(steps):
        equations = linearised(problem, observations)
        problem = improve(problem, equations, prior, stamp_s)
    return problem, equations


def improve(problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array) -> Problem:
    """One Gauss-Newton step of all poses and bars; ``prior (K, 4, 4)`` are the sensor's drifting poses at ``stamp_s``,
    the equations those of this state (`factors.linearised`).

    The range noise is taken from the residuals before the step (their median).
    """
    rhs = equations.right.copy()
    rhs[:, 4:] -= problem.from_fitted() * BAR_SIGMA[4:] ** -2.0
    matrix, beside, vector, between = state_equations(problem, equations, prior, stamp_s)
    chain = Chain.factored(matrix, beside)
    forward = chain.forward(np.concatenate([between, vector[:, :, None]], axis=2))
    flat = forward.reshape(-1, forward.shape[2])
    eliminated = flat.T @ flat
    bar_step = cho_solve(cho_factor(schur(equations.block, eliminated[:-1, :-1])), rhs.ravel() - eliminated[:-1, -1])
    state_step = chain.backward((forward[:, :, -1] - forward[:, :, :-1] @ bar_step)[:, :, None])[:, :, 0]
    ratio = noise_ratio(equations.residuals, problem.sigma_ratio)
    return problem.moved(state_step, bar_step.reshape(rhs.shape), ratio)


class StateEquations(NamedTuple):
    """Normal equations of the states of K scans, by points, prior and IMU: ``matrix (K, D, D)``, between each and the
    next ``beside (K − 1, D, D)``, ``vector (K, D)``, and between states and bars ``between (K, D, 6 B)``. A state is a
    pose, D = 4 or 6; with an IMU it has velocity and biases, too, D = 15."""

    matrix: Array
    beside: Array
    vector: Array
    between: Array


def state_equations(problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array) -> StateEquations:
    """The normal equations of all states; the arguments are those of `improve`."""
    T, inertial = problem.T_world_sensor, problem.inertial
    matrix, beside, vector = increments(T, prior, stamp_s, problem.tilt_sigma_rad, inertial is None)
    matrix, vector, between = matrix + equations.matrix, vector + equations.vector, equations.between()
    if inertial is None:
        return StateEquations(matrix, beside, vector, between)
    by_imu, more = inertial.equations(T), (0, STATE - matrix.shape[1])
    return StateEquations(
        by_imu.matrix + np.pad(matrix, ((0, 0), more, more)),
        by_imu.beside + np.pad(beside, ((0, 0), more, more)),
        by_imu.vector + np.pad(vector, ((0, 0), more)),
        np.pad(between, ((0, 0), more, (0, 0))),
    )  # fmt: skip


def schur(block: Array, eliminated: Array) -> Array:
    """The normal equations of the bars ``(6 B, 6 B)`` once the poses are ``eliminated (6 B, 6 B)``: their Schur
    complement."""
    return np.asarray(block_diag(*(block + np.diag(BAR_SIGMA**-2.0))) - eliminated)


class Chain(NamedTuple):
    """The factor L of a matrix A = L Lᵀ of K poses: inverses of its diagonal blocks ``own (K, D, D)``; and the share of
    the neighbour's solution in that of each pose, of the one before in L⁻¹, ``onward (K, D, D)``, and of the one behind
    in L⁻ᵀ, ``back (K, D, D)``."""

    own: Array
    onward: Array
    back: Array

    @classmethod
    def factored(cls, matrix: Array, beside: Array) -> "Chain":
        """From the blocks of A on its diagonal ``(K, D, D)`` and above it ``(K − 1, D, D)``.

        Raises `numpy.linalg.LinAlgError` where A is not positive definite.
        """
        chain = cls(*np.zeros((3, *matrix.shape)))
        _factor(np.ascontiguousarray(matrix), np.ascontiguousarray(beside), *chain)
        return chain

    def forward(self, right: Array) -> Array:
        """L⁻¹ times the columns ``right (K, D, M)``."""
        result = self.own @ right
        _sweep(self.onward, result, False)
        return result

    def backward(self, forward: Array) -> Array:
        """L⁻ᵀ times the columns ``forward (K, D, M)``: A⁻¹ times columns, where ``forward`` is L⁻¹ times them."""
        result = self.own.transpose(0, 2, 1) @ forward
        _sweep(self.back, result, True)
        return result

    def inverse_blocks(self) -> Array:
        """The blocks on the diagonal of A⁻¹ ``(K, D, D)``, from the last to the first (Takahashi, Fagan, Chen 1973)."""
        result = self.own.transpose(0, 2, 1) @ self.own
        for k in range(len(result) - 2, -1, -1):
            result[k] += self.back[k] @ result[k + 1] @ self.back[k].T
        return result


@njit(cache=True)
def _factor(matrix, beside, own, onward, back):  # type: ignore[no-untyped-def]
    for k in range(len(matrix)):
        block = matrix[k].copy()
        if k:
            above = own[k - 1] @ beside[k - 1]  # the block of Lᵀ
            block -= above.T @ above
        own[k] = np.linalg.inv(np.linalg.cholesky(block))
        if k:
            onward[k] = -own[k] @ above.T
            back[k - 1] = -own[k - 1].T @ above


@njit(cache=True)
def _sweep(share, columns, backwards):  # type: ignore[no-untyped-def]
    """Add to the columns of each pose their share of those of its neighbour, from neighbour to neighbour."""
    poses, size, count = columns.shape
    for i in range(1, poses):
        k, other = (poses - 1 - i, poses - i) if backwards else (i, i - 1)
        for m in range(count):
            largest = 0.0
            for d in range(size):
                largest = max(largest, abs(columns[other, d, m]))
            if largest > TINY:
                for n in range(size):
                    for d in range(size):
                        columns[k, n, m] += share[k, n, d] * columns[other, d, m]
