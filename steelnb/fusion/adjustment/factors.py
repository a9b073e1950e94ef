"""Factors of an adjustment (`adjustment.problem`), as normal equations: those of the drifting prior, and of the points.

The step of a pose is that of `core.geometry`, in the world frame, with six numbers or the last four. The prior drifts
in position and yaw as a random walk. Its roll and pitch are exact by default. With a standard deviation
``tilt_sigma_rad``, their errors are a first-order Gauss-Markov process, like those of an attitude filter.

The residual of a point is its distance to the front face of its bar (`sections.shapes`). It depends on the pose of its
scan, on position, direction, rotation and flange of the bar, and on the thickness that all bars share.
"""

import math
from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import POSE_DOF, UPRIGHT_DOF, pose_step, tilt_of, yaw_of
from steelnb.core.kernels import njit
from steelnb.core.robust import weighted_geman_mcclure
from steelnb.core.types import Array, IntArray
from steelnb.fusion.adjustment.imu_factors import ChainEquations, chain_equations
from steelnb.fusion.adjustment.problem import BAR_DOF, BAR_SIGMA, Problem, pose_size
from steelnb.fusion.point_to_bar import Observations
from steelnb.fusion.sections import shapes
from steelnb.fusion.sections.shapes import THICKNESS, THICKNESS_SIGMA, THICKNESS_SPREAD
from steelnb.settings.stages import THICKNESS_MAX, THICKNESS_MIN

DRIFT_SIGMA = np.array([0.002, 0.01, 0.01, 0.01])
"""Standard deviation of the drift of yaw, x, y and z in `DRIFT_PERIOD_S`, radians and metres."""
DRIFT_PERIOD_S = 0.2
TILT_S = 10.0
"""Correlation time of the errors of the prior's roll and pitch: that of attitude filters is seconds to a minute."""
TILT_SIGMA_RAD = 0.0175
"""Default standard deviation (1°) of the prior's roll and pitch if there is an IMU."""
FIXED = 1e12
"""Information that fixes a pose."""


def drift_variance(passed_s: Array | float) -> Array:
    """Variance ``(…, 4)`` of the drift of yaw, x, y and z in the times ``passed_s (…)``, proportional to them."""
    return np.asarray(passed_s)[..., None] / DRIFT_PERIOD_S * DRIFT_SIGMA**2


def tilt_decay(passed_s: Array | float) -> Array:
    """The factor ``(…)`` by which errors of the prior's roll and pitch decay in the times ``passed_s (…)``."""
    return np.exp(-np.asarray(passed_s) / TILT_S)


def prior_equations(
    T: Array, prior: Array, stamp_s: Array, tilt_sigma_rad: float = 0.0, upright: bool = True,
    drift_ratio: Array | float = 1.0,
) -> ChainEquations:  # fmt: skip
    """Normal equations of the prior's factors on the poses ``T (K, 4, 4)`` at ``stamp_s (K,)``.

    The increments of position and yaw are those of the ``prior (K, 4, 4)``, in the frame of the earlier pose. Errors of
    roll and pitch, if free, follow their Gauss-Markov process. The first pose is fixed to the prior's. Its roll and
    pitch are fixed only if the prior is ``upright`` there; otherwise they have the sigma ``tilt_sigma_rad``.
    ``drift_ratio``, alone or ``(4,)``: the drift as a multiple of `DRIFT_SIGMA`.
    """
    size = pose_size(tilt_sigma_rad)
    tilt, yaw = slice(0, size - UPRIGHT_DOF), size - UPRIGHT_DOF
    first_error, first_weight = np.zeros((2, len(T), size))
    first_error[0], first_weight[0] = pose_step(prior[0], T[0], size), FIXED
    if not upright:
        first_weight[0, tilt] = tilt_sigma_rad**-2.0
    gap_s = np.maximum(np.diff(stamp_s), 1e-6)
    error, weight = np.zeros((2, len(gap_s), size))
    error[:, yaw:], expected = drift_steps(T, prior)
    weight[:, yaw:] = 1.0 / drift_variance(gap_s) / np.square(drift_ratio)
    after = np.tile(np.eye(size), (len(gap_s), 1, 1))
    before = -after
    before[:, yaw + 1, yaw], before[:, yaw + 2, yaw] = expected[:, 1], -expected[:, 0]
    if tilt_sigma_rad:
        off, decay = tilt_of(prior[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)), tilt_decay(gap_s)[:, None]
        error[:, tilt] = decay * off[:-1] - off[1:]
        weight[:, tilt] = tilt_sigma_rad**-2.0 / (1.0 - decay**2)
        before[:, tilt, tilt] = -decay[:, :, None] * np.eye(2)
    return chain_equations(first_error, first_weight, error, weight[:, :, None] * np.eye(size), before, after)


