"""Compiled normal equations of the ICP errors, with robust weights.

A step is a twist ``ξ = (ω, v)`` in the axes of the target about a centre c, the mean of the source: a transformed point
q moves by ``ω × (q − c) + v``. The normal equations ``H ξ = −b`` (6×6 and 6, rotation first) are therefore well
conditioned at any distance from the origin, and v is the translation of the scan itself.
"""

from enum import IntEnum

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.robust import geman_mcclure


class PairError(IntEnum):
    """The errors of the ICP family, as kernels take them."""

    POINT = 0
    PLANE = 1
    GICP = 2


@njit(cache=True, error_model="numpy")
def _metric(error, i, j, source_covariance, normal, target_covariance, R):
    """Matrix M of the squared residual eᵀ M e of a pair: xx xy xz yy yz zz.

    The identity for POINT, n nᵀ for PLANE, (C_target + R C_source Rᵀ)⁻¹ for GICP.
    """
    if error == PairError.POINT:
        return 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
    if error == PairError.PLANE:
        nx, ny, nz = normal[j, 0], normal[j, 1], normal[j, 2]
        return nx * nx, nx * ny, nx * nz, ny * ny, ny * nz, nz * nz
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    s00, s01, s02 = source_covariance[i, 0], source_covariance[i, 1], source_covariance[i, 2]
    s11, s12, s22 = source_covariance[i, 3], source_covariance[i, 4], source_covariance[i, 5]
    u0, u1, u2 = r00 * s00 + r01 * s01 + r02 * s02, r00 * s01 + r01 * s11 + r02 * s12, r00 * s02 + r01 * s12 + r02 * s22
    v0, v1, v2 = r10 * s00 + r11 * s01 + r12 * s02, r10 * s01 + r11 * s11 + r12 * s12, r10 * s02 + r11 * s12 + r12 * s22
    w0, w1, w2 = r20 * s00 + r21 * s01 + r22 * s02, r20 * s01 + r21 * s11 + r22 * s12, r20 * s02 + r21 * s12 + r22 * s22
    c00 = target_covariance[j, 0] + u0 * r00 + u1 * r01 + u2 * r02
    c01 = target_covariance[j, 1] + u0 * r10 + u1 * r11 + u2 * r12
    c02 = target_covariance[j, 2] + u0 * r20 + u1 * r21 + u2 * r22
    c11 = target_covariance[j, 3] + v0 * r10 + v1 * r11 + v2 * r12
    c12 = target_covariance[j, 4] + v0 * r20 + v1 * r21 + v2 * r22
    c22 = target_covariance[j, 5] + w0 * r20 + w1 * r21 + w2 * r22
    a00, a01, a02 = c11 * c22 - c12 * c12, c02 * c12 - c01 * c22, c01 * c12 - c02 * c11
    inverse = 1.0 / (c00 * a00 + c01 * a01 + c02 * a02)
    return (
        a00 * inverse, a01 * inverse, a02 * inverse, (c00 * c22 - c02 * c02) * inverse,
        (c01 * c02 - c00 * c12) * inverse, (c00 * c11 - c01 * c01) * inverse,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def linearise(
    error, source, source_covariance, target, normal, target_covariance, match, T, R, centre, limit, scale, H, b,
):  # fmt: skip
    """Write the normal equations at T about ``centre`` to ``H (6, 6)`` and ``b (6,)``; returns the loss, the number of
    pairs and the sum of their squared distances, m².

    ``error`` is a `PairError`. Covariances are ``(N, 6)``, upper triangles xx xy xz yy yz zz. Those of the
    source are rotated by ``R (3, 3)``, which Gauss–Newton holds fixed. Pairs farther apart than ``limit`` are ignored.
    """
    H[:, :] = 0.0
    b[:] = 0.0
    loss, inliers, squared_m2 = 0.0, 0, 0.0
    limit2 = limit * limit
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    cx, cy, cz = centre[0], centre[1], centre[2]
    g = np.empty(6)
    for i in range(len(source)):
        j = match[i]
        if j < 0:
            continue
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = r00 * x + r01 * y + r02 * z + tx
        qy = r10 * x + r11 * y + r12 * z + ty
        qz = r20 * x + r21 * y + r22 * z + tz
        ex, ey, ez = qx - target[j, 0], qy - target[j, 1], qz - target[j, 2]
        d2 = ex * ex + ey * ey + ez * ez
        if d2 > limit2:
            continue
        inliers += 1
        squared_m2 += d2
        m00, m01, m02, m11, m12, m22 = _metric(error, i, j, source_covariance, normal, target_covariance, R)
        gx = m00 * ex + m01 * ey + m02 * ez
        gy = m01 * ex + m11 * ey + m12 * ez
        gz = m02 * ex + m12 * ey + m22 * ez
        squared = ex * gx + ey * gy + ez * gz
        w, pair_loss = geman_mcclure(squared, scale)
        loss += pair_loss
        m00, m01, m02, m11, m12, m22 = w * m00, w * m01, w * m02, w * m11, w * m12, w * m22
        gx, gy, gz = w * gx, w * gy, w * gz
        qx, qy, qz = qx - cx, qy - cy, qz - cz
        g[0], g[1], g[2] = qy * gz - qz * gy, qz * gx - qx * gz, qx * gy - qy * gx
        g[3], g[4], g[5] = gx, gy, gz
        for r in range(6):
            b[r] += g[r]
        # [q]× M, then its product with [q]×ᵀ
        k00, k01, k02 = qy * m02 - qz * m01, qy * m12 - qz * m11, qy * m22 - qz * m12
        k10, k11, k12 = qz * m00 - qx * m02, qz * m01 - qx * m12, qz * m02 - qx * m22
        k20, k21, k22 = qx * m01 - qy * m00, qx * m11 - qy * m01, qx * m12 - qy * m02
        H[0, 0] += qy * k02 - qz * k01
        H[0, 1] += qz * k00 - qx * k02
        H[0, 2] += qx * k01 - qy * k00
        H[1, 1] += qz * k10 - qx * k12
        H[1, 2] += qx * k11 - qy * k10
        H[2, 2] += qx * k21 - qy * k20
        H[0, 3] += k00
        H[0, 4] += k01
        H[0, 5] += k02
        H[1, 3] += k10
        H[1, 4] += k11
        H[1, 5] += k12
        H[2, 3] += k20
        H[2, 4] += k21
        H[2, 5] += k22
        H[3, 3] += m00
        H[3, 4] += m01
        H[3, 5] += m02
        H[4, 4] += m11
        H[4, 5] += m12
        H[5, 5] += m22
    for r in range(6):
        for c in range(r):
            H[r, c] = H[c, r]
    return loss, inliers, squared_m2
