"""ICP and GICP with the solver and stopping rules of PCL, which the programs of the report called.

Source: PCL 1.13 (`icp.hpp`, `gicp.hpp`, `default_convergence_criteria.hpp`). The report ran 1.10. At that time,
GICP compared the norm of the whole gradient with the bound; 1.13 compares translation and angles separately. Source
and target are in the world frame, and every step is a motion about its origin. So the bounds on the translation of a
step are stricter far from the origin. ``setRANSACOutlierRejectionThreshold`` has no effect: neither class reads it.

GICP's minimiser is BFGS with Fletcher's line search and PCL's tolerances: Fletcher, "Practical Methods of
Optimization" (2nd edition, 1987), sections 2.6 and 3.2. PCL stores only the last step and gradient, not a matrix, and
interpolates by parabolas only. A pose is ``x (6,)``: translation, then roll, pitch and yaw about the axes of the world,
applied in this order.
"""

import math
from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import transform_points
from steelnb.core.kernels import njit
from steelnb.core.types import Array
from steelnb.points.covariances import FULL
from steelnb.registration.target import AnyTarget

STEPS_MAX = 20
GRADIENT_MAX = 1e-2
"""Stop when the gradients with respect to translation (m) and angles (m²/rad) are both shorter than this."""
DESCENT, CURVATURE = 0.01, 0.01
"""Fletcher's ρ and σ: minimum descent of a step and maximum slope after it, as fractions of the initial slope."""
EXTRAPOLATED_MAX, FROM_LOW, FROM_HIGH = 9.0, 0.05, 0.5
"""Fletcher's τ₁, τ₂, τ₃: maximum growth of a bracket, and the margins at its two ends."""
TRIALS_MAX = 100
EPSILON = float(np.finfo(np.float64).eps)


@njit(cache=True, error_model="numpy")
def euler_pose(x):
    """The pose ``(4, 4)`` of ``x (6,)``."""
    cr, sr, cp, sp, cy, sy = (
        math.cos(x[3]), math.sin(x[3]), math.cos(x[4]), math.sin(x[4]), math.cos(x[5]), math.sin(x[5])
    )  # fmt: skip
    T = np.eye(4)
    T[0, 0], T[0, 1], T[0, 2], T[0, 3] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x[0]
    T[1, 0], T[1, 1], T[1, 2], T[1, 3] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, x[1]
    T[2, 0], T[2, 1], T[2, 2], T[2, 3] = -sp, cp * sr, cp * cr, x[2]
    return T


def pair_metrics(source_covariance, target_covariance, R):
    """Metric (C_target + R C_source Rᵀ)⁻¹ of each pair: ``(P, 6)``, upper triangles xx xy xz yy yz zz."""
    inverse = np.linalg.inv(target_covariance[:, FULL] + R @ source_covariance[:, FULL] @ R.T)
    return np.ascontiguousarray(inverse[:, *np.triu_indices(3)])


@njit(cache=True, error_model="numpy")
def mean_cost(x, source, target, metric, gradient):
    """Mean of eᵀ M e over pairs of points ``(P, 3)``, e = R p + t − q; writes its ``gradient (6,)``.

    Points and R p + t are in single precision, as in PCL: close to the minimum, rounding hides the slope and the search
    ends.

    The derivative with respect to an angle is the moment of the forces M e about its axis: x rotated by pitch and yaw,
    y rotated by yaw, and z.
    """
    T = euler_pose(x)
    S = T.astype(np.float32)
    cost = fx = fy = fz = mx = my = mz = 0.0
    for i in range(len(source)):
        a, b, c = source[i, 0], source[i, 1], source[i, 2]
        rx = S[0, 0] * a + S[0, 1] * b + S[0, 2] * c
        ry = S[1, 0] * a + S[1, 1] * b + S[1, 2] * c
        rz = S[2, 0] * a + S[2, 1] * b + S[2, 2] * c
        ex = np.float64(rx + S[0, 3] - target[i, 0])
        ey = np.float64(ry + S[1, 3] - target[i, 1])
        ez = np.float64(rz + S[2, 3] - target[i, 2])
        gx = metric[i, 0] * ex + metric[i, 1] * ey + metric[i, 2] * ez
        gy = metric[i, 1] * ex + metric[i, 3] * ey + metric[i, 4] * ez
        gz = metric[i, 2] * ex + metric[i, 4] * ey + metric[i, 5] * ez
        cost += ex * gx + ey * gy + ez * gz
        fx, fy, fz = fx + gx, fy + gy, fz + gz
        mx, my, mz = mx + ry * gz - rz * gy, my + rz * gx - rx * gz, mz + rx * gy - ry * gx
    scale = 2.0 / len(source)
    gradient[0], gradient[1], gradient[2] = scale * fx, scale * fy, scale * fz
    gradient[3] = scale * (T[0, 0] * mx + T[1, 0] * my + T[2, 0] * mz)
    gradient[4] = scale * (-math.sin(x[5]) * mx + math.cos(x[5]) * my)
    gradient[5] = scale * mz
    return cost / len(source)


