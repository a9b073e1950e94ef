"""The solver of the ICP family: find correspondences, linearise, solve in the free directions, repeat.

It does not translate in directions that the visible surfaces do not determine, such as those along a wall or over flat
ground (`unobserved_shifts`). The nearest neighbours of a scan in the map lie where the sensor sampled the surface. Even
along a smooth wall the correspondences therefore fit best at one pose: that of the earlier scan. The information of
this false minimum grows with the number of points, so no prior outweighs it. The solver therefore keeps the predicted
translation in directions in which hardly any surface has its normal. This is the solution remapping of Zhang, Kaess and
Singh, "On degeneracy of optimization-based state estimation problems" (ICRA 2016). It uses the normals instead of the
Hessian, which depends on the sampling.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import exp_about, rotation_between, transform_points
from steelnb.core.types import Array, IntArray
from steelnb.points.covariances import normals
from steelnb.registration import normal_equations as kernels
from steelnb.registration.target import AnyTarget, Target


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """Pose and convergence of a registration.

    ``T_target_source (4, 4)``; ``iterations``; ``inliers``: number of pairs within the maximum correspondence distance;
    ``reason``: why the solver stopped.

    ``H (6, 6)`` is the final normal matrix of a twist ξ = (ω, v) in the axes of the target: a rotation about ``centre
    (3,)``, the mean of the transformed source, and its translation. ``unobserved (u, 3)`` are unit vectors along which
    the paired surfaces have no normals (`solver.unobserved_shifts`), so the pose along them is not reliable;
    `align` with ``normals_min`` does not translate along them. ``squared_m2``: sum of the squared distances of the
    pairs at the pose; ``points``: number of points of the source.
    """

    T_target_source: Array
    iterations: int
    inliers: int
    H: Array
    reason: str
    centre: Array
    unobserved: Array
    squared_m2: float
    points: int

    @property
    def rmse_m(self) -> float:
        """Root mean square distance of the pairs, metres, NaN without a pair: Open3D's ``inlier_rmse``."""
        return math.sqrt(self.squared_m2 / self.inliers) if self.inliers else math.nan

    @property
    def overlap(self) -> float:
        """Share of the source's points that have a pair, 0 to 1: Open3D's ``fitness``."""
        return self.inliers / max(self.points, 1)

    def __repr__(self) -> str:
        numbers = f"rmse {self.rmse_m:.4g} m, overlap {self.overlap:.2f}, {len(self.unobserved)} directions unobserved"
        return f"RegistrationResult({self.reason} after {self.iterations} iterations, {numbers})"

    @property
    def converged(self) -> bool:
        """Whether the last step was below both bounds."""
        return self.reason == "converged"


PAIRS_MAX = 500
"""Maximum number of pairs, evenly picked, from which the directions of the surfaces are estimated."""
SAMPLE = 150
"""Maximum number of points of a source whose pairs show what a finished registration leaves open."""
NORMALS_MIN = 0.05
"""Minimum strength of the normals along a direction, relative to the strongest one. It is up to 0.02 along a noisy
wall."""


