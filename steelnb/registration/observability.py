"""Shifts that the surfaces in sight do not determine: along a wall, over flat ground.

Points of a scan are paired with the nearest points of the map, and these lie as the sensor sampled the surface. So even
along a smooth wall there is a pose at which the pairs fit best: the one where the sensor was before. Its information is
proportional to the number of points, not to what they tell, and no weight of a prior outlasts it. Shifts along which
hardly any surface has its normal are therefore left out of the solve, and keep their prediction: the solution remapping
of Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems" (ICRA 2016), with the
normals in place of the Hessian, in which those samples count.
"""

import numpy as np

from steelnb.points.covariances import normals
from steelnb.types import Array, IntArray

PAIRS_MAX = 500
"""So many pairs, evenly picked, tell the directions of the surfaces."""


def unobserved_shifts(covariance: Array, match: IntArray, normals_min: float) -> Array:
    """Unit vectors ``(u, 3)``, target frame, along which the surfaces paired have hardly any normals.

    The normal of a pair is the thinnest direction of its ``covariance (M, 6)`` (upper triangle) of the target, of which
    ``match (N,)`` are positions, −1 for none. Directions are the eigenvectors of the mean of n nᵀ whose eigenvalue is
    below ``normals_min`` of the largest. None where there are no pairs.
    """
    paired = match[match >= 0]
    if not len(paired):
        return np.zeros((0, 3))
    normal = normals(covariance[paired[:: max(1, len(paired) // PAIRS_MAX)]])
    value, vector = np.linalg.eigh((normal[:, :, None] * normal[:, None, :]).mean(axis=0))
    return np.ascontiguousarray(vector[:, value < normals_min * value[-1]].T)


def without_shifts(free: Array, unobserved: Array) -> Array:
    """Columns ``(6, j)`` that span what is left of ``free (6, k)``, rotations first, without shifts along unit vectors
    ``(u, 3)`` at right angles to each other."""
    if not len(unobserved):
        return free
    left = free.copy()
    left[3:] -= unobserved.T @ (unobserved @ free[3:])
    vector, size, _ = np.linalg.svd(left, full_matrices=False)
    return np.asarray(vector[:, size > 1e-9 * size[0]])
