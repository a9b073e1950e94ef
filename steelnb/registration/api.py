"""Registration of two clouds, or of a cloud to a voxel map, by any member of the ICP family."""

import math

import numpy as np

from steelnb.errors import InputError
from steelnb.points import VoxelMap
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.inputs import checked_pose
from steelnb.registration.solve import RegistrationResult, align, free_directions, pairs_needed
from steelnb.registration.target import Target, finite, make_target
from steelnb.types import Array

METHODS = {
    "icp": ("point", "se3"), "icp-3dof": ("point", "xyz"), "icp-4dof": ("point", "xyz_yaw"), "plane": ("plane", "se3"),
    "gicp": ("gicp", "se3"), "gicp-3dof": ("gicp", "xyz"), "gicp-4dof": ("gicp", "xyz_yaw"),
}  # fmt: skip
"""Error and default degrees of freedom of each method."""
NEIGHBOURS_MIN = 4


def register(
    source: Array,
    target: Array | Target | VoxelMap,
    method: str = "gicp",
    dof: str | None = None,
    T_init: Array | None = None,
    max_correspondence_m: float = 1.0,
    robust_scale: float = math.inf,
    iterations_max: int = 50,
    neighbours: int = 20,
    gravity: Array | None = None,
    rotation_epsilon_rad: float = math.radians(0.1),
    translation_epsilon_m: float = 1e-3,
) -> RegistrationResult:
    """Estimate ``T_target_source (4, 4)``, from an initial guess ``T_init (4, 4)`` (default identity).

    ``source`` and ``target`` are clouds ``(N, 3)`` or images ``(H, W, 3)`` in metres; points that are not finite are
    left out. The target may also be one that `make_target` has prepared for the same error, or a `VoxelMap`, whose
    voxel means are then the cloud.

    ``method`` is one of ``icp`` (point to point), ``plane`` (point to plane) and ``gicp`` (distribution to
    distribution; Segal et al., RSS 2009), or one with its degrees of freedom: ``icp-3dof``, ``icp-4dof``,
    ``gicp-3dof``, ``gicp-4dof``. ``dof`` overrides them: ``xyz``, ``xyz_yaw`` (yaw about ``gravity (3,)``, by default
    the target's z axis) or ``se3``; the rest of ``T_init`` is kept. Pairs farther apart than ``max_correspondence_m``
    do not count.
    ``robust_scale`` is that of Geman-McClure weights, in metres, for gicp in standard deviations; by default all pairs
    weigh the same. ``neighbours`` points around each give its normal or covariance.
    A step below ``rotation_epsilon_rad`` and ``translation_epsilon_m`` ends the iteration.

    Raises `InputError`. A registration that does not converge does not
    raise: see ``converged`` and ``reason`` of the result.

    >>> import numpy as np
    >>> target = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    >>> found = register(target - [0.02, 0.01, 0.03], target, "icp-3dof", max_correspondence_m=0.2)
    >>> found.converged, found.T_target_source[:3, 3].round(4).tolist()
    (True, [0.02, 0.01, 0.03])
    """
    if method not in METHODS:
        raise InputError(f"method = {method!r}: expected one of {', '.join(map(repr, METHODS))}")
    error, default = METHODS[method]
    free = free_directions(default if dof is None else dof, gravity)
    limit = _positive("max_correspondence_m", max_correspondence_m)
    scale = robust_scale if robust_scale == math.inf else _positive("robust_scale", robust_scale)
    if iterations_max < 1:
        raise InputError(f"iterations_max = {iterations_max}: expected at least 1")
    if neighbours < NEIGHBOURS_MIN:
        raise InputError(f"neighbours = {neighbours}: expected at least {NEIGHBOURS_MIN}")
    T = np.eye(4) if T_init is None else checked_pose(T_init, "T_init")
    least = max(pairs_needed(error, free), 1 if error == "point" else NEIGHBOURS_MIN)
    points = _enough(finite(source, "source"), least, "source")
    goal = _cloud(target, error, neighbours, least)
    covariance = regularised(neighbour_covariances(points, neighbours)) if error == "gicp" else None
    return align(
        points, goal, error, free, T, limit, covariance, scale, iterations_max,
        _positive("rotation_epsilon_rad", rotation_epsilon_rad),
        _positive("translation_epsilon_m", translation_epsilon_m),
    )  # fmt: skip


def _cloud(target: Array | Target | VoxelMap, error: str, neighbours: int, least: int) -> Target:
    if isinstance(target, Target):
        missing = {"point": False, "plane": not len(target.normal), "gicp": not len(target.covariance)}
        if missing[error]:
            raise InputError(f"target: prepared for another error, expected make_target(points, {error!r})")
        return target
    points = target.means() if isinstance(target, VoxelMap) else target
    return make_target(_enough(finite(points, "target"), least, "target"), error, neighbours)


def _positive(name: str, value: float) -> float:
    if not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
        raise InputError(f"{name} = {value!r}: expected a positive finite number")
    return float(value)


def _enough(points: Array, least: int, name: str) -> Array:
    if len(points) < least:
        raise InputError(f"{name}: {len(points)} finite points, expected at least {least}")
    return points
