"""Bend of a cloud built at estimated poses, basin of convergence of a registration, and slips of an odometry."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from steelnb.core.checks import (
    check_same_stamps,
    checked_array,
    checked_integer,
    checked_points,
    checked_shape,
    checked_stamps,
)  # fmt: skip
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate
from steelnb.core.geometry import transform_points, yaw_of
from steelnb.core.types import Array, Flight
from steelnb.metrics.trajectory import pairs_in_time
from steelnb.points import preprocess_scan
from steelnb.settings import PreprocessSettings
from steelnb.simulation.truth import SLICE_M, Truth

BEND_SLICE_M, POINTS_MIN = 1.0, 200
"""Height of the slices in which a bend is measured, and minimum number of points of a slice."""


def bend(built: Array, true: Array, axis: ArrayLike = (0.0, 0.0)) -> dict[str, float]:
    """Measure how a cloud is bent: fit a rigid motion (Kabsch 1976) from the true to the built cloud in each horizontal
    slice. Both are ``(N, 3)``, metres, world frame.

    Row k of ``built`` and ``true`` is the same return at the estimated and at the true pose. Slices of `BEND_SLICE_M`
    start at true height zero. Those with fewer than `POINTS_MIN` points are dropped. Raises `InputError` if no slice
    remains, or if the shapes differ.

    Returns ``bend_deg``, the angle between the rotations of the lowest and the highest slice; the maximum over the
    slices of the tilt and the yaw, ``tilt_max_deg`` and ``yaw_max_deg``, and of the displacement of the vertical
    through ``axis (2,)``, ``offset_max_m``; and ``blur_mean_m``, the mean of the slices' root mean square residuals,
    weighted by their points. Doubled surfaces raise it.
    """
    built, true = checked_points(built, "built"), checked_points(true, "true")
    if built.shape != true.shape:
        raise InputError(f"built {built.shape} and true {true.shape}: expected pairs of points")
    axis = checked_array(axis, "axis", (2,))
    level = np.floor(true[:, 2] / BEND_SLICE_M).astype(int)
    levels, counts = np.unique(level, return_counts=True)
    levels, counts = levels[counts >= POINTS_MIN], counts[counts >= POINTS_MIN]
    if not len(levels):
        raise InputError(f"no slice of {BEND_SLICE_M} m has {POINTS_MIN} points")
    motions, blur_m = zip(*(_rigid_fit(true[level == each], built[level == each]) for each in levels), strict=True)
    T = np.array(motions)
    up = T[:, :3, 2]
    upright = np.column_stack([np.tile(axis, (len(levels), 1)), (levels + 0.5) * BEND_SLICE_M])
    offset = np.einsum("sij,sj->si", T[:, :3, :3], upright) + T[:, :3, 3] - upright
    between = Rotation.from_matrix(T[-1, :3, :3] @ T[0, :3, :3].T)
    return {
        "bend_deg": float(np.degrees(between.magnitude())),
        "tilt_max_deg": float(np.degrees(np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])).max()),
        "yaw_max_deg": float(np.abs(np.degrees(yaw_of(T[:, :3, :3]))).max()),
        "offset_max_m": float(np.linalg.norm(offset, axis=1).max()),
        "blur_mean_m": float(np.average(blur_m, weights=counts)),
    }


def _rigid_fit(source: Array, target: Array) -> tuple[Array, float]:
    """Least-squares ``T_target_source (4, 4)``, and the root mean square residual."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(target - target_mean, source - source_mean)[0].as_matrix()
    T[:3, 3] = target_mean - T[:3, :3] @ source_mean
    residual = transform_points(T, source) - target
    return T, float(np.sqrt((residual**2).sum(axis=1).mean()))