def drift_steps(T: Array, prior: Array) -> tuple[Array, Array]:
    """Steps ``(K − 1, 4)`` of the drift of yaw, x, y and z between the poses ``T (K, 4, 4)``, and the increments of
    position ``(K − 1, 3)`` that the ``prior (K, 4, 4)`` expects, in the frame of the earlier pose."""
    turned = T[:-1, :3, :3] @ prior[:-1, :3, :3].transpose(0, 2, 1)
    expected = (turned @ np.diff(prior[:, :3, 3], axis=0)[:, :, None])[:, :, 0]
    rotation = T[1:, :3, :3] @ (turned @ prior[1:, :3, :3]).transpose(0, 2, 1)
    return np.column_stack([yaw_of(rotation), np.diff(T[:, :3, 3], axis=0) - expected]), expected


DRIFT_WINDOW_S, DRIFT_WINDOWS_MIN = 6.0, 4
"""Time over which the drift is measured, so long that errors of the poses are small beside it; and the minimum number
of such times in a flight."""
DRIFT_RATIO_MIN, DRIFT_RATIO_MAX = 0.03, 3.0


def drift_ratio(T: Array, prior: Array, stamp_s: Array, unknowns: int = 0) -> Array:
    """The drift of yaw, x, y and z ``(4,)`` as a multiple of `DRIFT_SIGMA`, from the steps of the poses ``T (K, 4, 4)``
    of an adjustment; one common value for the position. ``unknowns``: number of those estimated from the drift."""
    ratio, windows = np.ones(4), np.ptp(stamp_s) / DRIFT_WINDOW_S
    if windows < DRIFT_WINDOWS_MIN:
        return ratio
    drift = np.cumsum(np.pad(drift_steps(T, prior)[0], ((1, 0), (0, 0))), axis=0)
    end = np.searchsorted(stamp_s, stamp_s + DRIFT_WINDOW_S)
    begin = np.flatnonzero(end < len(stamp_s))
    end = end[begin]
    square = (drift[end] - drift[begin]) ** 2 / drift_variance(stamp_s[end] - stamp_s[begin])
    share = max(1.0 - unknowns / (3.0 * windows), 0.5)
    ratio[0], ratio[1:] = np.sqrt(square[:, 0].mean()), np.sqrt(square[:, 1:].mean() / share)
    return np.clip(ratio, DRIFT_RATIO_MIN, DRIFT_RATIO_MAX)


ROBUST_SIGMAS, ROBUST_M = 2.5, 0.02
"""A residual beyond their sum is down-weighted (Geman-McClure)."""
MEDIAN_BINS, MEDIAN_MAX = 512, 8.0
FACE_DOF = BAR_DOF + 1
"""Degrees of freedom of a front face: those of its bar, and the thickness."""


class PointEquations(NamedTuple):
    """Normal equations of all points, with D = 4 or 6 degrees of freedom per pose.

    ``matrix (K, D, D)`` and ``vector (K, D)`` belong to the poses, ``block (B, 7, 7)`` and ``rhs (B, 7)`` to the bars,
    with the thickness last. For each pair of a scan ``pair_scan (P,)`` and a bar ``pair_bar (P,)``, ``cross (P, D, 7)``
    is the block between them, and ``shares (P, 7, 7)`` its contribution to the bar's block. ``residuals``: histogram of
    the residuals' magnitudes in standard deviations.
    """

    matrix: Array
    vector: Array
    cross: Array
    block: Array
    rhs: Array
    shares: Array
    pair_scan: IntArray
    pair_bar: IntArray
    residuals: Array


