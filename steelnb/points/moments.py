"""Compiled moments of weighted points, and eigenvectors of symmetric 3×3 matrices.

Moments are a tuple of ten numbers (w, x, y, z, xx, xy, xz, yy, yz, zz): the total weight and the weighted sums of the
coordinates and of their products. Choose an origin near the points: sums about a distant one lose digits.
Symmetric matrices are upper triangles in the order xx xy xz yy yz zz.
"""

import math

from steelnb.core.kernels import njit

NO_MOMENTS = (0.0,) * 10


@njit(cache=True, error_model="numpy")
def add_point(m, w, x, y, z):
    """Moments ``m`` plus one point of weight ``w``."""
    return (
        m[0] + w, m[1] + w * x, m[2] + w * y, m[3] + w * z, m[4] + w * x * x, m[5] + w * x * y, m[6] + w * x * z,
        m[7] + w * y * y, m[8] + w * y * z, m[9] + w * z * z,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def add_moments(m, other, x, y, z):
    """Moments ``m`` plus the moments ``other``, whose origin is (x, y, z), by the parallel-axis theorem."""
    w, sx, sy, sz = other[0], other[1], other[2], other[3]
    return (
        m[0] + w, m[1] + (sx + w * x), m[2] + (sy + w * y), m[3] + (sz + w * z),
        m[4] + (other[4] + x * (2.0 * sx + w * x)), m[5] + (other[5] + x * sy + y * (sx + w * x)),
        m[6] + (other[6] + x * sz + z * (sx + w * x)), m[7] + (other[7] + y * (2.0 * sy + w * y)),
        m[8] + (other[8] + y * sz + z * (sy + w * y)), m[9] + (other[9] + z * (2.0 * sz + w * z)),
    )  # fmt: skip


@njit(cache=True)
def store(m, row):
    """Write moments to a row of an array; element by element, since ``row[:] = m`` takes twice as long."""
    row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9] = m


@njit(cache=True, error_model="numpy")
def covariance(m):
    """Covariance about the mean, normalised by the total weight: (xx, xy, xz, yy, yz, zz)."""
    w = m[0]
    x, y, z = m[1] / w, m[2] / w, m[3] / w
    return (
        m[4] / w - x * x, m[5] / w - x * y, m[6] / w - x * z, m[7] / w - y * y, m[8] / w - y * z, m[9] / w - z * z
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def moments_about_mean(px, py, pz, chosen, count):
    """Mean of the points ``chosen[:count]``, weight 1 each, and their moments about it: (x, y, z, moments)."""
    x = y = z = 0.0
    for k in range(count):
        x += px[chosen[k]]
        y += py[chosen[k]]
        z += pz[chosen[k]]
    if count > 0:
        x, y, z = x / count, y / count, z / count
    m = NO_MOMENTS
    for k in range(count):
        m = add_point(m, 1.0, px[chosen[k]] - x, py[chosen[k]] - y, pz[chosen[k]] - z)
    return x, y, z, m


@njit(cache=True, error_model="numpy")
def _jacobi_rotation(app, aqq, apq):
    """The Jacobi rotation that zeroes the element pq: (tangent, cosine, sine)."""
    if apq == 0.0:
        return 0.0, 1.0, 0.0
    theta = (aqq - app) / (2.0 * apq)
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    return t, c, t * c


@njit(cache=True, error_model="numpy")
def eigen(a00, a01, a02, a11, a12, a22):
    """Eigenvalues and unit eigenvectors of a symmetric 3×3 matrix, in ascending order: ((value, x, y, z), …).

    Cyclic Jacobi rotations. Source: Golub and Van Loan, "Matrix Computations", section 8.5.
    """
    x0, y0, z0, x1, y1, z1, x2, y2, z2 = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(12):
        if a01 * a01 + a02 * a02 + a12 * a12 <= 1e-30 * (a00 * a00 + a11 * a11 + a22 * a22):
            break
        t, c, s = _jacobi_rotation(a00, a11, a01)
        a00, a11, a01, a02, a12 = a00 - t * a01, a11 + t * a01, 0.0, c * a02 - s * a12, s * a02 + c * a12
        x0, y0, z0, x1, y1, z1 = (
            c * x0 - s * x1, c * y0 - s * y1, c * z0 - s * z1, s * x0 + c * x1, s * y0 + c * y1, s * z0 + c * z1
        )  # fmt: skip
        t, c, s = _jacobi_rotation(a00, a22, a02)
        a00, a22, a02, a01, a12 = a00 - t * a02, a22 + t * a02, 0.0, c * a01 - s * a12, s * a01 + c * a12
        x0, y0, z0, x2, y2, z2 = (
            c * x0 - s * x2, c * y0 - s * y2, c * z0 - s * z2, s * x0 + c * x2, s * y0 + c * y2, s * z0 + c * z2
        )  # fmt: skip
        t, c, s = _jacobi_rotation(a11, a22, a12)
        a11, a22, a12, a01, a02 = a11 - t * a12, a22 + t * a12, 0.0, c * a01 - s * a02, s * a01 + c * a02
        x1, y1, z1, x2, y2, z2 = (
            c * x1 - s * x2, c * y1 - s * y2, c * z1 - s * z2, s * x1 + c * x2, s * y1 + c * y2, s * z1 + c * z2
        )  # fmt: skip
    one, two, three = (a00, x0, y0, z0), (a11, x1, y1, z1), (a22, x2, y2, z2)
    if one[0] > two[0]:
        one, two = two, one
    if two[0] > three[0]:
        two, three = three, two
    if one[0] > two[0]:
        one, two = two, one
    return one, two, three


@njit(cache=True, error_model="numpy")
def principal_axis(xx, xy, xz, yy, yz, zz):
    """Largest eigenvalue λ, sum of the others, and unit eigenvector of λ of a positive semidefinite matrix.

    Returns (λ, sum, x, y, z). The component of the eigenvector with the largest magnitude is positive.
    """
    one, two, (along, x, y, z) = eigen(xx, xy, xz, yy, yz, zz)
    largest = x
    if abs(y) > abs(largest):
        largest = y
    if abs(z) > abs(largest):
        largest = z
    sign = -1.0 if largest < 0.0 else 1.0
    return along, max(one[0] + two[0], 0.0), sign * x, sign * y, sign * z