def unobserved_shifts(covariance: Array, match: IntArray, normals_min: float) -> Array:
    """Unit vectors ``(u, 3)``, target frame, along which the paired surfaces have hardly any normals.

    The normal n of a pair is the smallest eigenvector of the target's ``covariance (M, 6)``, an upper triangle, at
    ``match (N,)``, −1 for no pair. The result is the eigenvectors of the mean of n nᵀ whose eigenvalue is below
    ``normals_min`` times the largest. It is empty if there are no pairs.
    """
    paired = match[match >= 0]
    if not len(paired):
        return np.zeros((0, 3))
    normal = normals(covariance[paired[:: max(1, len(paired) // PAIRS_MAX)]])
    value, vector = np.linalg.eigh((normal[:, :, None] * normal[:, None, :]).mean(axis=0))
    return np.ascontiguousarray(vector[:, value < normals_min * value[-1]].T)


def unobserved_at(T_target_source: Array, source: Array, target: Target, limit_m: float) -> Array:
    """`unobserved_shifts` of a ``source (N, 3)`` at a pose in a target, of the pairs within ``limit_m``.

    At most `SAMPLE` points of the source are used, evenly picked. Normals are those of the target. Without a pair, no
    direction is observed.
    """
    planes = target if target.filled else Target.with_planes(target.tree)
    picked = np.linspace(0, len(source) - 1, min(len(source), SAMPLE)).astype(int)
    match = planes.search(source[picked], limit_m)(T_target_source)
    return unobserved_shifts(planes.covariance, match, NORMALS_MIN) if (match >= 0).any() else np.eye(3)


def without_shifts(free: Array, unobserved: Array) -> Array:
    """Columns ``(6, j)`` that span ``free (6, k)``, rotation first, without translations along ``unobserved (u, 3)``.

    The rows of ``unobserved`` are orthonormal.
    """
    if not len(unobserved):
        return free
    remaining = free.copy()
    remaining[3:] -= unobserved.T @ (unobserved @ free[3:])
    vector, singular_value, _ = np.linalg.svd(remaining, full_matrices=False)
    return np.asarray(vector[:, singular_value > 1e-9 * singular_value[0]])


FREE = {"xyz": np.eye(6)[:, 3:], "xyz_yaw": np.eye(6)[:, 2:].copy(), "se3": np.eye(6)}
"""Degrees of freedom → columns ``(6, k)`` that span the free twists ξ = (ω, v). Yaw is about the z axis."""
EIGENVALUE_RATIO_MIN = 1e-10
"""The solver does not move along eigenvectors of H below this fraction of the largest eigenvalue."""

Term = Callable[[Array, Array], tuple[Array, Array, float]]
"""An additional cost: (pose ``(4, 4)``, centre of the twist ``(3,)``) → ``H (6, 6)``, ``b (6,)`` and loss."""


class Normal(NamedTuple):
    """Normal equations ``H (6, 6)``, ``b (6,)`` of a twist about ``centre (3,)``, with the loss, the number of pairs
    and the sum of their squared distances, m²."""

    H: Array
    b: Array
    centre: Array
    loss: float
    inliers: int
    squared_m2: float


@dataclass(frozen=True)
class AlignOptions:
    """What to minimise, along which directions, and when to stop. The values are not checked.

    Parameters
    ----------
    error: ``point``, ``plane`` or ``gicp``.
    free: columns ``(6, k)`` that span the free twists about the mean of the source, such as those of `FREE`.
    max_correspondence_m: maximum distance of a pair, metres.
    robust_scale: scale of the Geman-McClure weights, in metres, for ``gicp`` in standard deviations.
    rotation_epsilon_rad, translation_epsilon_m: a step below both ends the iteration, as in small_gicp.
    accelerated: extrapolate steps that shrink at a constant rate (`_extrapolated`).
    normals_min: if above 0, ``gicp`` leaves out translations that the surfaces do not determine
        (`solver.unobserved_shifts`).
    pairs_anew: evaluate the result with the pairs at the returned pose, not with those from before the last step.
    """

    error: str
    free: Array
    max_correspondence_m: float
    robust_scale: float = math.inf
    iterations_max: int = 50
    rotation_epsilon_rad: float = math.radians(0.1)
    translation_epsilon_m: float = 1e-3
    accelerated: bool = False
    normals_min: float = 0.0
    pairs_anew: bool = False


def align(
    source: Array,
    target: AnyTarget,
    T_init: Array,
    options: AlignOptions,
    source_covariance: Array | None = None,
    terms: Sequence[Term] = (),
) -> RegistrationResult:
    """Register ``source (N, 3)`` to a target from ``T_init`` by Gauss–Newton. Its arguments are not checked.

    ``source_covariance (N, 6)``: upper triangles in m², for the error ``gicp``; ``terms``: additional costs.

    A step that raises the loss of the same pairs is rejected, and the next one is damped (Levenberg–Marquardt).
    """
    source = np.ascontiguousarray(source, dtype=np.float64)
    covariance = np.ascontiguousarray(np.zeros((0, 6)) if source_covariance is None else source_covariance)
    mean, length_m = mean_and_length(source)
    metric = np.array([length_m] * 3 + [1.0] * 3)
    error, free, limit = options.error, options.free, float(options.max_correspondence_m)
    kind = int(kernels.PairError[error.upper()])
    search, basis, inliers_min = target.search(source, limit), scaled_basis(free, metric), pairs_needed(error, free)
    T = np.array(T_init, dtype=np.float64, order="C")
    best: tuple[Array, Normal, IntArray] | None = None
    reason, damping, previous_step, unobserved = "iterations exhausted", 0.0, None, np.zeros((0, 3))

    def linearise(T: Array, match: IntArray, R: Array, limit: float) -> Normal:
        """Normal equations at T; ``R (3, 3)`` is the rotation of the source covariances."""
        H, b, centre = np.zeros((6, 6)), np.zeros(6), T[:3, :3] @ mean + T[:3, 3]
        loss, inliers, squared_m2 = kernels.linearise(
            kind, source, covariance, target.point, target.normal, target.covariance, match, T, R, centre,
            limit, float(options.robust_scale), H, b,
        )  # fmt: skip
        for term in terms:
            H_term, b_term, loss_term = term(T, centre)
            H, b, loss = H + H_term, b + b_term, loss + loss_term
        return Normal(H, b, centre, loss, inliers, squared_m2)

    for iterations in range(1, options.iterations_max + 1):
        match = search(T)
        if iterations == 1 and options.normals_min > 0:
            unobserved = unobserved_shifts(target.covariance, match, options.normals_min)
            basis = scaled_basis(without_shifts(free, unobserved), metric)
        here = linearise(T, match, T[:3, :3], limit)
        if here.inliers < inliers_min:
            reason = "too few pairs"
            break
        if best is not None and worse(linearise, source, target, limit, T, here, *best):
            T, here, _ = best
            damping = max(10.0 * damping, 1e-3)
        else:
            best = T, here, match.copy()
            damping = 0.1 * damping if damping > 1e-4 else 0.0
        step = _step(here, basis, damping)
        if step is None:
            reason = "singular"
            break
        if options.accelerated:
            step, previous_step = _extrapolated(step, previous_step, metric)
        T = exp_about(here.centre, step) @ T
        turn_rad, move_m = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
        if turn_rad < options.rotation_epsilon_rad and move_m < options.translation_epsilon_m:
            reason = "converged"
            break
    match = search(T) if options.pairs_anew else match
    here = linearise(T, match, T[:3, :3], limit)
    return RegistrationResult(
        T, iterations, here.inliers, here.H, reason, here.centre, unobserved, here.squared_m2, len(source)
    )


def prior_term(information: Array, T_init: Array, source: Array) -> Term:
    """Prior that the pose is ``T_init (4, 4)``, with ``information (6, 6)``: ½ rᵀ information r.

    The residual r is the rotation vector from ``T_init`` and the translation of the mean of ``source (N, 3)``. The
    prior dominates in directions that the pairs hardly constrain.
    """
    mean, _ = mean_and_length(source)

    def term(T: Array, centre: Array) -> tuple[Array, Array, float]:
        rotation = rotation_between(T_init[:3, :3], T[:3, :3])
        residual = np.append(rotation, centre - T_init[:3, :3] @ mean - T_init[:3, 3])
        return information, information @ residual, 0.5 * float(residual @ information @ residual)

    return term


def mean_and_length(points: Array) -> tuple[Array, float]:
    """Mean ``(3,)`` of points ``(N, 3)`` and their root mean square distance to it, metres; 1 if all coincide."""
    columns = [np.ascontiguousarray(column) for column in points.T]  # seven times faster than strided columns
    mean = np.array([column.mean() for column in columns])
    return mean, math.sqrt(sum(column.var() for column in columns)) or 1.0


def scaled_basis(free: Array, metric: Array) -> Array:
    """Columns ``(6, k)`` that span ``free (6, k)``, orthonormal in twists weighted by ``metric (6,)``."""
    return np.linalg.qr(metric[:, None] * free)[0] / metric[:, None]


def pairs_needed(error: str, free: Array) -> int:
    """Minimum number of pairs that determine the free directions ``(6, k)``.

    A point-to-plane pair is one equation. One pair of points determines the position, a second one yaw, and a third one
    the rotation about the line through both.
    """
    return free.shape[1] if error == "plane" else min(1 + int(np.linalg.matrix_rank(free[:3])), 3)


def worse(
    linearise: Callable[..., Normal], source: Array, target: AnyTarget, limit: float, T: Array, here: Normal,
    T_best: Array, best: Normal, match: IntArray,
) -> bool:  # fmt: skip
    """Whether the pairs of the best pose have a higher loss at T. New pairs may raise the loss of a better pose, too.

    This is checked only if the total and the mean loss rose, or if more than a tenth of the pairs was lost.
    """
    rose = here.loss > best.loss and here.loss * best.inliers > best.loss * here.inliers
    if not rose and here.inliers >= 0.9 * best.inliers:
        return False
    near = ((transform_points(T_best, source) - target.point[match]) ** 2).sum(axis=1) <= limit**2
    return linearise(T, np.where(near, match, -1), T_best[:3, :3], math.inf).loss > best.loss * (1 + 1e-9)


def _step(normal: Normal, basis: Array, damping: float) -> Array | None:
    """Solution ``(6,)`` of the damped normal equations in the observed directions; None if H is zero or not finite."""
    A = basis.T @ normal.H @ basis
    if not np.isfinite(A).all():
        return None
    value, vector = np.linalg.eigh(A)
    observed = value > EIGENVALUE_RATIO_MIN * value[-1]
    if not value[-1] > 0:
        return None
    rhs = vector[:, observed].T @ (basis.T @ normal.b)
    return -basis @ (vector[:, observed] @ (rhs / (value[observed] + damping * value[-1])))


def _extrapolated(step: Array, before: Array | None, metric: Array) -> tuple[Array, Array | None]:
    """The step ``(6,)`` extrapolated to the limit of the iteration, and the step to compare the next one with.

    New pairs and robust weights make the iteration converge linearly: each step is r times the one before, so this step
    and all later ones add up to 1/(1 − r) of it. If two steps have similar directions, the second is scaled by this
    factor, at most by five. After Besl and McKay, "A method for registration of 3-D shapes", PAMI 14 (1992), section
    IV.C, and Aitken.
    """
    if before is None:
        return step, step
    scaled, previous = metric * step, metric * before
    product = float(scaled @ previous)
    if not product > 0.9 * np.linalg.norm(scaled) * np.linalg.norm(previous):
        return step, step
    return step / (1.0 - min(product / float(previous @ previous), 0.8)), None
