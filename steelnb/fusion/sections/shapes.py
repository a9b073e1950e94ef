"""Sections of bars, which are angles, round tubes or plates: their outlines and front faces.

A Time-of-Flight sensor measures the near face of a bar. The offset from this face to the axis depends on the section
and its rotation about the axis. Both can be estimated (`sections.fit`): from each viewing direction, the points are as
wide as the outline, and their mean depth is that of the near faces. Range noise acts only along the line of sight, so
it blurs the depth, which is averaged, but not the width.

The frame of a bar has two axes u and v across it and one along it (`frames`). A section has a kind, one of the
constants below, a turn about the axis and a flange. A tube has no turn (NaN), and its flange is its diameter. A plate
has no flange (NaN), and its turn is the direction of its normal, to the only side from which it is visible.
"""

import math

import numpy as np
from numba.extending import register_jitable

from steelnb.core.kernels import njit
from steelnb.core.types import Array
from steelnb.points.ranges import range_sigma_m

UNKNOWN, ANGLE, TUBE, PLATE = range(4)
"""The kinds of a section. Kernels take them as integers."""
PLATE_M = 0.5
"""Half of the edge length of a plate's outline, longer than the reach of a bar's voxels."""
THICKNESS, THICKNESS_SIGMA, THICKNESS_SPREAD = 1 / 12, 0.02, 0.007
"""Thickness of the angle sections of a structure as a share of their flanges, before it is estimated; its standard
deviation; and that of single bars about it. Rolled equal angles have 1/15 to 1/7 (EN 10056-1)."""


@register_jitable
def centroid_m(flange_m: float, thickness_m: float) -> float:
    """Distance of the centroid from either outer face, metres: that of two rectangles b × t and (b − t) × t."""
    return (flange_m * flange_m + flange_m * thickness_m - thickness_m * thickness_m) / (
        2.0 * (2.0 * flange_m - thickness_m)
    )


@register_jitable
def centroid_growth(thickness: float) -> float:
    """Derivative of `centroid_m` with respect to the thickness, both as shares of the flange."""
    return (3.0 - 4.0 * thickness + thickness * thickness) / (2.0 * (2.0 - thickness) ** 2)


def frames(direction: Array) -> Array:
    """Two unit vectors ``(B, 2, 3)`` across each direction ``(B, 3)``, which form a right-handed frame with it."""
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(direction, first)], axis=1)


@njit(cache=True)
def in_frame(direction, across, x, y, z):  # type: ignore[no-untyped-def]
    """Components of a vector, world frame, along the unit vectors of a bar: ``across (2, 3)``, then ``direction
    (3,)``."""
    e1, e2 = across[0], across[1]
    return (
        x * e1[0] + y * e1[1] + z * e1[2],
        x * e2[0] + y * e2[1] + z * e2[2],
        x * direction[0] + y * direction[1] + z * direction[2],
    )


@njit(cache=True)
def sighting(T, point, start):  # type: ignore[no-untyped-def]
    """The vector from the ``start (3,)`` of a bar to a ``point (3,)`` in the frame of a sensor at ``T (4, 4)``, and the
    vector from the point to the sensor, both in the world frame."""
    cx = -(T[0, 0] * point[0] + T[0, 1] * point[1] + T[0, 2] * point[2])
    cy = -(T[1, 0] * point[0] + T[1, 1] * point[1] + T[1, 2] * point[2])
    cz = -(T[2, 0] * point[0] + T[2, 1] * point[1] + T[2, 2] * point[2])
    return T[0, 3] - cx - start[0], T[1, 3] - cy - start[1], T[2, 3] - cz - start[2], cx, cy, cz


@njit(cache=True)
def angle_outline(turn, flange, thickness, corner):  # type: ignore[no-untyped-def]
    """Write the outline of an angle section about its centroid to ``corner (6, 2)``, metres, counterclockwise.
    ``thickness``: share of the flange."""
    t = thickness * flange
    c = centroid_m(flange, t)
    xs = (0.0, flange, flange, t, t, 0.0)
    ys = (0.0, 0.0, t, t, flange, flange)
    cosine, sine = math.cos(turn), math.sin(turn)
    for k in range(6):
        x, y = xs[k] - c, ys[k] - c
        corner[k, 0], corner[k, 1] = cosine * x - sine * y, sine * x + cosine * y


