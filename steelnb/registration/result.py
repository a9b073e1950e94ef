"""The result of a registration: pose, convergence, covariance, weakly constrained directions."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from steelnb.types import Array

WEAK = 0.01
"""A direction is weak where its eigenvalue is below this share of the largest."""
BLIND = 1e-10
"""Below this share a direction is unconstrained, and the solver does not move along it."""
UNKNOWN_M2 = 1e12


class Normal(NamedTuple):
    """Normal equations at a pose, of twists about ``centre (3,)``: ``H (6, 6)``, ``b (6,)``, the loss, the number of
    pairs within the largest distance, the sum of their squared distances, and ``spread (6, 6)``, the sum of the outer
    products of their gradients (and the prior's information)."""

    H: Array
    b: Array
    centre: Array
    loss: float
    inliers: int
    squares: float
    spread: Array


@dataclass(frozen=True)
class RegistrationResult:
    """Pose, convergence and uncertainty of a registration.

    ``T_target_source (4, 4)``; ``converged``; ``iterations``; ``inliers``, pairs within the largest distance;
    ``rmse_m`` of their distances; ``reason`` why it stopped.

    The rest is about twists ξ = (ω, v) in the axes of the target: a turn about ``centre (3,)``, the middle of the
    source under the pose, and the shift of that centre. ``H (6, 6)`` and ``b (6,)`` are the normal equations at the
    end; ``covariance (6, 6)`` is ξ's, in rad and m, zero in directions that were not free and 1e12 m² in
    unconstrained ones. ``eigenvalues (k,)`` of H in the free directions, ascending, with turns measured by the
    displacement at ``length_m`` from the centre (the cloud's root mean square radius), so that turns and shifts
    compare; ``weak (w, 6)``, the unit twists (ω · length_m, v) whose eigenvalue is below 1 % of the largest. For
    the error ``point`` the shifts' part of H is N·I whatever the scene, so it cannot see a degenerate one: judge by
    ``plane`` or ``gicp``. ``unobserved (u, 3)``, unit vectors: shifts that were left out of the solve, since the
    surfaces paired have no normals along them (`observability.unobserved_shifts`).
    """

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int
    rmse_m: float
    H: Array
    b: Array
    covariance: Array
    eigenvalues: Array
    weak: Array
    reason: str
    centre: Array
    length_m: float
    unobserved: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def covariance_at(self, point: Array) -> Array:
        """Covariance ``(6, 6)`` of the turn and the shift of another point ``(3,)`` of the target frame.

        ``covariance_at(T_target_source[:3, 3])`` is that of the source's pose.
        """
        J = np.eye(6)
        x, y, z = np.asarray(point) - self.centre
        J[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return J @ self.covariance @ J.T


def middle_and_length(points: Array) -> tuple[Array, float]:
    """Mean ``(3,)`` of points ``(N, 3)`` and their root mean square distance to it, m; 1 where they coincide."""
    columns = [np.ascontiguousarray(column) for column in points.T]  # means of columns in rows take seven times as long
    middle = np.array([column.mean() for column in columns])
    return middle, math.sqrt(sum(column.var() for column in columns)) or 1.0


def scaled_basis(free: Array, length_m: float) -> Array:
    """Columns ``(6, k)`` that span the free directions, orthonormal where turns count ``length_m`` times."""
    scale = np.array([length_m] * 3 + [1.0] * 3)
    return np.linalg.qr(scale[:, None] * free)[0] / scale[:, None]


def judge(
    T: Array,
    converged: bool,
    iterations: int,
    normal: Normal,
    basis: Array,
    length_m: float,
    rank: int,
    reason: str,
    unobserved: Array,
) -> RegistrationResult:
    """Work out covariance and weak directions from the normal equations at the end.

    The covariance is H⁻¹ (Σ gᵢ gᵢᵀ) H⁻¹ with the pairs' gradients gᵢ (White, Econometrica 48, 1980): it needs no unit
    of the covariances that GICP is given, but takes pairs as right and independent. ``rank`` is the
    number of residuals of a pair: 1 for planes, else 3.
    """
    A = basis.T @ normal.H @ basis
    value, vector = np.linalg.eigh(A if np.isfinite(A).all() else np.zeros_like(A))
    top = max(float(value[-1]), 1e-300)
    seen = value > BLIND * top
    inverse = (vector[:, seen] / value[seen]) @ vector[:, seen].T
    numbers = rank * normal.inliers
    growth = numbers / max(numbers - len(value), 1)
    spread = normal.spread if seen.any() else np.zeros((6, 6))
    inner = growth * inverse @ (basis.T @ spread @ basis) @ inverse
    inner += UNKNOWN_M2 * vector[:, ~seen] @ vector[:, ~seen].T
    scale = np.array([length_m] * 3 + [1.0] * 3)
    return RegistrationResult(
        T_target_source=T,
        converged=converged,
        iterations=iterations,
        inliers=normal.inliers,
        rmse_m=math.sqrt(normal.squares / normal.inliers) if normal.inliers else math.inf,
        H=normal.H,
        b=normal.b,
        covariance=basis @ inner @ basis.T,
        eigenvalues=value,
        weak=(scale[:, None] * basis @ vector[:, value < WEAK * top]).T,
        reason=reason,
        centre=normal.centre,
        length_m=length_m,
        unobserved=unobserved,
    )
