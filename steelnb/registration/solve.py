"""The one solver loop of the ICP family: correspond, linearise, solve in the free directions, until it stands still."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.registration import normal_equations as kernels
from steelnb.registration.feature_target import FeatureTarget
from steelnb.registration.observability import unobserved_shifts, without_shifts
from steelnb.registration.target import Target
from steelnb.types import Array, IntArray

ERRORS = {"point": kernels.POINT, "plane": kernels.PLANE, "gicp": kernels.GICP}
DOFS = ("xyz", "xyz_yaw", "se3")
BLIND = 1e-10
"""Below this share of the largest eigenvalue a direction is unconstrained, and the solver does not move along it."""

AnyTarget = Target | FeatureTarget
Term = Callable[[Array, Array], tuple[Array, Array, float]]
"""A further cost: (pose ``(4, 4)``, centre of the twist ``(3,)``) → its ``H (6, 6)``, ``b (6,)`` and loss."""


@dataclass(frozen=True)
class RegistrationResult:
    """Pose and convergence of a registration.

    ``T_target_source (4, 4)``; ``converged``; ``iterations``; ``inliers``, pairs within the largest distance;
    ``reason`` why it stopped.

    ``H (6, 6)`` and ``b (6,)`` are the normal equations at the end, of twists ξ = (ω, v) in the axes of the target: a
    turn about ``centre (3,)``, the middle of the source under the pose, and the shift of that centre. ``unobserved (u,
    3)``, unit vectors: shifts that were left out of the solve, since the surfaces paired have no normals along them
    (`observability.unobserved_shifts`).
    """

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int
    H: Array
    b: Array
    reason: str
    centre: Array
    unobserved: Array = field(default_factory=lambda: np.zeros((0, 3)))


class Normal(NamedTuple):
    """Normal equations at a pose, of twists about ``centre (3,)``: ``H (6, 6)``, ``b (6,)``, the loss, and the number
    of pairs within the largest distance."""

    H: Array
    b: Array
    centre: Array
    loss: float
    inliers: int


def free_directions(dof: str, gravity: Array | None = None) -> Array:
    """Columns ``(6, k)`` of ξ = (ω, v) that a solve may use: all, position and yaw about gravity, or position.

    ``gravity (3,)`` is its direction in the target frame, up or down; the z axis by default. Raises `InputError`.
    """
    if dof not in DOFS:
        raise InputError(f"dof = {dof!r}: expected one of {', '.join(map(repr, DOFS))}")
    up = np.array([0.0, 0.0, 1.0]) if gravity is None else np.asarray(gravity, dtype=np.float64)
    if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
        raise InputError(f"gravity = {gravity!r}: expected three finite numbers, not all zero")
    if dof == "se3":
        return np.eye(6)
    position = np.eye(6)[:, 3:]
    if dof == "xyz":
        return position
    return np.column_stack([np.append(up / np.linalg.norm(up), np.zeros(3)), position])


def align(
    source: Array,
    target: AnyTarget,
    error: str,
    free: Array,
    T_init: Array,
    max_correspondence_m: float,
    source_covariance: Array | None = None,
    robust_scale: float = math.inf,
    iterations_max: int = 50,
    rotation_epsilon_rad: float = math.radians(0.1),
    translation_epsilon_m: float = 1e-3,
    accelerated: bool = False,
    terms: Sequence[Term] = (),
    normals_min: float = 0.0,
) -> RegistrationResult:
    """Register ``source (N, 3)`` to a target from ``T_init``: Gauss–Newton in the columns of ``free (6, k)``.

    A restricted solve is one: columns are dropped before it, no angle is dropped after. Twists act about the middle of
    the source. ``robust_scale`` is that of Geman-McClure weights, in metres for ``point`` and ``plane``, in standard
    deviations for ``gicp``; infinite for plain least squares.
    ``accelerated`` extrapolates where steps shrink evenly (`_extrapolated`); ``terms`` are further costs. With
    ``normals_min`` above 0 the solve leaves out shifts along which the surfaces do not determine the pose
    (`observability.unobserved_shifts`, for ``gicp``); they are in ``unobserved`` of the result.
    A step after which the same pairs fit worse is taken back and damped (Levenberg–Marquardt). Stops when a step turns
    by less than ``rotation_epsilon_rad`` and moves the middle by less than ``translation_epsilon_m``, the criterion of
    small_gicp. Checks nothing; `register` does.
    """
    source = np.ascontiguousarray(source, dtype=np.float64)
    covariance = np.ascontiguousarray(np.zeros((0, 6)) if source_covariance is None else source_covariance)
    middle, length_m = middle_and_length(source)
    problem = _Problem(source, covariance, target, error, float(robust_scale), terms, middle)
    basis = scaled_basis(free, length_m)
    limit, least = float(max_correspondence_m), pairs_needed(error, free)
    pairs = target.pairs(source, limit)
    T = np.array(T_init, dtype=np.float64, order="C")
    best: tuple[Array, Normal, IntArray] | None = None
    reason, converged, iterations, damping = "iterations exhausted", False, 0, 0.0
    metric, before, unobserved = np.array([length_m] * 3 + [1.0] * 3), None, np.zeros((0, 3))
    while iterations < iterations_max:
        iterations += 1
        pairs.update(T)
        if iterations == 1 and normals_min > 0:
            unobserved = unobserved_shifts(target.covariance, pairs.match, normals_min)
            basis = scaled_basis(without_shifts(free, unobserved), length_m)
        here = problem.linearise(T, pairs.match, limit)
        if here.inliers < least:
            reason = "too few pairs"
            break
        if best is not None and _suspect(here, best[1]) and problem.worse(T, *best, limit):
            T, here, _ = best
            damping = max(10.0 * damping, 1e-3)
        else:
            best = T, here, pairs.match.copy()
            damping = 0.1 * damping if damping > 1e-4 else 0.0
        step = _step(here, basis, damping)
        if step is None:
            reason = "singular"
            break
        if accelerated:
            step, before = _extrapolated(step, before, metric)
        T = exp_about(here.centre, step) @ T
        if np.linalg.norm(step[:3]) < rotation_epsilon_rad and np.linalg.norm(step[3:]) < translation_epsilon_m:
            reason, converged = "converged", True
            break
    here = problem.linearise(T, pairs.match, limit)
    return RegistrationResult(T, converged, iterations, here.inliers, here.H, here.b, reason, here.centre, unobserved)


def prior_term(information: Array, T_init: Array, source: Array) -> Term:
    """½ ‖(turn from T_init, shift of the source's middle)‖² in the metric of the prior ``information (6, 6)``: pulls
    the pose to ``T_init (4, 4)`` in directions that the pairs of ``source (N, 3)`` hardly constrain."""
    middle, _ = middle_and_length(source)

    def term(T: Array, centre: Array) -> tuple[Array, Array, float]:
        turned = Rotation.from_matrix(T[:3, :3] @ T_init[:3, :3].T, assume_valid=True).as_rotvec()
        apart = np.append(turned, centre - T_init[:3, :3] @ middle - T_init[:3, 3])
        return information, information @ apart, 0.5 * float(apart @ information @ apart)

    return term


def middle_and_length(points: Array) -> tuple[Array, float]:
    """Mean ``(3,)`` of points ``(N, 3)`` and their root mean square distance to it, m; 1 where they coincide."""
    columns = [np.ascontiguousarray(column) for column in points.T]  # means of columns in rows take seven times as long
    middle = np.array([column.mean() for column in columns])
    return middle, math.sqrt(sum(column.var() for column in columns)) or 1.0


def scaled_basis(free: Array, length_m: float) -> Array:
    """Columns ``(6, k)`` that span the free directions, orthonormal where turns count ``length_m`` times."""
    scale = np.array([length_m] * 3 + [1.0] * 3)
    return np.linalg.qr(scale[:, None] * free)[0] / scale[:, None]


def pairs_needed(error: str, free: Array) -> int:
    """The fewest pairs that can determine the free directions ``(6, k)``: a plane gives one number each; a point fixes
    the position, a second one yaw, and a third one the turn about the line through both."""
    return free.shape[1] if error == "plane" else min(1 + int(np.linalg.matrix_rank(free[:3])), 3)


def exp_about(centre: Array, xi: Array) -> Array:
    """The motion ``(4, 4)`` of a twist ``(ω, v)``: turn by ω about ``centre (3,)``, then move by v."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
    motion[:3, 3] = centre - motion[:3, :3] @ centre + xi[3:]
    return motion


def _suspect(here: Normal, before: Normal) -> bool:
    """Whether a step may have made things worse: the loss of a pair has risen, or pairs were lost."""
    rose = here.loss > before.loss and here.loss * before.inliers > before.loss * here.inliers
    return rose or here.inliers < 0.9 * before.inliers


def _step(normal: Normal, basis: Array, damping: float) -> Array | None:
    """Solution ``(6,)`` of the damped normal equations in the constrained directions; None if there are none."""
    A = basis.T @ normal.H @ basis
    if not np.isfinite(A).all():
        return None
    value, vector = np.linalg.eigh(A)
    seen = value > BLIND * value[-1]
    if not value[-1] > 0:
        return None
    along = vector[:, seen].T @ (basis.T @ normal.b)
    return -basis @ (vector[:, seen] @ (along / (value[seen] + damping * value[-1])))


def _extrapolated(step: Array, before: Array | None, metric: Array) -> tuple[Array, Array | None]:
    """The step ``(6,)`` lengthened towards the limit of the iteration, and the step to compare the next one with.

    Pairs that change and robust weights make it converge linearly: each step is r times the one before, so all steps to
    come add up to 1/(1 − r) of this one. That is taken where two steps point the same way, and at most five-fold, every
    other step. After Besl and McKay, "A method for registration of 3-D shapes", PAMI 14 (1992), section IV.C; Aitken.
    """
    if before is None:
        return step, step
    now, last = metric * step, metric * before
    along = float(now @ last)
    if not along > 0.9 * np.linalg.norm(now) * np.linalg.norm(last):
        return step, step
    return step / (1.0 - min(along / float(last @ last), 0.8)), None


@dataclass(frozen=True)
class _Problem:
    """The parts of a registration that are the same at every step."""

    source: Array
    covariance: Array
    target: AnyTarget
    error: str
    robust_scale: float
    terms: Sequence[Term]
    middle: Array

    def linearise(self, T: Array, match: IntArray, limit: float, turn: Array | None = None) -> Normal:
        """Normal equations at T; ``turn`` is the rotation of the source's covariances, T's own by default."""
        H, b = np.zeros((6, 6)), np.zeros(6)
        centre = T[:3, :3] @ self.middle + T[:3, 3]
        t = self.target
        loss, inliers = kernels.linearise(
            ERRORS[self.error], self.source, self.covariance, t.point, t.normal, t.covariance, match, T,
            T[:3, :3] if turn is None else turn, centre, limit, self.robust_scale, H, b,
        )  # fmt: skip
        for term in self.terms:
            H_term, b_term, loss_term = term(T, centre)
            H += H_term
            b += b_term
            loss += loss_term
        return Normal(H, b, centre, loss, inliers)

    def worse(self, T: Array, T_best: Array, best: Normal, match: IntArray, limit: float) -> bool:
        """Whether the pairs of the best pose fit less well at T: new pairs alone may raise the loss, too."""
        paired = match.copy()
        moved = self.source @ T_best[:3, :3].T + T_best[:3, 3]
        paired[((moved - self.target.point[match]) ** 2).sum(axis=1) > limit**2] = -1
        return self.linearise(T, paired, math.inf, T_best[:3, :3]).loss > best.loss * (1 + 1e-9)
