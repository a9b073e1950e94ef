"""Gauss-Newton on the problem of an adjustment (`adjustment.problem`): normal equations and steps.

The poses form a chain, so their matrix is block tridiagonal. They are eliminated first, and the bars are solved for by
the Schur complement.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from steelnb.core.kernels import njit
from steelnb.core.types import Array
from steelnb.fusion.adjustment.factors import PointEquations, common_thickness, noise_ratio, prior_equations
from steelnb.fusion.adjustment.imu_factors import STATE_DOF, ChainEquations
from steelnb.fusion.adjustment.mount import DroneEquations
from steelnb.fusion.adjustment.problem import BAR_DOF, BAR_SIGMA, Problem, pose_size

TINY = 1e-12
"""Smaller numbers count as zero. The contributions of a bar decay from pose to pose once it is out of view, and
arithmetic with denormal numbers is slow."""


def improve(problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array) -> Problem:
    """One Gauss-Newton step of all poses and bars.

    ``equations``: those of this state (`factors.linearised`); ``prior (K, 4, 4)``: the drifting poses of the
    sensor at ``stamp_s (K,)``. The range noise and the thickness are updated from medians before the step.
    """
    (matrix, beside, vector), between, bars, rhs = normal_equations(problem, equations, prior, stamp_s)
    chain = Chain.factored(matrix, beside)
    forward = chain.forward(np.concatenate([between, vector[:, :, None]], axis=2))
    flat = forward.reshape(-1, forward.shape[2])
    eliminated = flat.T @ flat
    step = cho_solve(cho_factor(bars - eliminated[:-1, :-1]), rhs - eliminated[:-1, -1])
    state_step = chain.backward((forward[:, :, -1] - forward[:, :, :-1] @ step)[:, :, None])[:, :, 0]
    bar_step, mount_step = np.split(step, [BAR_DOF * len(equations.block)])
    thickness, by_thickness = common_thickness(problem, equations)
    ratio = noise_ratio(equations.residuals, problem.sigma_ratio)
    bar_step = bar_step.reshape(-1, BAR_DOF) + by_thickness
    return problem.moved(state_step, bar_step, ratio, thickness, mount_step)


def normal_equations(
    problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array
) -> tuple[ChainEquations, Array, Array, Array]:
    """The normal equations of all factors: those of the states of K scans, the block ``(K, D, 6 B + S)`` between states
    and what they share, and the matrix ``(6 B + S, 6 B + S)`` and vector ``(6 B + S,)`` of the latter: the bars, then S
    of `Mount.of_drone`. For the arguments see `improve`.

    A state is a pose, D = 4 or 6; with an IMU it includes velocity and biases, D = 15.
    """
    T, inertial, mount, rhs = problem.poses, problem.inertial, problem.mount, equations.rhs[:, :BAR_DOF].copy()
    points: PointEquations | DroneEquations = equations
    if mount:
        points = mount.of_drone(equations, problem.T_world_sensor, pose_size(problem.tilt_sigma_rad))
    bars = block_diag(*(equations.block[:, :BAR_DOF, :BAR_DOF] + np.diag(BAR_SIGMA**-2.0)))
    from_fitted = np.column_stack([problem.bars.turn, problem.bars.flange]) - problem.fitted
    rhs[:, 4:] -= np.nan_to_num(from_fitted) * BAR_SIGMA[4:] ** -2.0  # NaN if a section has none
    chain = prior_equations(T, prior, stamp_s, problem.tilt_sigma_rad, inertial is None, problem.drift)
    matrix, beside, vector = chain.matrix + points.matrix, chain.beside, chain.vector + points.vector
    between = np.zeros((*vector.shape, *rhs.shape))
    between[equations.pair_scan, :, equations.pair_bar] = points.cross[:, :, :BAR_DOF]
    between, rhs = between.reshape(*vector.shape, -1), rhs.ravel()
    if isinstance(points, DroneEquations):
        shared = points.shared
        by_bar = shared.by_bar[:, :BAR_DOF].reshape(len(rhs), -1)
        between = np.concatenate([between, shared.by_pose], axis=2)
        bars, rhs = np.block([[bars, by_bar], [by_bar.T, shared.matrix]]), np.append(rhs, shared.vector)
    if inertial is not None:
        by_imu, padding = inertial.equations(T), (0, STATE_DOF - matrix.shape[1])
        matrix, beside = (np.pad(each, ((0, 0), padding, padding)) for each in (matrix, beside))
        vector, between = np.pad(vector, ((0, 0), padding)), np.pad(between, ((0, 0), padding, (0, 0)))
        matrix, beside, vector = by_imu.matrix + matrix, by_imu.beside + beside, by_imu.vector + vector
    return ChainEquations(matrix, beside, vector), between, bars, rhs


class Chain(NamedTuple):
    """Block Cholesky factor L of a block tridiagonal matrix A = L Lᵀ of K poses.

    ``inverse (K, D, D)``: inverses of the diagonal blocks of L. ``onward`` and ``back (K, D, D)``: coefficients of the
    previous pose's solution in forward substitution, and of the next pose's in back substitution.
    """

    inverse: Array
    onward: Array
    back: Array

    @classmethod
    def factored(cls, matrix: Array, beside: Array) -> "Chain":
        """Factor A from its blocks on the diagonal ``(K, D, D)`` and above it ``(K − 1, D, D)``.

        Raises `numpy.linalg.LinAlgError` if A is not positive definite.
        """
        chain = cls(*np.zeros((3, *matrix.shape)))
        _factor(np.ascontiguousarray(matrix), np.ascontiguousarray(beside), *chain)
        return chain

    def forward(self, columns: Array) -> Array:
        """L⁻¹ times the ``columns (K, D, M)``."""
        result = self.inverse @ columns
        _sweep(self.onward, result, False)
        return result

    def backward(self, forward: Array) -> Array:
        """L⁻ᵀ times the columns ``forward (K, D, M)``. After `forward`, this is A⁻¹ times the original columns."""
        result = self.inverse.transpose(0, 2, 1) @ forward
        _sweep(self.back, result, True)
        return result

    def inverse_blocks(self) -> Array:
        """The blocks on the diagonal of A⁻¹ ``(K, D, D)``, from the last to the first (Takahashi, Fagan, Chen 1973)."""
        result = self.inverse.transpose(0, 2, 1) @ self.inverse
        for k in range(len(result) - 2, -1, -1):
            result[k] += self.back[k] @ result[k + 1] @ self.back[k].T
        return result


@njit(cache=True)
def _factor(matrix, beside, inverse, onward, back):  # type: ignore[no-untyped-def]
    for k in range(len(matrix)):
        block = matrix[k].copy()
        if k:
            above = inverse[k - 1] @ beside[k - 1]  # the block of Lᵀ
            block -= above.T @ above
        inverse[k] = np.linalg.inv(np.linalg.cholesky(block))
        if k:
            onward[k] = -inverse[k] @ above.T
            back[k - 1] = -inverse[k - 1].T @ above


@njit(cache=True)
def _sweep(coefficient, columns, backwards):  # type: ignore[no-untyped-def]
    """Substitution along the chain: add to each pose its coefficient times its neighbour's columns."""
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
                        columns[k, n, m] += coefficient[k, n, d] * columns[other, d, m]
