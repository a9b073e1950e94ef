"""Registration of two clouds, or of a cloud to a voxel map, by ICP, point-to-plane ICP or GICP."""

import math

import numpy as np

from steelnb.errors import InputError
from steelnb.points import VoxelMap
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.inputs import checked_pose
from steelnb.registration.solve import FREE, RegistrationResult, align, pairs_needed
from steelnb.registration.target import Target, finite, make_target
from steelnb.types import Array

METHODS = {"icp": "point", "plane": "plane", "gicp": "gicp"}
"""Method → error."""
NEIGHBOURS_MIN = 4
"""Minimum number of points of a covariance."""


def register(
    source: Array,
    target: Array | Target | VoxelMap,
    method: str = "gicp",
    dof: str = "se3",
    T_init: Array | None = None,
    max_correspondence_m: float = 1.0,
    robust_scale: float = math.inf,
    iterations_max: int = 50,
    rotation_epsilon_rad: float = math.radians(0.1),
    translation_epsilon_m: float = 1e-3,
) -> RegistrationResult:
    """Estimate ``T_target_source (4, 4)`` from the initial guess ``T_init (4, 4)``, by default the identity.

    Parameters
    ----------
    source, target: clouds ``(N, 3)`` or images ``(H, W, 3)`` in metres. Points that are not finite are dropped. The
        target may also be the result of `make_target` for the same error, or a `VoxelMap`, of which the means are used.
    method: ``icp`` (point to point), ``plane`` (point to plane) or ``gicp`` (distribution to distribution; Segal et
        al., RSS 2009).
    dof: degrees of freedom: ``xyz``, ``xyz_yaw`` or ``se3``, with the yaw about the z axis. The others keep the values
        of ``T_init``.
    max_correspondence_m: maximum distance of a pair, metres.
    robust_scale: scale of the Geman-McClure weights, in metres, for gicp in standard deviations; default no weights.
    iterations_max: maximum number of iterations.
    rotation_epsilon_rad, translation_epsilon_m: a step below both ends the iteration.

    Raises `InputError`. A registration that does not converge does not raise: see ``converged`` and ``reason`` of the
    result.

    >>> import numpy as np
    >>> target = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    >>> found = register(target - [0.02, 0.01, 0.03], target, "icp", "xyz", max_correspondence_m=0.2)
    >>> found.converged, found.T_target_source[:3, 3].round(4).tolist()
    (True, [0.02, 0.01, 0.03])
    """
    for name, value, known in (("method", method, METHODS), ("dof", dof, FREE)):
        if value not in known:
            raise InputError(f"{name} = {value!r}: expected one of {', '.join(map(repr, known))}")
    error, free = METHODS[method], FREE[dof]
    limit = _positive("max_correspondence_m", max_correspondence_m)
    scale = robust_scale if robust_scale == math.inf else _positive("robust_scale", robust_scale)
    if iterations_max < 1:
        raise InputError(f"iterations_max = {iterations_max}: expected at least 1")
    T = np.eye(4) if T_init is None else checked_pose(T_init, "T_init")
    points_min = max(pairs_needed(error, free), 1 if error == "point" else NEIGHBOURS_MIN)
    points = _enough(finite(source, "source"), points_min, "source")
    prepared = _prepared(target, error, points_min)
    covariance = regularised(neighbour_covariances(points)) if error == "gicp" else None
    return align(
        points, prepared, error, free, T, limit, covariance, scale, iterations_max,
        _positive("rotation_epsilon_rad", rotation_epsilon_rad),
        _positive("translation_epsilon_m", translation_epsilon_m),
    )  # fmt: skip


def _prepared(target: Array | Target | VoxelMap, error: str, points_min: int) -> Target:
    if isinstance(target, Target):
        if (error == "plane" and not len(target.normal)) or (error == "gicp" and not len(target.covariance)):
            raise InputError(f"target: prepared for another error, expected make_target(points, {error!r})")
        return target
    points = target.means() if isinstance(target, VoxelMap) else target
    return make_target(_enough(finite(points, "target"), points_min, "target"), error)


def _positive(name: str, value: float) -> float:
    if not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
        raise InputError(f"{name} = {value!r}: expected a positive finite number")
    return float(value)


def _enough(points: Array, points_min: int, name: str) -> Array:
    if len(points) < points_min:
        raise InputError(f"{name}: {len(points)} finite points, expected at least {points_min}")
    return points
