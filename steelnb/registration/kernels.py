"""Compiled parts of the ICP family: correspondences, and the normal equations of each error.

A pose is improved by ``T ← exp(ξ) T`` with ``ξ = (ω, v)`` in the target frame, so a transformed point q moves by
``ω × q + v``. The normal equations are ``H ξ = −b`` (6×6 and 6), rotation first.
"""

import math

import numpy as np
from numba import njit

from steelnb.preprocess.kdtree import nearest_two

POINT, PLANE, GICP = 0, 1, 2
NONE, HUBER, CAUCHY, GEMAN_MCCLURE = 0, 1, 2, 3


@njit(cache=True)
def correspond(tree, source, T, limit, match, other, moved_from, first, second):
    """Nearest target point of each source point under T, exactly, searching only where it may have changed.

    ``match (N,)`` and ``other (N,)`` are positions in the tree of the nearest two or −1; ``moved_from (N, 3)`` is where
    each was last searched, with the distances ``first`` and ``second`` to its nearest two then (``limit`` where there
    are none). A point that has moved by m keeps its nearest while first + m < second − m (Greenspan and Godin, 3DIM
    2001), and stays without one while first − m > limit. Returns the number of searches. A ``second`` below zero asks
    for a search.
    """
    node_of, reach_of = np.empty(64, np.int64), np.empty((64, 4))
    searches = 0
    reach = limit * 1.05 + 1e-12  # a little further, so that points beyond the limit need no search at every step
    for i in range(len(source)):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if second[i] >= 0.0:
            dx, dy, dz = qx - moved_from[i, 0], qy - moved_from[i, 1], qz - moved_from[i, 2]
            m = math.sqrt(dx * dx + dy * dy + dz * dz)
            if match[i] >= 0:
                if first[i] + m < second[i] - m:
                    continue
            elif first[i] - m > limit:
                continue
        match[i], other[i], one, two = nearest_two(
            tree, qx, qy, qz, reach * reach, match[i], other[i], node_of, reach_of
        )
        first[i], second[i] = math.sqrt(one), math.sqrt(two)
        moved_from[i, 0], moved_from[i, 1], moved_from[i, 2] = qx, qy, qz
        searches += 1
    return searches


@njit(cache=True)
def robust_weight(kernel, squared, scale):
    """(weight, loss) of a squared residual for Huber, Cauchy and Geman-McClure of a scale."""
    if kernel == HUBER:
        r = math.sqrt(squared)
        return (1.0, 0.5 * squared) if r <= scale else (scale / r, scale * (r - 0.5 * scale))
    if kernel == CAUCHY:
        u = squared / (scale * scale)
        return 1.0 / (1.0 + u), 0.5 * scale * scale * math.log(1.0 + u)
    if kernel == GEMAN_MCCLURE:
        u = squared / (scale * scale)
        return 1.0 / ((1.0 + u) * (1.0 + u)), 0.5 * squared / (1.0 + u)
    return 1.0, 0.5 * squared