def linearised(problem: Problem, observations: Observations) -> PointEquations:
    """The normal equations of all points. Moving a pose has the same effect as moving its bars the opposite way, so the
    blocks of poses follow from those of bars, pair by pair. The poses are those of the sensor, with all six degrees of
    freedom if its mount is unknown."""
    T, bars, scan, bar = problem.T_world_sensor, problem.bars, observations.pair_scan, observations.pair_bar
    faces = start, direction, length, across, *_ = bars.faces()
    shares, rhs, residuals = _gathered(*observations, T, *faces, bars.flange, bars.thickness, problem.sigma_ratio)
    size = POSE_DOF if problem.mount else pose_size(problem.tilt_sigma_rad)
    sensor = T[scan, :3, 3] - start[bar]
    by_pose = _bar_motion(sensor, direction[bar], length[bar], across[bar], size)
    cross, vector = by_pose @ shares, (by_pose @ rhs[:, :, None])[:, :, 0]
    return PointEquations(
        matrix=summed(cross @ by_pose.transpose(0, 2, 1), scan, len(T)), vector=summed(vector, scan, len(T)),
        cross=cross, block=summed(shares, bar, len(bars.turn)), rhs=summed(rhs, bar, len(bars.turn)),
        shares=shares, pair_scan=scan, pair_bar=bar, residuals=residuals,
    )  # fmt: skip


def with_all_freedom(problem: Problem, equations: PointEquations) -> PointEquations:
    """The equations of an adjustment, but about all six degrees of freedom of its poses, and without their vector."""
    T, bars, scan, bar = problem.T_world_sensor, problem.bars, equations.pair_scan, equations.pair_bar
    start, direction, length, across, *_ = bars.faces()
    by_pose = _bar_motion(T[scan, :3, 3] - start[bar], direction[bar], length[bar], across[bar], POSE_DOF)
    cross = by_pose @ equations.shares
    matrix = summed(cross @ by_pose.transpose(0, 2, 1), scan, len(T))
    return equations._replace(matrix=matrix, vector=np.zeros((len(T), POSE_DOF)), cross=cross)


def _bar_motion(sensor: Array, direction: Array, length: Array, across: Array, size: int) -> Array:
    """Jacobians ``(P, size, 7)`` of the apparent motion of each pair's bar with respect to the pose that observes it.
    ``sensor (P, 3)``: vector from the start of the bar to the sensor, world frame."""
    beside = (across @ sensor[:, :, None])[:, :, 0]
    ahead = 0.5 * length - (direction * sensor).sum(axis=1)
    result = np.zeros((len(length), size, FACE_DOF))
    result[:, -3:, :2] = -across.transpose(0, 2, 1)
    for row, axis in enumerate(range(6 - size, 3)):
        up, along = across[:, :, axis], direction[:, axis]
        result[:, row, 0] = -ahead * up[:, 1] - along * beside[:, 1]
        result[:, row, 1] = ahead * up[:, 0] + along * beside[:, 0]
        result[:, row, 2], result[:, row, 3], result[:, row, 4] = -up[:, 1], up[:, 0], -along
    return result


def summed(values: Array, group: IntArray, count: int) -> Array:
    """Sums ``(count, …)`` of the values ``(P, …)`` in each ``group (P,)``."""
    result, size = np.zeros((count, *values.shape[1:])), math.prod(values.shape[1:])
    _add_rows(result.reshape(count, size), group, np.ascontiguousarray(values).reshape(len(values), size))
    return result


def noise_ratio(residuals: Array, ratio: float) -> float:
    """The range noise as a multiple of that in `points.ranges`, from the median of the histogram of residuals. These
    are in standard deviations at the previous ``ratio``, which is returned if there are none."""
    total = residuals.sum()
    if not total:
        return ratio
    median = (np.searchsorted(np.cumsum(residuals), 0.5 * total) + 0.5) * MEDIAN_MAX / MEDIAN_BINS
    return float(ratio * median / 0.6745)


def common_thickness(problem: Problem, equations: PointEquations) -> tuple[float, Array]:
    """The thickness of all angle sections, a share of their flanges: the weighted median over bars. Also returns the
    steps ``(B, 6)`` by which the bars follow it.

    The thickness of each bar is estimated together with its other unknowns, at the current poses. A bar whose section
    is fitted wrongly can have any thickness. A least-squares estimate follows such bars: it reached twice the true
    value.
    """
    own, beside = equations.block[:, :BAR_DOF, :BAR_DOF], equations.block[:, :BAR_DOF, BAR_DOF]
    rhs = np.stack([beside, equations.rhs[:, :BAR_DOF]], axis=2)
    steps = np.linalg.solve(own + np.diag(BAR_SIGMA**-2.0), rhs)
    by_own = np.einsum("bi,bik->kb", beside, steps)
    information = np.maximum(equations.block[:, BAR_DOF, BAR_DOF] - by_own[0], 1e-9)
    step = (equations.rhs[:, BAR_DOF] - by_own[1]) / information
    # The value before any estimate counts as one bar.
    thickness = np.append(problem.bars.thickness + step, THICKNESS)
    weight = np.append(1.0 / (1.0 / information + THICKNESS_SPREAD**2), THICKNESS_SIGMA**-2.0)
    median = np.quantile(thickness, 0.5, weights=weight, method="inverted_cdf")
    median = float(np.clip(median, THICKNESS_MIN, THICKNESS_MAX))
    return median, np.asarray((problem.bars.thickness - median) * steps[:, :, 0], dtype=np.float64)


