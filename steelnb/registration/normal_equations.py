"""Compiled normal equations of the ICP errors, with robust weights.

A step is a twist ``ξ = (ω, v)`` in the axes of the target about a centre c, the mean of the source: a transformed point
q moves by ``ω × (q − c) + v``. The normal equations ``H ξ = −b`` (6×6 and 6, rotation first) are therefore well
conditioned at any distance from the origin, and v is the translation of the scan itself.
"""

import numpy as np
from numba import njit

POINT, PLANE, GICP = 0, 1, 2
NEXT = (1, 2, 0, 1)
"""The axis after an axis, and the one after that."""
FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Row and column → place in an upper triangle xx xy xz yy yz zz."""


@njit(cache=True, error_model="numpy")
def robust_weight(squared, scale):
    """Geman-McClure (weight, loss) of a squared residual; an infinite scale gives plain least squares."""
    u = squared / (scale * scale)
    return 1.0 / ((1.0 + u) * (1.0 + u)), 0.5 * squared / (1.0 + u)


@njit(cache=True, error_model="numpy")
def _metric(error, i, j, source_covariance, normal, target_covariance, R, M, C, RS):
    """Write the matrix of the squared residual eᵀ M e of a pair to ``M (3, 3)``; ``C`` and ``RS`` are buffers.

    The identity for POINT, n nᵀ for PLANE, (C_target + R C_source Rᵀ)⁻¹ for GICP.
    """
    if error == GICP:
        s, t = source_covariance[i], target_covariance[j]
        for r in range(3):
            for c in range(3):
                RS[r, c] = R[r, 0] * s[FULL[0, c]] + R[r, 1] * s[FULL[1, c]] + R[r, 2] * s[FULL[2, c]]
        for r in range(3):
            for c in range(r, 3):
                C[r, c] = t[FULL[r, c]] + RS[r, 0] * R[c, 0] + RS[r, 1] * R[c, 1] + RS[r, 2] * R[c, 2]
                C[c, r] = C[r, c]
    for r in range(3):
        for c in range(3):
            if error == POINT:
                M[r, c] = 1.0 if r == c else 0.0
            elif error == PLANE:
                M[r, c] = normal[j, r] * normal[j, c]
            else:
                p, q, m, n = NEXT[r], NEXT[r + 1], NEXT[c], NEXT[c + 1]
                M[r, c] = C[p, m] * C[q, n] - C[p, n] * C[q, m]
    if error == GICP:
        M *= 1.0 / (C[0, 0] * M[0, 0] + C[0, 1] * M[0, 1] + C[0, 2] * M[0, 2])


@njit(cache=True, error_model="numpy")
def linearise(
    error, source, source_covariance, target, normal, target_covariance, match, T, R, centre, limit, scale, H, b,
):  # fmt: skip
    """Write the normal equations at T about ``centre`` to ``H (6, 6)`` and ``b (6,)``; returns (loss, inliers).

    ``error`` is POINT, PLANE or GICP. Covariances are ``(N, 6)``, upper triangles xx xy xz yy yz zz. Those of the
    source are rotated by ``R (3, 3)``, which Gauss–Newton holds fixed. Pairs farther apart than ``limit`` are ignored.
    """
    H[:, :] = 0.0
    b[:] = 0.0
    loss, inliers = 0.0, 0
    q, e, g = np.empty(3), np.empty(3), np.empty(3)
    M, K, C, RS = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(source)):
        j = match[i]
        if j < 0:
            continue
        for r in range(3):
            q[r] = T[r, 0] * source[i, 0] + T[r, 1] * source[i, 1] + T[r, 2] * source[i, 2] + T[r, 3]
            e[r] = q[r] - target[j, r]
            q[r] -= centre[r]
        if e[0] * e[0] + e[1] * e[1] + e[2] * e[2] > limit * limit:
            continue
        inliers += 1
        _metric(error, i, j, source_covariance, normal, target_covariance, R, M, C, RS)
        for r in range(3):
            g[r] = M[r, 0] * e[0] + M[r, 1] * e[1] + M[r, 2] * e[2]
        weight, pair_loss = robust_weight(e[0] * g[0] + e[1] * g[1] + e[2] * g[2], scale)
        loss += pair_loss
        for r in range(3):
            g[r] *= weight
            for c in range(3):
                M[r, c] *= weight
        for r in range(3):
            m, n = NEXT[r], NEXT[r + 1]
            b[r] += q[m] * g[n] - q[n] * g[m]
            b[3 + r] += g[r]
            for c in range(3):
                K[r, c] = q[m] * M[n, c] - q[n] * M[m, c]  # [q]× M
                H[r, 3 + c] += K[r, c]
                H[3 + r, 3 + c] += M[r, c]
        for c in range(3):
            m, n = NEXT[c], NEXT[c + 1]
            for r in range(3):
                H[r, c] += q[m] * K[r, n] - q[n] * K[r, m]  # [q]× M [q]×ᵀ
    for r in range(6):
        for c in range(r):
            H[r, c] = H[c, r]
    return loss, inliers
