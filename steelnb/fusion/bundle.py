"""Bundle adjustment: all poses of a flight and all its bars, sections included, as one maximum a posteriori problem.

Odometry places each scan against a map that holds the errors of the scans before it. Here poses and bars move at once
(Triggs et al., "Bundle adjustment: a modern synthesis", 1999). The factors:

- the distance of each point to the front face of its bar (`fusion.sections`) along the line of sight, with the range
  noise as its standard deviation and robust weights;
- the increments of the drifting prior from scan to scan, in the frame of the earlier pose;
- the first pose, which is the prior's: drift begins there.

Free are position and yaw of each pose, roll and pitch being the prior's; and place, direction, turn and flange of each
bar. Poses form a chain and see few bars each, so their block tridiagonal matrix is eliminated first (Schur complement).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from steelnb.fusion import sections
from steelnb.fusion.observations import Observations
from steelnb.points.ranges import SIGMA_M, SIGMA_SHARE
from steelnb.types import Array, Segments

POSE, BAR = 4, 6
"""Degrees of freedom: x, y, z, yaw; and two of place, two of direction, turn, flange."""
DRIFT_SIGMA = np.array([0.01, 0.01, 0.01, 0.002])
"""Standard deviation of an increment of the drift in `DRIFT_PERIOD_S`, metres and radians; it grows with √time."""
DRIFT_PERIOD_S = 0.2
BAR_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.003])
"""Standard deviations of a bar: of place and direction for one step, for what its points do not tell, such as the place
of a face seen from one side alone along that face; of turn and flange about those fitted to the outlines, which take no
part here. Chosen on the development seed 11."""
FIXED = 1e12
FLANGE_MIN_M, FLANGE_MAX_M = 0.01, 0.4
ROBUST_SIGMAS, ROBUST_M = 2.5, 0.02
"""A residual beyond the sum of both counts less (Geman-McClure); chosen with `fusion.scales.Scales`."""
MEDIAN_BINS, MEDIAN_MAX = 512, 8.0


class Equations(NamedTuple):
    """Normal equations of all points: of the poses ``matrix (K, 4, 4)``, ``vector (K, 4)``, of the bars ``block
    (B, 6, 6)``, ``right (B, 6)``, and of each pair of a scan and a bar: between both ``cross (P, 4, 6)``, and its share
    of the bar's ``shares (P, 6, 6)``. ``residuals`` counts their magnitudes in standard deviations."""

    matrix: Array
    vector: Array
    cross: Array
    block: Array
    right: Array
    shares: Array
    residuals: Array

    @classmethod
    def empty(cls, poses: int, bars: int, pairs: int) -> "Equations":
        """Those of no point yet, all zero."""
        of_poses, of_pairs, of_bars = (poses, POSE), (pairs, POSE, BAR), (bars, BAR)
        shapes = (*of_poses, POSE), of_poses, of_pairs, (*of_bars, BAR), of_bars, (pairs, BAR, BAR), (MEDIAN_BINS,)
        return cls(*[np.zeros(shape) for shape in shapes])


@dataclass(frozen=True)
class Bars:
    """B bars with angle sections: ``segments`` along their centroids, frames ``across (B, 2, 3)``, ``turn (B,)`` in
    radians and ``flange (B,)`` in metres as in `fusion.sections`; a bar with a flange of NaN takes no part."""

    segments: Segments
    across: Array
    turn: Array
    flange: Array

    def sectioned(self) -> "Bars":
        """Those that take part."""
        known = np.isfinite(self.flange)
        return Bars(self.segments.take(known), self.across[known], self.turn[known], self.flange[known])


@dataclass(frozen=True)
class Bundle:
    """The state of an adjustment: ``T_world_sensor (K, 4, 4)``, the bars, ``sigma_ratio``, by which the range noise of
    these scans exceeds that of `points.ranges`, the bars' ``fitted (B, 2)`` turns and flanges, and the ``step (K, 4)``
    that led here, metres and radians."""

    T_world_sensor: Array
    bars: Bars
    sigma_ratio: float
    fitted: Array
    step: Array


def start(T_world_sensor: Array, prior: Array, bars: Bars) -> Bundle:
    """The state before the first step: the poses laid on the first one of the ``prior (K, 4, 4)``, and the bars with
    them, by a turn about z and a shift."""
    between = prior[0, :3, :3] @ T_world_sensor[0, :3, :3].T
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, yaw_of(between)]).as_matrix()
    turn[:3, 3] = prior[0, :3, 3] - turn[:3, :3] @ T_world_sensor[0, :3, 3]
    segments = bars.segments.transformed(turn)
    moved = Bars(segments, bars.across @ turn[:3, :3].T, bars.turn, bars.flange)
    fitted = np.column_stack([bars.turn, bars.flange])
    return Bundle(turn @ T_world_sensor, moved, 1.0, fitted, np.zeros((len(prior), POSE)))


