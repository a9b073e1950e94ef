"""The one solver loop of the ICP family: correspond, linearise, solve in the free directions, until it stands still."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array
from steelnb.errors import DegenerateCloudError, EmptyCloudError, SettingsError
from steelnb.preprocess.covariances import neighbour_covariances, normals, regularised
from steelnb.preprocess.kdtree import KdTree, build_kdtree
from steelnb.registration import kernels

ERRORS = {"point": kernels.POINT, "plane": kernels.PLANE, "gicp": kernels.GICP}
ROBUST = {
    "none": kernels.NONE, "huber": kernels.HUBER, "cauchy": kernels.CAUCHY, "geman_mcclure": kernels.GEMAN_MCCLURE
}  # fmt: skip
DOFS = ("xyz", "xyz_yaw", "se3")
METHODS = {
    "icp": ("point", "se3"), "icp-3dof": ("point", "xyz"), "icp-4dof": ("point", "xyz_yaw"), "plane": ("plane", "se3"),
    "gicp": ("gicp", "se3"), "gicp-3dof": ("gicp", "xyz"), "gicp-4dof": ("gicp", "xyz_yaw"),
}  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What a scan is registered to: a k-d tree and, in its order, normals ``(M, 3)`` and covariances ``(M, 6)``."""

    tree: KdTree
    normal: Array
    covariance: Array


@dataclass(frozen=True)
class RegistrationResult:
    """Where a registration ended, and what can be told of it.

    ``T_target_source (4, 4)``; ``converged``; ``iterations``; ``inliers``, pairs within the largest distance;
    ``rmse_m`` of their distances; ``H (6, 6)`` and ``b (6,)`` of the last normal equations (rotation first, target
    frame); ``covariance (6, 6)`` of the pose in the same order, zero in directions that were not free; ``eigenvalues
    (k,)`` of H in the free directions, ascending, and ``weak (w, 6)``, those directions that are hardly constrained;
    ``reason`` why it stopped.
    """

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int
    rmse_m: float
    H: Array
    b: Array
    covariance: Array
    eigenvalues: Array
    weak: Array
    reason: str


def free_directions(dof: str, gravity: Array | None = None) -> Array:
    """Columns ``(6, k)`` of ξ = (ω, v) that a solve may use: all, position and yaw about gravity, or position."""
    if dof not in DOFS:
        raise SettingsError(f"dof = {dof!r}: expected one of {', '.join(map(repr, DOFS))}")
    if dof == "se3":
        return np.eye(6)
    position = np.eye(6)[:, 3:]
    if dof == "xyz":
        return position
    up = np.array([0.0, 0.0, 1.0]) if gravity is None else np.asarray(gravity) / np.linalg.norm(gravity)
    return np.column_stack([np.append(up, np.zeros(3)), position])


def make_target(points: Array, error: str, neighbours: int = 20) -> Target:
    """Index a cloud ``(M, 3)`` for registration; normals and covariances only where the error needs them."""
    tree = build_kdtree(_checked(points, "target"))
    covariance = np.zeros((0, 6))
    normal = np.zeros((0, 3))
    if error != "point":
        covariance = neighbour_covariances(tree.point, neighbours, tree)
        normal = normals(covariance) if error == "plane" else normal
        covariance = regularised(covariance) if error == "gicp" else covariance
    return Target(tree, normal, covariance)


