"""Translations that the visible surfaces do not determine, such as those along a wall or over flat ground.

The nearest neighbours of a scan in the map lie where the sensor sampled the surface. Even along a smooth wall the
correspondences therefore fit best at one pose: that of the earlier scan. The information of this false minimum grows
with the number of points, so no prior outweighs it. The solver therefore keeps the predicted translation in directions
in which hardly any surface has its normal. This is the solution remapping of Zhang, Kaess and Singh, "On degeneracy of
optimization-based state estimation problems" (ICRA 2016). It uses the normals instead of the Hessian, which depends on
the sampling.
"""

import numpy as np

from steelnb.core.types import Array, IntArray
from steelnb.points.covariances import normals
from steelnb.registration.target import Target

PAIRS_MAX = 500
"""Maximum number of pairs, evenly picked, from which the directions of the surfaces are estimated."""
SAMPLE = 150
"""Maximum number of points of a source whose pairs show what a finished registration leaves open."""
NORMALS_MIN = 0.05
"""Minimum strength of the normals along a direction, relative to the strongest one. It is up to 0.02 along a noisy
wall."""


def unobserved_shifts(covariance: Array, match: IntArray, normals_min: float) -> Array:
    """Unit vectors ``(u, 3)``, target frame, along which the paired surfaces have hardly any normals.

    The normal n of a pair is the smallest eigenvector of the target's ``covariance (M, 6)``, an upper triangle, at
    ``match (N,)``, −1 for no pair. The result is the eigenvectors of the mean of n nᵀ whose eigenvalue is below
    ``normals_min`` times the largest. It is empty if there are no pairs.
    """
    paired = match[match >= 0]
    if not len(paired):
        return np.zeros((0, 3))
    normal = normals(covariance[paired[:: max(1, len(paired) // PAIRS_MAX)]])
    value, vector = np.linalg.eigh((normal[:, :, None] * normal[:, None, :]).mean(axis=0))
    return np.ascontiguousarray(vector[:, value < normals_min * value[-1]].T)


def unobserved_at(T_target_source: Array, source: Array, target: Target, limit_m: float) -> Array:
    """`unobserved_shifts` of a ``source (N, 3)`` at a pose in a target, of the pairs within ``limit_m``.

    At most `SAMPLE` points of the source are used, evenly picked. Normals are those of the target. Without a pair, no
    direction is observed.
    """
    planes = target if target.filled else Target.with_planes(target.tree)
    picked = np.linspace(0, len(source) - 1, min(len(source), SAMPLE)).astype(int)
    match = planes.search(source[picked], limit_m)(T_target_source)
    return unobserved_shifts(planes.covariance, match, NORMALS_MIN) if (match >= 0).any() else np.eye(3)


def without_shifts(free: Array, unobserved: Array) -> Array:
    """Columns ``(6, j)`` that span ``free (6, k)``, rotation first, without translations along ``unobserved (u, 3)``.

    The rows of ``unobserved`` are orthonormal.
    """
    if not len(unobserved):
        return free
    remaining = free.copy()
    remaining[3:] -= unobserved.T @ (unobserved @ free[3:])
    vector, singular_value, _ = np.linalg.svd(remaining, full_matrices=False)
    return np.asarray(vector[:, singular_value > 1e-9 * singular_value[0]])
