"""Factors of an adjustment (`fusion.problem`) as normal equations: points on front faces, and what the prior says.

A point's residual is its distance to the front face of its bar (`fusion.sections`), linearised by the pose of its scan
and by place, direction, turn and flange of the bar. The drifting prior gives the increments from pose to pose.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csr_array

from steelnb.fusion import sections
from steelnb.fusion.bar_voxels import Observations
from steelnb.fusion.poses import FIXED, POSE, drift_variance, pose_size, pose_step, tilt_decay, tilt_of, yaw_of
from steelnb.fusion.problem import BAR, Bars, Problem
from steelnb.types import Array, IntArray

ROBUST_SIGMAS, ROBUST_M = 2.5, 0.02
"""A residual beyond the sum of both counts less (Geman-McClure); chosen with `fusion.proposals.TUBE_M`."""
MEDIAN_BINS, MEDIAN_MAX = 512, 8.0


class PointEquations(NamedTuple):
    """Normal equations of all points: of the poses ``matrix (K, D, D)``, ``vector (K, D)``, of the bars ``block
    (B, 6, 6)``, ``right (B, 6)``, and of each pair of a scan, ``pair_scan (P,)``, and a bar, ``pair_bar (P,)``: between
    both ``cross (P, D, 6)``, and its share of the bar's ``shares (P, 6, 6)``. ``residuals`` counts their magnitudes in
    standard deviations. D is 4, or 6 where roll and pitch are free."""

    matrix: Array
    vector: Array
    cross: Array
    block: Array
    right: Array
    shares: Array
    pair_scan: IntArray
    pair_bar: IntArray
    residuals: Array

    def between(self) -> Array:
        """The part between poses and bars ``(K, D, 6 B)``."""
        poses, size = self.vector.shape
        result = np.zeros((poses, size, len(self.block), BAR))
        result[self.pair_scan, :, self.pair_bar] = self.cross
        return result.reshape(poses, size, -1)


def linearised(problem: Problem, observations: Observations) -> PointEquations:
    """The normal equations of all points, without those of the prior."""
    bars = problem.bars
    corner = sections.outlines(bars.turn, np.where(bars.known, bars.flange, 0.05))
    return equations(
        observations, problem.T_world_sensor, bars, corner, problem.sigma_ratio, pose_size(problem.tilt_sigma_rad)
    )


def equations(
    observations: Observations,
    T_world_sensor: Array,
    bars: Bars,
    corner: Array,
    sigma_ratio: float,
    size: int = POSE,
) -> PointEquations:
    """The normal equations of all points on bars with the outlines ``corner (B, 6, 2)``, of poses with ``size`` degrees
    of freedom.

    A pose that moves is a bar that moves the other way, so those of poses follow from those of bars, pair by pair.
    """
    segments, scan, bar = bars.segments, observations.pair_scan, observations.pair_bar
    shares, rhs, residuals = gather(
        *observations, T_world_sensor, segments.start, segments.direction, segments.length, bars.across, corner,
        bars.flange, sigma_ratio,
    )  # fmt: skip
    by_pose = as_bars_move(T_world_sensor[scan, :3, 3] - segments.start[bar], bars, bar, size)
    cross, vector = by_pose @ shares, (by_pose @ rhs[:, :, None])[:, :, 0]
    poses, n = len(T_world_sensor), len(bars.turn)
    matrix = summed(cross @ by_pose.transpose(0, 2, 1), scan, poses)
    vector = summed(vector, scan, poses)
    block, right = summed(shares, bar, n), summed(rhs, bar, n)
    return PointEquations(matrix, vector, cross, block, right, shares, scan, bar, residuals)


def as_bars_move(sensor: Array, bars: Bars, bar: IntArray, size: int) -> Array:
    """How each bar seems to move as a pose does: the derivatives of a residual by the degrees of freedom of a pose are
    these ``(P, size, 6)`` times those by the bar; ``sensor (P, 3)`` from the start of the ``bar (P,)``, world frame."""
    across, direction = bars.across[bar], bars.segments.direction[bar]
    beside = (across @ sensor[:, :, None])[:, :, 0]
    ahead = 0.5 * bars.segments.length[bar] - (direction * sensor).sum(axis=1)
    result = np.zeros((len(bar), size, BAR))
    result[:, -3:, :2] = -across.transpose(0, 2, 1)
    for row, axis in enumerate(range(6 - size, 3)):
        up, along = across[:, :, axis], direction[:, axis]
        result[:, row, 0] = -ahead * up[:, 1] - along * beside[:, 1]
        result[:, row, 1] = ahead * up[:, 0] + along * beside[:, 0]
        result[:, row, 2], result[:, row, 3], result[:, row, 4] = -up[:, 1], up[:, 0], -along
    return result


def summed(values: Array, of: IntArray, count: int) -> Array:
    """Sums ``(count, …)`` of the values ``(P, …)`` of each number ``of (P,)``."""
    flat = values.reshape(len(of), math.prod(values.shape[1:]))
    which = csr_array((np.ones(len(of)), (of, np.arange(len(of)))), shape=(count, len(of)))
    return np.asarray(which @ flat).reshape(count, *values.shape[1:])


def noise_ratio(residuals: Array, before: float) -> float:
    """The range noise as a multiple of that in `points.ranges`, from the median of the residuals that `gather` took in
    standard deviations of ``before`` times that; ``before`` itself where there is none."""
    total = residuals.sum()
    if not total:
        return before
    median = (np.searchsorted(np.cumsum(residuals), 0.5 * total) + 0.5) * MEDIAN_MAX / MEDIAN_BINS
    return float(before * median / 0.6745)


class PriorErrors(NamedTuple):
    """Errors of K poses by a drifting prior: ``error (K, D)`` of the first pose and of each increment, with weights
    ``weight (K, D)``; the derivatives of an increment are one by its later pose, and ``before (K − 1, D, D)`` by its
    earlier one."""

    error: Array
    weight: Array
    before: Array


def prior_errors(
    T: Array, prior: Array, stamp_s: Array, tilt_sigma_rad: float = 0.0, upright: bool = True
) -> PriorErrors:
    """How poses ``T (K, 4, 4)`` and their increments differ from those of the ``prior (K, 4, 4)``; and roll and pitch,
    if they have a standard deviation, from a Gauss-Markov process about those of the prior. The first pose is the
    prior's. Its roll and pitch are held only if it is ``upright``; otherwise they have the standard deviation of all
    others."""
    size = pose_size(tilt_sigma_rad)
    tilt, yaw, shift = slice(0, size - POSE), size - POSE, slice(size - 3, size)
    error, weight = np.zeros((2, len(T), size))
    error[0], weight[0] = pose_step(prior[0], T[0], size), FIXED
    if not upright:
        weight[0, tilt] = tilt_sigma_rad**-2.0
    gap_s = np.maximum(np.diff(stamp_s), 1e-6)
    turned = T[:-1, :3, :3] @ prior[:-1, :3, :3].transpose(0, 2, 1)
    expected = (turned @ np.diff(prior[:, :3, 3], axis=0)[:, :, None])[:, :, 0]
    rotation = T[1:, :3, :3] @ (turned @ prior[1:, :3, :3]).transpose(0, 2, 1)
    error[1:, yaw], error[1:, shift] = yaw_of(rotation), np.diff(T[:, :3, 3], axis=0) - expected
    weight[1:, yaw:] = 1.0 / drift_variance(gap_s)
    before = np.tile(-np.eye(size), (len(gap_s), 1, 1))
    before[:, yaw + 1, yaw], before[:, yaw + 2, yaw] = expected[:, 1], -expected[:, 0]
    if tilt_sigma_rad:
        off, decay = tilt_of(prior[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)), tilt_decay(gap_s)[:, None]
        error[1:, tilt] = decay * off[:-1] - off[1:]
        weight[1:, tilt] = tilt_sigma_rad**-2.0 / (1.0 - decay**2)
        before[:, tilt, tilt] = -decay[:, :, None] * np.eye(2)
    return PriorErrors(error, weight, before)


def increments(
    T: Array, prior: Array, stamp_s: Array, tilt_sigma_rad: float = 0.0, upright: bool = True
) -> tuple[Array, Array, Array]:
    """The normal equations of the increments of the prior, of its attitude and of the first pose: ``(K, D, D)`` and
    ``(K, D)`` of the poses, and between each pose and the next ``(K − 1, D, D)``."""
    error, weight, before = prior_errors(T, prior, stamp_s, tilt_sigma_rad, upright)
    beside = before.transpose(0, 2, 1) * weight[1:, None, :]
    matrix, vector = weight[:, :, None] * np.eye(error.shape[1]), -weight * error
    matrix[:-1] += beside @ before
    vector[:-1] -= (beside @ error[1:, :, None])[:, :, 0]
    return matrix, beside, vector


@njit(cache=True, error_model="numpy", nogil=True)
def gather(  # type: ignore[no-untyped-def]
    point, first, pair_scan, pair_bar, T, start, direction, length, across, corner, flange, ratio
):  # fmt: skip
    """The normal equations of the bar of each pair, ``(P, 6, 6)`` and ``(P, 6)``, and the histogram of residuals."""
    shares, right = np.zeros((len(pair_bar), BAR, BAR)), np.zeros((len(pair_bar), BAR))
    residuals, total, place = np.zeros(MEDIAN_BINS), np.empty((BAR, BAR + 1)), np.empty(BAR + 1)
    for pair in range(len(pair_bar)):
        b, pose = pair_bar[pair], T[pair_scan[pair]]
        if flange[b] != flange[b]:
            continue
        # From the sensor's frame to that of the bar, in which the point is o + r s.
        x, y, z = pose[0, 3] - start[b, 0], pose[1, 3] - start[b, 1], pose[2, 3] - start[b, 2]
        ou, ov, ot = sections.in_frame(direction[b], across[b], x, y, z)
        r00, r10, r20 = sections.in_frame(direction[b], across[b], pose[0, 0], pose[1, 0], pose[2, 0])
        r01, r11, r21 = sections.in_frame(direction[b], across[b], pose[0, 1], pose[1, 1], pose[2, 1])
        r02, r12, r22 = sections.in_frame(direction[b], across[b], pose[0, 2], pose[1, 2], pose[2, 2])
        total[:] = 0.0
        for i in range(first[pair], first[pair + 1]):
            sx, sy, sz = point[i, 0], point[i, 1], point[i, 2]
            u, v, t = r00 * sx + r01 * sy + r02 * sz, r10 * sx + r11 * sy + r12 * sz, r20 * sx + r21 * sy + r22 * sz
            residual, sigma, distance, cosine, sine, beside, front, rise = sections.face_distance(
                ou + u, ov + v, ot + t, -u, -v, -t, corner[b], length[b]
            )
            if residual != residual:
                continue
            sigma *= ratio
            residuals[min(MEDIAN_BINS - 1, int(abs(residual) / sigma * (MEDIAN_BINS / MEDIAN_MAX)))] += 1.0
            bound = (ROBUST_SIGMAS * sigma + ROBUST_M) ** 2
            weight = (bound / (bound + residual * residual)) ** 2 / (sigma * sigma)
            # Derivatives are those at the point of the face on the same ray: at the measured point they would hold its
            # noise, and the product of noise with itself does not average out.
            gu, gv, tau = cosine + rise * sine, sine - rise * cosine, ot + t + residual / distance * t - 0.5 * length[b]
            place[0], place[1], place[2], place[3] = -gu, -gv, -gu * tau, -gv * tau
            place[4], place[5] = beside + rise * front, (beside * rise - front) / flange[b]
            place[BAR] = -residual
            for n in range(BAR):  # bounds that the compiler knows: a third of the time
                weighed = weight * place[n]
                for m in range(n, BAR):
                    total[n, m] += weighed * place[m]
                total[n, BAR] += weighed * place[BAR]
        for n in range(BAR):
            right[pair, n] = total[n, BAR]
            for m in range(BAR):
                shares[pair, n, m] = total[min(n, m), max(n, m)]
    return shares, right, residuals