def align(
    source: Array,
    target: Target,
    error: str,
    free: Array,
    T_init: Array,
    max_correspondence_m: float,
    source_covariance: Array | None = None,
    robust: str = "none",
    robust_scale: float = 1.0,
    iterations_max: int = 50,
    rotation_epsilon_rad: float = math.radians(0.1),
    translation_epsilon_m: float = 1e-3,
    prior_information: Array | None = None,
) -> RegistrationResult:
    """Register ``source (N, 3)`` to a target from ``T_init``: Gauss–Newton in the columns of ``free (6, k)``.

    A restricted solve is one: columns are dropped before it, no angle is dropped after. ``prior_information (6, 6)``
    pulls the pose to ``T_init`` in directions that the pairs hardly constrain; its twist acts about the middle of the
    source, not about the far origin of the target frame. Stops when a step turns by less than
    ``rotation_epsilon_rad`` and moves by less than ``translation_epsilon_m``, the criterion of small_gicp.
    """
    source = np.ascontiguousarray(source, dtype=np.float64)
    n = len(source)
    match, other = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    moved_from, first, second = np.zeros((n, 3)), np.zeros(n), np.full(n, -1.0)
    covariance = np.zeros((0, 6)) if source_covariance is None else source_covariance
    H, b = np.zeros((6, 6)), np.zeros(6)
    T = np.array(T_init, dtype=np.float64)
    middle = source.mean(axis=0)
    kind, kernel = ERRORS[error], ROBUST[robust]
    reason, converged, inliers, squares, iterations = "iterations exhausted", False, 0, 0.0, 0
    while iterations < iterations_max:
        iterations += 1
        kernels.correspond(target.tree, source, T, max_correspondence_m, match, other, moved_from, first, second)
        _, inliers, squares = kernels.linearise(
            kind, source, covariance, target.tree.point, target.normal, target.covariance, match, T,
            max_correspondence_m, kernel, robust_scale, H, b,
        )  # fmt: skip
        if inliers < free.shape[1]:
            reason = "too few pairs"
            break
        centre = T[:3, :3] @ middle + T[:3, 3]
        if prior_information is not None:
            _add_prior(H, b, prior_information, T, T_init, centre)
        A = free.T @ H @ free
        try:
            step = free @ -np.linalg.solve(A + 1e-12 * np.trace(A) * np.eye(len(A)), free.T @ b)
        except np.linalg.LinAlgError:
            reason = "singular"
            break
        T = exp_se3(step) @ T
        turn, move = np.linalg.norm(step[:3]), np.linalg.norm(np.cross(step[:3], centre) + step[3:])
        # A turn about a far origin moves the scan too: what counts is how far its own middle goes.
        if turn < rotation_epsilon_rad and move < translation_epsilon_m:
            reason, converged = "converged", True
            break
    return _result(T, converged, iterations, inliers, squares, H, b, free, reason)


def _add_prior(H: Array, b: Array, information: Array, T: Array, T_init: Array, centre: Array) -> None:
    """Add ½ ‖(rotation from T_init, shift of the centre)‖² to the normal equations."""
    turn = Rotation.from_matrix(T[:3, :3] @ T_init[:3, :3].T).as_rotvec()
    shift = centre - (T_init[:3, :3] @ (T[:3, :3].T @ (centre - T[:3, 3])) + T_init[:3, 3])
    J = np.eye(6)
    J[3:, :3] = -np.array([[0, -centre[2], centre[1]], [centre[2], 0, -centre[0]], [-centre[1], centre[0], 0]])
    H += J.T @ information @ J
    b += J.T @ information @ np.append(turn, shift)


def exp_se3(xi: Array) -> Array:
    """Rigid motion ``(4, 4)`` of a twist ``(ω, v)``, first order in the coupling: rotate by ω, then move by v."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
    T[:3, 3] = xi[3:]
    return T


def _result(T, converged, iterations, inliers, squares, H, b, free, reason) -> RegistrationResult:  # type: ignore[no-untyped-def]
    A = free.T @ H @ free
    value, vector = np.linalg.eigh(A)
    dof = max(3 * inliers - free.shape[1], 1)
    variance = squares / dof
    kept = value > 1e-9 * max(value[-1], 1e-300)
    inverse = (vector[:, kept] / value[kept]) @ vector[:, kept].T if inliers else np.zeros_like(A)
    weak = (free @ vector[:, value < 1e-3 * max(value[-1], 1e-300)]).T
    rmse = math.sqrt(squares / inliers) if inliers else math.inf
    covariance = free @ (variance * inverse) @ free.T
    return RegistrationResult(
        T, converged, iterations, inliers, rmse, H.copy(), b.copy(), covariance, value, weak, reason
    )


def _checked(points: Array, name: str) -> Array:
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise EmptyCloudError(f"{name}: no finite point, expected a cloud (N, 3)")
    return np.ascontiguousarray(points)


def register(
    source: Array,
    target: Array,
    method: str = "gicp",
    dof: str | None = None,
    T_init: Array | None = None,
    max_correspondence_m: float = 1.0,
    robust: str = "none",
    robust_scale: float = 1.0,
    iterations_max: int = 50,
    neighbours: int = 20,
) -> RegistrationResult:
    """Register one cloud to another."""
    if method not in METHODS:
        raise SettingsError(f"method = {method!r}: expected one of {', '.join(map(repr, METHODS))}")
    error, default = METHODS[method]
    free = free_directions(dof or default)
    points = _checked(source, "source")
    if len(points) < 3:
        raise DegenerateCloudError(f"source: {len(points)} points, expected at least 3")
    goal = make_target(target, error, neighbours)
    covariance = regularised(neighbour_covariances(points, neighbours)) if error == "gicp" else None
    T = np.eye(4) if T_init is None else T_init
    return align(points, goal, error, free, T, max_correspondence_m, covariance, robust, robust_scale, iterations_max)