@njit(cache=True, error_model="numpy")
def minimise(x, source, target, metric):
    """Minimise `mean_cost` from ``x (6,)``, in place, in at most `STEPS_MAX` steps."""
    g, g_new = np.empty(6), np.empty(6)
    cost = mean_cost(x, source, target, metric, g)
    length = math.sqrt((g * g).sum())
    if length == 0.0:
        return
    direction, first = -g / length, 1.0
    for _ in range(STEPS_MAX):
        slope = (direction * g).sum()
        if not slope < 0.0:
            return
        step = _line_search(x, direction, cost, slope, first, source, target, metric, g_new)
        if step == 0.0:
            return
        last_step = step * direction
        x += last_step
        cost_new = mean_cost(x, source, target, metric, g_new)
        change, cost = cost_new - cost, cost_new
        gradient_change = g_new - g
        g[:] = g_new
        if max((g[:3] ** 2).sum(), (g[3:] ** 2).sum()) < GRADIENT_MAX**2:
            return
        # BFGS direction from the last step only.
        curvature = (last_step * gradient_change).sum()
        along_step = along_change = 0.0
        if curvature != 0.0:
            along_change = (last_step * g).sum() / curvature
            along_step = (gradient_change * g).sum() / curvature - (
                1.0 + (gradient_change * gradient_change).sum() / curvature
            ) * along_change
        p = g - along_step * last_step - along_change * gradient_change
        length = math.sqrt((p * p).sum())
        if not length > 0.0:
            return
        direction = p / (-length if (p * g).sum() > 0.0 else length)
        slope = (direction * g).sum()
        first = min(1.0, 2.0 * max(-change, 10.0 * EPSILON * abs(cost)) / -slope) if change < 0.0 else 1.0


@njit(cache=True, error_model="numpy")
def _line_search(x, direction, cost, slope, first, source, target, metric, g):
    """Step length that satisfies Fletcher's conditions; 0 if rounding hides any progress.

    Fletcher, algorithms 2.6.2 (bracketing) and 2.6.4 (sectioning). ``g (6,)`` is a buffer.
    """
    last, cost_last, slope_last, step = 0.0, cost, slope, first
    a, cost_a, slope_a, b, cost_b = 0.0, cost, slope, first, 0.0
    trial = 0
    while trial < TRIALS_MAX:
        trial += 1
        cost_step = mean_cost(x + step * direction, source, target, metric, g)
        slope_step = (g * direction).sum()
        if cost_step > cost + DESCENT * step * slope or cost_step >= cost_last:
            a, cost_a, slope_a, b, cost_b = last, cost_last, slope_last, step, cost_step
            break
        if abs(slope_step) <= -CURVATURE * slope:
            return step
        if slope_step >= 0.0:
            a, cost_a, slope_a, b, cost_b = step, cost_step, slope_step, last, cost_last
            break
        low, high = 2.0 * step - last, step + EXTRAPOLATED_MAX * (step - last)
        further = _parabola(last, cost_last, slope_last, step, cost_step, low, high)
        last, cost_last, slope_last, step = step, cost_step, slope_step, further
    while trial < TRIALS_MAX:
        trial += 1
        step = _parabola(a, cost_a, slope_a, b, cost_b, a + FROM_LOW * (b - a), b - FROM_HIGH * (b - a))
        cost_step = mean_cost(x + step * direction, source, target, metric, g)
        if (a - step) * slope_a <= EPSILON:
            return 0.0
        if cost_step > cost + DESCENT * step * slope or cost_step >= cost_a:
            b, cost_b = step, cost_step
            continue
        slope_step = (g * direction).sum()
        if abs(slope_step) <= -CURVATURE * slope:
            return step
        if (b - a) * slope_step >= 0.0:
            b, cost_b = a, cost_a
        a, cost_a, slope_a = step, cost_step, slope_step
    return step


@njit(cache=True, error_model="numpy")
def _parabola(a, cost_a, slope_a, b, cost_b, low, high):
    """Minimiser in [low, high] of the parabola with the cost and slope at a and the cost at b."""
    width = b - a
    fall = slope_a * width
    bend = cost_b - cost_a - fall
    z_low, z_high = (low - a) / width, (high - a) / width
    if z_low > z_high:
        z_low, z_high = z_high, z_low
    best, least = z_low, cost_a + z_low * (fall + z_low * bend)
    value = cost_a + z_high * (fall + z_high * bend)
    if value < least:
        best, least = z_high, value
    if 2.0 * bend > a:  # as in PCL; Fletcher compares with 0
        z = -fall / (2.0 * bend)
        if z_low < z < z_high and cost_a + z * (fall + z * bend) < least:
            best = z
    return a + best * width