def basin_radius_m(offset_m: Array, converged: np.ndarray) -> float:
    """Radius of the basin of convergence, metres: every start within it converges to the true pose.

    ``offset_m (N, k)``: starts relative to the true position; ``converged (N,)``: whether each converged to it. The
    radius is the distance of the farthest start that is nearer than all failures, or zero.
    """
    distance = np.linalg.norm(checked_array(offset_m, "offset_m", ("N", "k")), axis=1)
    converged = checked_shape(converged, "converged", (len(distance),)).astype(bool)
    nearest_failure = distance[~converged].min(initial=np.inf)
    return float(distance[distance < nearest_failure - 1e-9].max(initial=0.0))


def largest_slip(error_m: Array, stamp_s: Array) -> tuple[int, float]:
    """Largest growth of an error ``(N,)`` within a second of its stamps ``(N,)``, by `pairs_in_time`, or over all of a
    shorter flight: (scan at its end, growth in metres).

    Raises `InputError` for fewer than two scans."""
    error_m, stamp_s = checked_array(error_m, "error_m", ("N",)), checked_stamps(stamp_s, "stamp_s")
    if len(error_m) < 2 or len(stamp_s) != len(error_m):
        raise InputError(f"error_m: {len(error_m)} scans with {len(stamp_s)} stamps; expected at least two, one each")
    first, second, scale = pairs_in_time(stamp_s)
    if not len(first):
        first, second, scale = np.array([0]), np.array([len(error_m) - 1]), np.ones(1)
    growth = scale * (error_m[second] - error_m[first])
    k = int(growth.argmax())
    return int(second[k]), float(growth[k])


def paired_clouds(
    flight: Flight, estimate: Estimate, truth: Truth, preprocess: PreprocessSettings, every: int = 4
) -> tuple[Array, Array]:
    """Points of one scan in ``every``, at the estimated and at the true poses: two clouds ``(N, 3)``, metres, world
    frame. Row k of both is the same return. Raises `InputError` if the estimate is of another flight."""
    every = checked_integer(every, "every", 1)
    check_same_stamps(estimate.corrected.stamp_s, "estimate.corrected", flight.prior.stamp_s, "the scans of the flight")
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    estimated, shown = estimate.corrected.T_world_drone, range(0, len(flight.scans), every)
    T_drone_sensor = flight.T_drone_sensor
    scans = [preprocess_scan(flight.scans[k], true[k], T_drone_sensor, preprocess) for k in shown]

    def placed(T: Array) -> Array:
        return np.concatenate([transform_points(T[k], points) for k, points in zip(shown, scans, strict=True)])

    return placed(estimated), placed(true)


STEEL_M = 0.15
"""Maximum distance of a return from the middle of the slice that it counts for."""
EVERY = 5
"""Only every fifth return is looked up."""


def sight(flight: Flight, truth: Truth, floor_m: float) -> tuple[Array, Array]:
    """Number of returns above ``floor_m`` at the true pose, and share of the steel observed so far, of each scan."""
    tree = cKDTree(slices(truth.tower.axes))
    seen, returns, shares = np.zeros(tree.n, dtype=bool), [], []
    T_world_sensor = truth.trajectory.at(flight.prior.stamp_s).T_world_drone @ flight.T_drone_sensor
    for scan, T in zip(flight.scans, T_world_sensor, strict=True):
        points = transform_points(T, scan.points.reshape(-1, 3))
        points = points[points[:, 2] > floor_m]  # a pixel without a return is NaN
        near = tree.query(points[::EVERY], distance_upper_bound=STEEL_M)[1]
        seen[near[near < tree.n]] = True
        returns.append(len(points))
        shares.append(seen.mean())
    return np.array(returns), np.array(shares)


def slices(axes: Array) -> Array:
    """Middles ``(S, 3)`` of the slices of all members ``(M, 2, 3)``."""
    middles = []
    for begin, end in axes:
        count = max(1, round(float(np.linalg.norm(end - begin)) / SLICE_M))
        middles.append(begin + (np.arange(count)[:, None] + 0.5) / count * (end - begin))
    return np.concatenate(middles)