@njit(cache=True)
def linearise(
    error, source, source_covariance, target, normal, target_covariance, match, T, limit, kernel, scale, H, b
):
    """Add up the normal equations at T; returns (loss, inliers, sum of squared distances).

    ``error`` is POINT, PLANE or GICP; covariances are ``(N, 6)`` upper triangles xx xy xz yy yz zz.
    """
    H[:, :] = 0.0
    b[:] = 0.0
    loss, inliers, squares = 0.0, 0, 0.0
    limit2 = limit * limit
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
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
        squares += d2
        if error == PLANE:
            nx, ny, nz = normal[j, 0], normal[j, 1], normal[j, 2]
            r = nx * ex + ny * ey + nz * ez
            w, one = robust_weight(kernel, r * r, scale)
            loss += one
            j0, j1, j2 = qy * nz - qz * ny, qz * nx - qx * nz, qx * ny - qy * nx
            wr = w * r
            b[0] += wr * j0
            b[1] += wr * j1
            b[2] += wr * j2
            b[3] += wr * nx
            b[4] += wr * ny
            b[5] += wr * nz
            H[0, 0] += w * j0 * j0
            H[0, 1] += w * j0 * j1
            H[0, 2] += w * j0 * j2
            H[0, 3] += w * j0 * nx
            H[0, 4] += w * j0 * ny
            H[0, 5] += w * j0 * nz
            H[1, 1] += w * j1 * j1
            H[1, 2] += w * j1 * j2
            H[1, 3] += w * j1 * nx
            H[1, 4] += w * j1 * ny
            H[1, 5] += w * j1 * nz
            H[2, 2] += w * j2 * j2
            H[2, 3] += w * j2 * nx
            H[2, 4] += w * j2 * ny
            H[2, 5] += w * j2 * nz
            H[3, 3] += w * nx * nx
            H[3, 4] += w * nx * ny
            H[3, 5] += w * nx * nz
            H[4, 4] += w * ny * ny
            H[4, 5] += w * ny * nz
            H[5, 5] += w * nz * nz
            continue
        if error == POINT:
            m00 = m11 = m22 = 1.0
            m01 = m02 = m12 = 0.0
            squared = d2
        else:
            s00, s01, s02 = source_covariance[i, 0], source_covariance[i, 1], source_covariance[i, 2]
            s11, s12, s22 = source_covariance[i, 3], source_covariance[i, 4], source_covariance[i, 5]
            # R C_s Rᵀ, row by row
            u0, u1, u2 = (
                r00 * s00 + r01 * s01 + r02 * s02,
                r00 * s01 + r01 * s11 + r02 * s12,
                r00 * s02 + r01 * s12 + r02 * s22,
            )
            v0, v1, v2 = (
                r10 * s00 + r11 * s01 + r12 * s02,
                r10 * s01 + r11 * s11 + r12 * s12,
                r10 * s02 + r11 * s12 + r12 * s22,
            )
            w0, w1, w2 = (
                r20 * s00 + r21 * s01 + r22 * s02,
                r20 * s01 + r21 * s11 + r22 * s12,
                r20 * s02 + r21 * s12 + r22 * s22,
            )
            c00 = target_covariance[j, 0] + u0 * r00 + u1 * r01 + u2 * r02
            c01 = target_covariance[j, 1] + u0 * r10 + u1 * r11 + u2 * r12
            c02 = target_covariance[j, 2] + u0 * r20 + u1 * r21 + u2 * r22
            c11 = target_covariance[j, 3] + v0 * r10 + v1 * r11 + v2 * r12
            c12 = target_covariance[j, 4] + v0 * r20 + v1 * r21 + v2 * r22
            c22 = target_covariance[j, 5] + w0 * r20 + w1 * r21 + w2 * r22
            a00, a01, a02 = c11 * c22 - c12 * c12, c02 * c12 - c01 * c22, c01 * c12 - c02 * c11
            determinant = c00 * a00 + c01 * a01 + c02 * a02
            inverse = 1.0 / determinant
            m00, m01, m02 = a00 * inverse, a01 * inverse, a02 * inverse
            m11 = (c00 * c22 - c02 * c02) * inverse
            m12 = (c01 * c02 - c00 * c12) * inverse
            m22 = (c00 * c11 - c01 * c01) * inverse
            squared = (
                ex * (m00 * ex + m01 * ey + m02 * ez) + ey * (m01 * ex + m11 * ey + m12 * ez)
                + ez * (m02 * ex + m12 * ey + m22 * ez)
            )  # fmt: skip
        w, one = robust_weight(kernel, squared, scale)
        loss += one
        m00, m01, m02, m11, m12, m22 = w * m00, w * m01, w * m02, w * m11, w * m12, w * m22
        gx = m00 * ex + m01 * ey + m02 * ez
        gy = m01 * ex + m11 * ey + m12 * ez
        gz = m02 * ex + m12 * ey + m22 * ez
        b[0] += qy * gz - qz * gy
        b[1] += qz * gx - qx * gz
        b[2] += qx * gy - qy * gx
        b[3] += gx
        b[4] += gy
        b[5] += gz
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
    return loss, inliers, squares