def improve(bundle: Bundle, seen: Observations, prior: Array, stamp_s: Array) -> Bundle:
    """One Gauss-Newton step of all poses and bars; ``prior (K, 4, 4)`` are the sensor's drifting poses at ``stamp_s``.

    The range noise is taken from the residuals before the step (their median).
    """
    T, bars = bundle.T_world_sensor, bundle.bars
    equations = linearised(bundle, seen)
    vector, right, n, known = equations.vector, equations.right, len(bars.turn), np.isfinite(bars.flange)
    right[known, 4:] -= (np.column_stack([bars.turn, bars.flange]) - bundle.fitted)[known] * BAR_SIGMA[4:] ** -2.0
    band = chain(T, prior, stamp_s, equations.matrix, vector)
    between = coupling(seen, equations.cross, n)
    solved = cho_solve_banded(
        (cholesky_banded(band), False), np.column_stack([between.toarray(), vector.ravel()]), overwrite_b=True
    )
    schur = reduced(equations.block, between, solved[:, :-1])
    moved = cho_solve(cho_factor(schur), right.ravel() - between.T @ solved[:, -1])
    step = (solved[:, -1] - solved[:, :-1] @ moved).reshape(-1, POSE)
    bars = _moved_bars(bars, moved.reshape(n, BAR))
    return Bundle(moved_poses(T, step), bars, noise_ratio(equations.residuals, bundle.sigma_ratio), bundle.fitted, step)


def linearised(bundle: Bundle, seen: Observations) -> Equations:
    """The normal equations of all points, without what is known beforehand."""
    bars, segments, known = bundle.bars, bundle.bars.segments, np.isfinite(bundle.bars.flange)
    corner = sections.outlines(bars.turn, np.where(known, bars.flange, 0.05))
    result = Equations.empty(len(bundle.T_world_sensor), len(bars.turn), len(seen.pair_bar))
    gather(
        *seen, bundle.T_world_sensor, known, segments.start, segments.direction, segments.length, bars.across, corner,
        bars.flange, bundle.sigma_ratio, *result,
    )  # fmt: skip
    return result


def coupling(seen: Observations, cross: Array, n: int) -> csr_array:
    """The part of the normal equations between poses and ``n`` bars, ``(4 K, 6 n)``, from that of each pair."""
    row = POSE * seen.pair_scan[:, None, None] + np.arange(POSE)[:, None]
    column = BAR * seen.pair_bar[:, None, None] + np.arange(BAR)
    where = (np.broadcast_to(row, cross.shape).ravel(), np.broadcast_to(column, cross.shape).ravel())
    return csr_array((cross.ravel(), where), shape=(POSE * (len(seen.first) - 1), BAR * n))


def reduced(block: Array, between: csr_array, solved: Array) -> Array:
    """The normal equations of the bars ``(6 B, 6 B)`` once the poses are eliminated (Schur complement)."""
    schur = -(between.T @ solved)
    for b in range(len(block)):
        place = slice(BAR * b, BAR * b + BAR)
        schur[place, place] += block[b] + np.diag(BAR_SIGMA**-2.0)
    return np.asarray(schur)


def chain(T: Array, prior: Array, stamp_s: Array, matrix: Array, vector: Array) -> Array:
    """Add the increments of the prior and the first pose to the normal equations of the poses, ``(K, 4, 4)`` and
    ``(K, 4)``, and give their matrix as the band ``(8, 4 K)`` that LAPACK wants."""
    time = np.maximum(np.diff(stamp_s), 1e-6) / DRIFT_PERIOD_S
    weight = DRIFT_SIGMA**-2.0 / time[:, None]
    turned = T[:-1, :3, :3] @ prior[:-1, :3, :3].transpose(0, 2, 1)
    expected = (turned @ np.diff(prior[:, :3, 3], axis=0)[:, :, None])[:, :, 0]
    apart = T[1:, :3, :3] @ (turned @ prior[1:, :3, :3]).transpose(0, 2, 1)
    error = np.empty((len(time), POSE))
    error[:, :3] = np.diff(T[:, :3, 3], axis=0) - expected
    error[:, 3] = yaw_of(apart)
    before = np.tile(-np.eye(POSE), (len(time), 1, 1))  # derivative by the earlier pose; by the later one: identity
    before[:, 0, 3], before[:, 1, 3] = expected[:, 1], -expected[:, 0]
    weighed = weight[:, :, None] * before
    matrix[:-1] += before.transpose(0, 2, 1) @ weighed
    matrix[1:] += weight[:, :, None] * np.eye(POSE)
    vector[:-1] -= (weighed.transpose(0, 2, 1) @ error[:, :, None])[:, :, 0]
    vector[1:] -= weight * error
    matrix[0] += FIXED * np.eye(POSE)
    top, band = 2 * POSE - 1, np.zeros((2 * POSE, matrix.shape[0] * POSE))
    for a in range(POSE):
        for b in range(a, POSE):
            band[top - (b - a), b::POSE] = matrix[:, a, b]
        for b in range(POSE):
            band[top - (POSE + b - a), POSE + b :: POSE] = weighed[:, b, a]
    return band