@njit(cache=True, nogil=True)
def _add_rows(result, group, values):  # type: ignore[no-untyped-def]
    for p in range(len(group)):
        for i in range(values.shape[1]):
            result[group[p], i] += values[p, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _gathered(  # type: ignore[no-untyped-def]
    point, first, pair_scan, pair_bar, T, start, direction, length, across, kind, corner, flange, thickness, ratio
):  # fmt: skip
    """Normal equations of the bar of each pair, ``(P, 7, 7)`` and ``(P, 7)``, and the histogram of residuals."""
    shares, rhs = np.zeros((len(pair_bar), FACE_DOF, FACE_DOF)), np.zeros((len(pair_bar), FACE_DOF))
    residuals, total, jacobian = np.zeros(MEDIAN_BINS), np.empty((FACE_DOF, FACE_DOF + 1)), np.empty(FACE_DOF + 1)
    for pair in range(len(pair_bar)):
        b, pose = pair_bar[pair], T[pair_scan[pair]]
        if kind[b] == shapes.UNKNOWN:
            continue
        # A point s in the sensor frame is o + r s in the frame of the bar.
        x, y, z = pose[0, 3] - start[b, 0], pose[1, 3] - start[b, 1], pose[2, 3] - start[b, 2]
        ou, ov, ot = shapes.in_frame(direction[b], across[b], x, y, z)
        r00, r10, r20 = shapes.in_frame(direction[b], across[b], pose[0, 0], pose[1, 0], pose[2, 0])
        r01, r11, r21 = shapes.in_frame(direction[b], across[b], pose[0, 1], pose[1, 1], pose[2, 1])
        r02, r12, r22 = shapes.in_frame(direction[b], across[b], pose[0, 2], pose[1, 2], pose[2, 2])
        total[:] = 0.0
        for i in range(first[pair], first[pair + 1]):
            sx, sy, sz = point[i, 0], point[i, 1], point[i, 2]
            u, v, t = r00 * sx + r01 * sy + r02 * sz, r10 * sx + r11 * sy + r12 * sz, r20 * sx + r21 * sy + r22 * sz
            residual, sigma, distance, cosine, sine, beside, front, rise, edge = shapes.face_distance(
                ou + u, ov + v, ot + t, -u, -v, -t, kind[b], corner[b], length[b]
            )
            if residual != residual:
                continue
            sigma *= ratio
            residuals[min(MEDIAN_BINS - 1, int(abs(residual) / sigma * (MEDIAN_BINS / MEDIAN_MAX)))] += 1.0
            bound = (ROBUST_SIGMAS * sigma + ROBUST_M) ** 2
            weight = weighted_geman_mcclure(residual * residual, bound, 1.0)[0] / (sigma * sigma)
            # Derivatives at the face: at the measured point, its noise would enter squared and not average out.
            gu, gv, tau = cosine + rise * sine, sine - rise * cosine, ot + t + residual / distance * t - 0.5 * length[b]
            jacobian[0], jacobian[1], jacobian[2], jacobian[3] = -gu, -gv, -gu * tau, -gv * tau
            jacobian[4] = beside + rise * front
            jacobian[5] = 0.0 if kind[b] == shapes.PLATE else (beside * rise - front) / flange[b]
            growth = shapes.face_growth(kind[b], edge, flange[b], thickness)
            jacobian[BAR_DOF], jacobian[FACE_DOF] = -growth * math.sqrt(1.0 + rise * rise), -residual
            for n in range(FACE_DOF):  # bounds known at compile time: three times as fast
                weighted = weight * jacobian[n]
                for m in range(n, FACE_DOF):
                    total[n, m] += weighted * jacobian[m]
                total[n, FACE_DOF] += weighted * jacobian[FACE_DOF]
        for n in range(FACE_DOF):
            rhs[pair, n] = total[n, FACE_DOF]
            for m in range(FACE_DOF):
                shares[pair, n, m] = total[min(n, m), max(n, m)]
    return shares, rhs, residuals
