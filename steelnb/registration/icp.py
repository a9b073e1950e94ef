"""Registration of two clouds, or of a cloud to a voxel map, by ICP, point-to-plane ICP or GICP."""

import math
from dataclasses import replace

import numpy as np

from steelnb.core.checks import checked_choice, checked_integer, checked_number, checked_pose
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.points import VoxelMap
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.registration.solver import FREE, AlignOptions, RegistrationResult, align, pairs_needed, unobserved_at
from steelnb.registration.target import finite, make_target

ERROR_OF = {"icp": "point", "plane": "plane", "gicp": "gicp"}
"""Method → error."""
NEIGHBOURS_MIN = 4
"""Minimum number of points to estimate covariances from."""


def register(
    source: Array,
    target: Array | VoxelMap,
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
        target may also be a `VoxelMap`, whose means are used.
    method: ``icp`` (point to point), ``plane`` (point to plane) or ``gicp`` (distribution to distribution; Segal et
        al., RSS 2009).
    dof: degrees of freedom: ``xyz``, ``xyz_yaw`` or ``se3``, with the yaw about the z axis. The others keep their
        values in ``T_init``.
    max_correspondence_m: maximum distance of a pair, metres.
    robust_scale: scale of the Geman-McClure weights, in metres, for gicp in standard deviations; default no weights.
    iterations_max: maximum number of iterations.
    rotation_epsilon_rad, translation_epsilon_m: a step below both ends the iteration.

    Raises `InputError`. A registration that does not converge does not raise: see ``converged`` and ``reason`` of the
    result. Its ``rmse_m``, ``overlap`` and ``unobserved`` say how far to trust it; they are those of the pairs at the
    returned pose.

    >>> import numpy as np
    >>> target = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    >>> found = register(target - [0.02, 0.01, 0.03], target, "icp", "xyz", max_correspondence_m=0.2)
    >>> found.converged, found.T_target_source[:3, 3].round(4).tolist()
    (True, [0.02, 0.01, 0.03])
    """
    checked_choice(method, "method", ERROR_OF)
    checked_choice(dof, "dof", FREE)
    max_correspondence_m = checked_number(max_correspondence_m, "max_correspondence_m", above=0)
    robust_scale = checked_number(robust_scale, "robust_scale", above=0, infinite=True)
    iterations_max = checked_integer(iterations_max, "iterations_max", 1)
    rotation_epsilon_rad = checked_number(rotation_epsilon_rad, "rotation_epsilon_rad", above=0)
    translation_epsilon_m = checked_number(translation_epsilon_m, "translation_epsilon_m", above=0)
    error, free = ERROR_OF[method], FREE[dof]
    T = np.eye(4) if T_init is None else checked_pose(T_init, "T_init")
    points = finite(source, "source")
    there = finite(target.means() if isinstance(target, VoxelMap) else target, "target")
    points_min = max(pairs_needed(error, free), 1 if error == "point" else NEIGHBOURS_MIN)
    for name, cloud in (("source", points), ("target", there)):
        if len(cloud) < points_min:
            raise InputError(f"{name}: {len(cloud)} finite points, expected at least {points_min}")
    covariance = regularised(neighbour_covariances(points)) if error == "gicp" else None
    options = AlignOptions(
        error, free, max_correspondence_m, robust_scale, iterations_max, rotation_epsilon_rad, translation_epsilon_m,
        pairs_anew=True,
    )  # fmt: skip
    aim = make_target(there, error)
    result = align(points, aim, T, options, covariance)
    return replace(result, unobserved=unobserved_at(result.T_target_source, points, aim, max_correspondence_m))
