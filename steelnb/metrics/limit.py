"""The Cramér–Rao bound of the poses of a flight, from true poses and true surfaces: the standard deviations that no
unbiased estimator falls below (Van Trees, "Detection, Estimation, and Modulation Theory", 1968; for range finders
Censi, "On achievable accuracy for range-finder localization", ICRA 2007).

A ray along the unit vector d meets a face with the unit normal n at the point p. A step δ of the drone at c, metres, a
turn ψ about the vertical through it, and a shift h of the face along its normal change the range by

    (h − n · δ − ψ z · ((p − c) × n)) / (n · d),

and a return with the range noise σ holds the information g gᵀ / σ² about (δ, ψ, h), g being that derivative. Taken for
granted are that each return is assigned to its face, that noise is white, and that roll and pitch are known. Where rays
begin to miss a bar, its outline, is not counted as knowledge, nor is the ground, which no odometry here uses. Lost
pixels, flying pixels and blind intervals are not modelled.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cholesky, lapack, solve_triangular

from steelnb.errors import InputError
from steelnb.fusion.poses import DRIFT_PERIOD_S, DRIFT_SIGMA
from steelnb.settings import TofSettings
from steelnb.simulation.scene import cast_bundle, make_scene, rays
from steelnb.simulation.tof import RANGE_MIN_M
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray

POSE = 4
"""Degrees of freedom: x, y, z in the world, and yaw about the vertical through the drone."""
PATCH_M = 0.1
"""Edge of the cubes that cut the faces of the tower into patches, each of which lies at a place of its own."""
INCIDENCE_MAX_RAD = np.radians(80.0)
"""Returns from faces seen at more of a slant count as none: the spot of a pixel is no point there."""
FREE_SHARE, FREE_PART = 1e-12, 1e-9
"""A direction is free whose information is less than this share of the largest; and one that has more than this part,
squared, in a free one."""


class Returns(NamedTuple):
    """Returns of one scan from a drone at ``position (3,)``, world frame: ``points (N, 3)`` on faces with unit
    ``normal (N, 3)``, met along unit vectors ``ray (N, 3)``, with range noise ``sigma_m (N,)``; ``patch (N,)`` is any
    number that names the patch of the surface."""

    position: Array
    points: Array
    normal: Array
    ray: Array
    sigma_m: Array
    patch: IntArray


@dataclass(frozen=True)
class Information:
    """Fisher information of the returns of K scans about their poses and about P patches of the surface.

    ``pose (K, 4, 4)``, per metres and radians squared. Of the pairs of a patch and a scan that sees it, those of patch
    p are ``first[p]`` to ``first[p + 1] - 1``, by scan: ``scan (N,)``; ``cross (N, 4)`` between the pose and the shift
    of the patch; ``shift (N,)`` about that shift alone.
    """

    pose: Array
    first: IntArray
    scan: IntArray
    cross: Array
    shift: Array


def see(tower: Tower, T_world_drone: Array, settings: TofSettings) -> Iterator[Returns]:
    """The returns of a tower without ground, from true poses ``(K, 4, 4)``; true ranges, and the noise of the settings.

    Raises `InputError` for a sensor without noise, whose bound is zero.
    """
    if settings.sigma_floor_m <= 0:
        raise InputError(f"tof.sigma_floor_m = {settings.sigma_floor_m}: expected noise; without it the bound is 0")
    scene, ray = make_scene(tower), rays(settings).reshape(-1, 3)
    corner = tower.vertices[tower.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    level = np.round(np.column_stack([tower.triangle_member, normal, (normal * corner[:, 0]).sum(axis=1)]), 5)
    face = np.unique(level, axis=0, return_inverse=True)[1].ravel()
    low, high = tower.vertices.min(axis=0) - PATCH_M, tower.vertices.max(axis=0)
    shape = (len(tower.triangles), *(np.ceil((high - low) / PATCH_M).astype(int) + 1))
    bundle = np.empty((len(ray), 6), dtype=np.float32)
    for T_world_drone_k in T_world_drone:
        T = T_world_drone_k @ settings.T_drone_sensor
        along = ray @ T[:3, :3].T
        bundle[:, :3], bundle[:, 3:] = T[:3, 3], along
        hit = cast_bundle(scene, bundle)
        range_m, triangle = hit.range_m.astype(np.float64), hit.triangle
        steel = triangle < len(normal)
        seen = np.flatnonzero(steel & (range_m >= RANGE_MIN_M) & (range_m <= settings.range_max_m))
        slope = np.abs((normal[triangle[seen]] * along[seen]).sum(axis=1))
        seen = seen[slope > np.cos(INCIDENCE_MAX_RAD)]
        of, distance = triangle[seen], range_m[seen]
        points = T[:3, 3] + distance[:, None] * along[seen]
        cell = ((points - low) / PATCH_M).astype(int)
        patch = np.ravel_multi_index((face[of], *cell.T), shape)
        sigma_m = np.maximum(settings.sigma_floor_m, settings.sigma_relative * distance)
        yield Returns(T_world_drone_k[:3, 3], points, normal[of], along[seen], sigma_m, patch)


def gradients(seen: Returns) -> Array:
    """Derivatives ``(N, 5)`` of the ranges by x, y, z and yaw of the drone and by the shift of the face."""
    arm, normal = seen.points - seen.position, seen.normal
    turn = arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]
    slope = (normal * seen.ray).sum(axis=1)
    return np.asarray(np.column_stack([-normal, -turn, np.ones(len(turn))]) / slope[:, None])


def gather(scans: Iterable[Returns]) -> Information:
    """The Fisher information of the returns of a flight, scan by scan."""
    poses, patches, numbers, sums = [], [], [], []
    for k, seen in enumerate(scans):
        g = gradients(seen) / seen.sigma_m[:, None]
        poses.append(g[:, :POSE].T @ g[:, :POSE])
        patch, place = np.unique(seen.patch, return_inverse=True)
        weighed = g * g[:, POSE:]
        sums.append(np.column_stack([np.bincount(place, column, len(patch)) for column in weighed.T]))
        patches.append(patch)
        numbers.append(np.full(len(patch), k))
    patch, scan, total = (np.concatenate(parts) for parts in (patches, numbers, sums))
    order = np.argsort(patch, kind="stable")
    first = np.append(0, np.cumsum(np.unique(patch, return_counts=True)[1]))
    return Information(np.array(poses), first, scan[order], total[order, :POSE].copy(), total[order, POSE].copy())


def one_scan(information: Information) -> Array:
    """Bound ``(K, 4)`` of each pose from its scan alone, laid on a known surface: standard deviations of x, y, z in
    metres and of yaw in radians, infinite along what the scan does not tell."""
    value, vector = np.linalg.eigh(information.pose)
    free = value <= FREE_SHARE * value[:, -1:]
    part = vector**2
    told = (part / np.where(free, np.inf, value)[:, None, :]).sum(axis=2)
    return np.sqrt(np.where((part * free[:, None, :]).sum(axis=2) > FREE_PART, np.inf, told))


def batch(
    information: Information, stamp_s: Array, surface_sigma_m: float = np.inf, drift: Array = DRIFT_SIGMA
) -> Array:
    """Bound ``(K, 4)`` of each pose from all scans and the prior's increments, the first pose being known.

    ``stamp_s (K,)``. ``surface_sigma_m`` is what is known of each patch beforehand: infinite for a surface that is not
    known at all, 0 for a known one. ``drift (4,)``: standard deviations of an increment of the prior in 0.2 s (metres,
    radians), which grow with √time; by default those that smoothing takes (`fusion.poses.DRIFT_SIGMA`).
    """
    poses = len(stamp_s)
    bound = np.zeros((poses, POSE))
    if poses > 1:
        inverse = lapack.dpotri(_factor(information, stamp_s, surface_sigma_m, drift), lower=1)[0]
        bound[1:] = np.sqrt(np.diag(inverse)).reshape(poses - 1, POSE)
    return bound


def causal(
    information: Information,
    stamp_s: Array,
    scans: Iterable[int],
    surface_sigma_m: float = np.inf,
    drift: Array = DRIFT_SIGMA,
) -> Array:
    """Bound ``(len(scans), 4)`` of the poses of some scans from the scans up to each, which is what an odometry has;
    all else as in `batch`."""
    bounds = []
    for k in scans:
        bound = np.zeros(POSE)
        if k > 0:  # of the last pose the information is that of the last block of the factor: it is eliminated last
            last = _factor(information, stamp_s[: k + 1], surface_sigma_m, drift)[-POSE:, -POSE:]
            bound = np.linalg.norm(solve_triangular(last, np.eye(POSE), lower=True), axis=0)
        bounds.append(bound)
    return np.array(bounds).reshape(-1, POSE)


def _factor(information: Information, stamp_s: Array, surface_sigma_m: float, drift: Array) -> Array:
    """Lower triangular Cholesky factor of the information about the poses but the first, from as many scans as there
    are stamps, with the patches eliminated (Schur complement)."""
    poses = len(stamp_s)
    matrix = np.zeros((POSE * poses, POSE * poses))
    blocks = matrix.reshape(poses, POSE, poses, POSE)
    at = np.arange(poses)
    blocks[at, :, at] = information.pose[:poses]
    step = np.eye(POSE) * (drift**-2.0 / (np.diff(stamp_s) / DRIFT_PERIOD_S)[:, None])[:, None]
    blocks[at[:-1], :, at[:-1]] += step
    blocks[at[1:], :, at[1:]] += step
    blocks[at[1:], :, at[:-1]] -= step
    if surface_sigma_m > 0:
        pairs = information.first, information.scan, information.cross, information.shift
        _eliminate(matrix, poses, surface_sigma_m**-2.0, *pairs)
    return np.asarray(cholesky(matrix[POSE:, POSE:], lower=True, overwrite_a=True, check_finite=False))


@njit(cache=True, error_model="numpy")
def _eliminate(matrix, poses, known, first, scan, cross, shift):  # type: ignore[no-untyped-def]
    """Subtract from the lower triangle of ``matrix`` what its poses know of each patch only together with its shift;
    ``known`` is the information about the shift beforehand."""
    for patch in range(len(first) - 1):
        begin, end, total = first[patch], first[patch], known
        while end < first[patch + 1] and scan[end] < poses:
            total += shift[end]
            end += 1
        for a in range(begin, end):
            row = POSE * scan[a]
            for i in range(POSE):
                weighed = cross[a, i] / total
                for b in range(begin, a + 1):
                    column = POSE * scan[b]
                    for j in range(POSE):
                        matrix[row + i, column + j] -= weighed * cross[b, j]