def moved_poses(T: Array, step: Array) -> Array:
    """Poses ``(K, 4, 4)`` after steps ``(K, 4)`` of x, y, z, metres, and yaw about their own places, radians."""
    result = T.copy()
    result[:, :3, 3] += step[:, :3]
    result[:, :3, :3] = Rotation.from_rotvec(step[:, 3:] * [0, 0, 1]).as_matrix() @ T[:, :3, :3]
    return result


def pose_step(T_from: Array, T_to: Array) -> Array:
    """The step ``(4,)`` of x, y, z, metres, and yaw, radians, from one pose to another; undone by `moved_poses`."""
    return np.append(T_to[:3, 3] - T_from[:3, 3], yaw_of(T_to[:3, :3] @ T_from[:3, :3].T))


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


def noise_ratio(residuals: Array, before: float) -> float:
    """The range noise as a multiple of that in `points.ranges`, from the median of the residuals that `gather` took in
    standard deviations of ``before`` times that; ``before`` itself where there is none."""
    total = residuals.sum()
    if not total:
        return before
    median = (np.searchsorted(np.cumsum(residuals), 0.5 * total) + 0.5) * MEDIAN_MAX / MEDIAN_BINS
    return float(before * median / 0.6745)


def yaw_of(rotation: Array) -> Array:
    """The angle about z, radians, that is nearest to each rotation ``(…, 3, 3)``."""
    first, second = rotation[..., 0, :], rotation[..., 1, :]
    return np.arctan2(second[..., 0] - first[..., 1], first[..., 0] + second[..., 1])


@njit(cache=True, error_model="numpy")
def gather(  # type: ignore[no-untyped-def]
    point, bar, first, pair_bar, pair_first, T, known, start, direction, length, across, corner, flange, ratio,
    matrix, vector, cross, block, right, shares, residuals,
):  # fmt: skip
    """Add all points to `Equations`."""
    pose, place, pair_of = np.empty(4), np.empty(6), np.zeros(len(length), np.int64)
    for k in range(len(T)):
        for pair in range(pair_first[k], pair_first[k + 1]):
            pair_of[pair_bar[pair]] = pair
        r00, r01, r02, r10, r11, r12 = T[k, 0, 0], T[k, 0, 1], T[k, 0, 2], T[k, 1, 0], T[k, 1, 1], T[k, 1, 2]
        r20, r21, r22 = T[k, 2, 0], T[k, 2, 1], T[k, 2, 2]
        for i in range(first[k], first[k + 1]):
            b = bar[i]
            if not known[b]:
                continue
            sx, sy, sz = point[i, 0], point[i, 1], point[i, 2]
            # c: from the point to the sensor; x: from the start of the bar to the point
            cx, cy, cz = (
                -(r00 * sx + r01 * sy + r02 * sz),
                -(r10 * sx + r11 * sy + r12 * sz),
                -(r20 * sx + r21 * sy + r22 * sz),
            )
            x, y, z = T[k, 0, 3] - cx - start[b, 0], T[k, 1, 3] - cy - start[b, 1], T[k, 2, 3] - cz - start[b, 2]
            residual, t, cosine, sine, beside, front, rise, distance, range_ = sections.face_distance(
                x, y, z, cx, cy, cz, direction[b], across[b], corner[b], length[b]
            )
            if residual != residual:
                continue
            dx, dy, dz = direction[b, 0], direction[b, 1], direction[b, 2]
            e1, e2 = across[b, 0], across[b, 1]
            sigma = ratio * max(SIGMA_M, SIGMA_SHARE * range_) * distance / range_
            residuals[min(MEDIAN_BINS - 1, int(abs(residual) / sigma * (MEDIAN_BINS / MEDIAN_MAX)))] += 1.0
            bound = (ROBUST_SIGMAS * sigma + ROBUST_M) ** 2
            weight = (bound / (bound + residual * residual)) ** 2 / (sigma * sigma)
            # Derivatives are those at the point of the face on the same ray: at the measured point they would hold its
            # noise, and the product of noise with itself does not average out.
            gu, gv = cosine + rise * sine, sine - rise * cosine
            for n in range(3):
                pose[n] = gu * e1[n] + gv * e2[n]
            share = residual / distance
            pose[3] = (1.0 + share) * (cy * pose[0] - cx * pose[1])  # z × (point − sensor), along the normal
            tau = t - share * (cx * dx + cy * dy + cz * dz) - 0.5 * length[b]
            place[0], place[1], place[2], place[3] = -gu, -gv, -gu * tau, -gv * tau
            place[4], place[5] = beside + rise * front, (beside * rise - front) / flange[b]
            pair = pair_of[b]
            for n in range(4):
                weighed = weight * pose[n]
                vector[k, n] -= weighed * residual
                for m in range(4):
                    matrix[k, n, m] += weighed * pose[m]
                for m in range(6):
                    cross[pair, n, m] += weighed * place[m]
            for n in range(6):
                weighed = weight * place[n]
                right[b, n] -= weighed * residual
                for m in range(6):
                    block[b, n, m] += weighed * place[m]
                    shares[pair, n, m] += weighed * place[m]