PAIRS_MIN = {"point": 3, "gicp": 4}
"""With fewer pairs a registration fails."""
MSE_CHANGE_MIN_M2 = 1e-12
"""ICP also stops when the mean squared error of the correspondences changes by less than this."""
ROTATION_EPSILON = 2e-3
"""GICP stops when every entry of the rotation matrix changes by less than this, and every entry of the translation by
less than ``epsilon``."""


class Aligned(NamedTuple):
    """``T_target_source (4, 4)``, ``converged`` in the sense of PCL, and the inliers of the last iteration."""

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int


def icp_as_pcl(
    source: Array,
    target: AnyTarget,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
    mse_change_min: float = 0.0,
) -> Aligned:
    """Point-to-point ICP of ``source (N, 3)`` from the identity. Each step is the least-squares motion of the pairs.

    It stops after a step with ‖translation‖² ≤ ``epsilon`` and cos(angle) ≥ 1 − ``epsilon``; for 1e-3 that is a step
    below 3.2 cm and 2.6°. It also stops when the mean squared error of the pairs changes by less than the fraction
    ``mse_change_min``. Reaching ``iterations_max`` counts as converged.
    """
    T, previous_mse_m2 = np.eye(4), 0.0
    search = target.search(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        match = search(T)
        paired = match >= 0
        inliers = int(np.count_nonzero(paired))
        if inliers < PAIRS_MIN["point"]:
            return Aligned(T, False, iteration - 1, inliers)
        source_points, target_points = transform_points(T, source[paired]), target.point[match[paired]]
        step = least_squares_motion(source_points, target_points)
        T = step @ T
        mse_m2 = float(((source_points - target_points) ** 2).sum() / inliers)
        is_small_step = step[:3, 3] @ step[:3, 3] <= epsilon and 0.5 * (np.trace(step[:3, :3]) - 1) >= 1 - epsilon
        change_min_m2 = max(MSE_CHANGE_MIN_M2, mse_change_min * previous_mse_m2)
        if is_small_step or (iteration > 1 and abs(mse_m2 - previous_mse_m2) < change_min_m2):
            break
        previous_mse_m2 = mse_m2
    return Aligned(T, True, iteration, inliers)


def gicp_as_pcl(
    source: Array,
    covariance: Array,
    target: AnyTarget,
    max_correspondence_m: float,
    iterations_max: int,
    epsilon: float,
) -> Aligned:
    """Generalized ICP of ``source (N, 3)`` with ``covariance (N, 6)`` from the identity.

    Each step finds correspondences, fixes their metrics and calls `minimise`, which stops at a gradient of 1e-2. This
    leaves an error of up to a centimetre in the plane of a surface. The pose is therefore biased towards its
    start in directions with few normals. `minimise` also stops when single precision hides the slope (`mean_cost`).
    Reaching ``iterations_max`` counts as converged.
    """
    T, x = np.eye(4), np.zeros(6)
    search = target.search(source, max_correspondence_m)
    for iteration in range(1, iterations_max + 1):
        match = search(T)
        chosen = np.flatnonzero(match >= 0)
        if len(chosen) < PAIRS_MIN["gicp"]:
            return Aligned(T, False, iteration - 1, len(chosen))
        match = match[chosen]
        metric = pair_metrics(covariance[chosen], target.covariance[match], T[:3, :3])
        minimise(x, source[chosen].astype(np.float32), target.point[match].astype(np.float32), metric)
        T_previous, T = T, euler_pose(x)
        change = np.abs(T - T_previous)
        if change[:3, :3].max() < ROTATION_EPSILON and change[:3, 3].max() < epsilon:
            break
    return Aligned(T, True, iteration, len(chosen))


def least_squares_motion(source_points: Array, target_points: Array) -> Array:
    """Rigid motion ``(4, 4)`` that aligns source points ``(N, 3)`` with target points ``(N, 3)`` by least squares.

    Source: Umeyama, PAMI 13 (1991), without scale.
    """
    source_mean, target_mean = source_points.mean(axis=0), target_points.mean(axis=0)
    U, _, Vt = np.linalg.svd((target_points - target_mean).T @ (source_points - source_mean))
    U[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    motion = np.eye(4)
    motion[:3, :3] = U @ Vt
    motion[:3, 3] = target_mean - motion[:3, :3] @ source_mean
    return motion