@njit(cache=True)
def outlines(kind, turn, flange, thickness=THICKNESS):  # type: ignore[no-untyped-def]
    """The outlines ``(B, 6, 2)`` of B sections about their centroids, metres; ``thickness``: share of the flange.

    The first number of a tube's outline is its radius. A plate has one edge, from the first corner, right of its
    normal, to the second. All other numbers, and the outlines of unknown sections, are zero.
    """
    corner = np.zeros((len(kind), 6, 2))
    for b in range(len(kind)):
        if kind[b] == ANGLE:
            angle_outline(turn[b], flange[b], thickness, corner[b])
        elif kind[b] == TUBE:
            corner[b, 0, 0] = 0.5 * flange[b]
        elif kind[b] == PLATE:
            corner[b, 1, 0], corner[b, 1, 1] = -PLATE_M * math.sin(turn[b]), PLATE_M * math.cos(turn[b])
            corner[b, 0] = -corner[b, 1]
    return corner


@njit(cache=True)
def front_face(kind, corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    """Height of an outline towards the viewer, metres from its centroid, at a position ``beside`` it; its slope; and
    the corner at which its edge ends, −1 for a tube. The height is −1e9 outside of the outline."""
    front, rise, edge = -1e9, 0.0, -1
    if kind == TUBE:
        if abs(beside) < 0.999 * corner[0, 0]:
            front = math.sqrt(corner[0, 0] ** 2 - beside * beside)
            rise = -beside / front
        return front, rise, edge
    # The corners are counterclockwise, so the position beside grows along edges that face the viewer.
    first, last = (1, 2) if kind == PLATE else (0, 6)
    before = corner[first - 1]
    b0, d0 = -sine * before[0] + cosine * before[1], cosine * before[0] + sine * before[1]
    for i in range(first, last):
        b1, d1 = -sine * corner[i, 0] + cosine * corner[i, 1], cosine * corner[i, 0] + sine * corner[i, 1]
        if b0 <= beside < b1:
            s = (d1 - d0) / (b1 - b0)
            if d0 + s * (beside - b0) > front:
                front, rise, edge = d0 + s * (beside - b0), s, i
        b0, d0 = b1, d1
    return front, rise, edge


@njit(cache=True)
def face_growth(kind, edge, flange, thickness):  # type: ignore[no-untyped-def]
    """How far the face on an ``edge`` (`front_face`) moves outwards, metres per unit of the thickness; 0 unless the
    section is an angle. The centroid moves away from the heel, so the outer faces and the tips move, too."""
    if kind != ANGLE:
        return 0.0
    centroid = centroid_growth(thickness)
    if edge < 2:  # outer faces
        return centroid * flange
    return ((1.0 if edge == 3 or edge == 4 else 0.0) - centroid) * flange


@njit(cache=True, error_model="numpy")
def face_distance(u, v, t, p, q, w, kind, corner, length):  # type: ignore[no-untyped-def]
    """Residual of a point: its distance from the front face of a bar along the line of sight across the bar, metres.
    NaN if it lies beyond an end or beside the outline, or if the bar or its face is seen at a grazing angle.

    In the frame of the bar (`in_frame`), ``u, v, t`` is the vector from its start to the point, and ``p, q, w`` from
    the point to the sensor. Returns also the standard deviation due to range noise, the distance to the sensor across
    the bar, cosine and sine of the direction, the position beside the axis, and height, slope and edge of the face
    there (`front_face`).
    """
    square, square_3d = p * p + q * q, p * p + q * q + w * w
    if t < 0.0 or t > length or square < 0.1 * square_3d:
        return np.nan, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1
    distance, range_ = math.sqrt(square), math.sqrt(square_3d)
    cosine, sine = p / distance, q / distance
    beside = -sine * u + cosine * v
    front, rise, edge = front_face(kind, corner, cosine, sine, beside)
    residual = cosine * u + sine * v - front if front > -1e8 and abs(rise) <= 2.0 else np.nan
    # The noise at the range of the face. At the measured range, points that noise moves nearer would weigh more.
    sigma = range_sigma_m(range_ * (1.0 + residual / distance)) * distance / range_
    return residual, sigma, distance, cosine, sine, beside, front, rise, edge


@njit(cache=True)
def nearest_edge(kind, corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    """The position beside the axis of the corner of an angle, or edge of a tube, that appears nearest to ``beside``."""
    if kind == TUBE:
        return math.copysign(corner[0, 0], beside)
    nearest, edge = 1e9, 0.0
    for i in range(6):
        b = -sine * corner[i, 0] + cosine * corner[i, 1]
        if abs(beside - b) < nearest:
            nearest, edge = abs(beside - b), b
    return edge
