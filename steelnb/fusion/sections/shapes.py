"""Angle sections, round tubes and plates: their outlines, and histograms of the points of a bar by viewing direction.

A Time-of-Flight sensor measures the near face of a bar. The offset from this face to the axis depends on the section
and its rotation about the axis. Both can be estimated (`fusion.section_fit`): from each viewing direction, the points
are as wide as the outline, and their mean depth is that of the near faces. Range noise acts only along the line of
sight, so it blurs the depth, which is averaged, but not the width.

The frame of a bar has two axes u and v across it and one along it (`frames`). A round tube is a section whose turn is
NaN and whose flange is its diameter. Its outline has its radius in place of the first corner, and NaN for the others.
A plate is a section whose flange is infinite. Its outline is one edge, visible from the side that its turn points to.
"""

import math

import numpy as np
from numba import njit

from steelnb.core.types import Array
from steelnb.points.ranges import range_sigma_m

PLATE_M = 0.5
"""Half of the edge length of a plate's outline, longer than the reach of a bar's voxels."""
VIEWS, CELLS, PARTS = 24, 32, 6
"""Number of bins: directions of 15°, cells of 1 cm beside the line of sight, and parts along a bar."""
HISTOGRAM = PARTS, VIEWS, CELLS, 4
"""Shape of the histogram of a bar. For each part, direction and cell: number of points, weight, weighted sums of u and
v."""
CELL_M = 0.01
THICKNESS, THICKNESS_SIGMA, THICKNESS_SPREAD = 1 / 12, 0.02, 0.007
"""Thickness of the angle sections of a structure as a share of their flanges, before it is estimated; its standard
deviation; and that of single bars about it. Rolled equal angles have 1/15 to 1/7 (EN 10056-1)."""


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


@njit(cache=True, nogil=True)
def accumulate(points, T, bar, start, direction, length, across, margin, histogram):  # type: ignore[no-untyped-def]
    """Add points ``(N, 3)`` in the frame of a sensor at ``T (4, 4)`` to the histograms of their bars ``(N,)``. Points
    near the ends, where other bars join, are left out: within ``margin`` metres, or a third of the length if less."""
    for i in range(len(points)):
        b = bar[i]
        x, y, z, cx, cy, cz = sighting(T, points[i], start[b])
        u, v, t = in_frame(direction[b], across[b], x, y, z)
        edge = min(margin, length[b] / 3.0)
        if t < edge or t > length[b] - edge:
            continue
        p, q, _ = in_frame(direction[b], across[b], cx, cy, cz)
        square = p * p + q * q
        if square < 0.1 * (cx * cx + cy * cy + cz * cz):  # line of sight along the bar: its end face
            continue
        distance = math.sqrt(square)
        beside = (-q * u + p * v) / distance
        cell = math.floor(beside / CELL_M) + CELLS // 2
        if cell < 0 or cell >= CELLS:
            continue
        view = int((math.atan2(q, p) + math.pi) * VIEWS / (2.0 * math.pi)) % VIEWS
        part = min(PARTS - 1, int(PARTS * t / length[b]))
        h = histogram[b, part, view, cell]
        w = 1.0 / square  # range noise grows with the distance
        h[0] += 1.0
        h[1] += w
        h[2] += w * u
        h[3] += w * v


@njit(cache=True)
def direction_of(view):  # type: ignore[no-untyped-def]
    """Cosine and sine of the middle of a bin of viewing directions."""
    angle = (view + 0.5) * 2.0 * math.pi / VIEWS - math.pi
    return math.cos(angle), math.sin(angle)


@njit(cache=True)
def cells_of(histogram, length):  # type: ignore[no-untyped-def]
    """Non-empty cells of a bar ``(C, 7)``: u, v, weight, cosine and sine of the direction, position along from the
    middle, number of the direction."""
    parts = len(histogram)
    found = np.empty((parts * VIEWS * CELLS, 7))
    n = 0
    for part in range(parts):
        for view in range(VIEWS):
            cosine, sine = direction_of(view)
            for cell in range(CELLS):
                h = histogram[part, view, cell]
                if h[0] >= 3.0:
                    found[n, 0], found[n, 1], found[n, 2] = h[2] / h[1], h[3] / h[1], h[1]
                    found[n, 3], found[n, 4] = cosine, sine
                    found[n, 5] = ((part + 0.5) / parts - 0.5) * length
                    found[n, 6] = view
                    n += 1
    return found[:n]


@njit(cache=True)
def merged_cells(histogram):  # type: ignore[no-untyped-def]
    """The `cells_of` a bar with its parts merged: fewer cells, which suffice for a search."""
    return cells_of(np.expand_dims(histogram.sum(axis=0), 0), 0.0)


@njit(cache=True)
def edges_of(histogram):  # type: ignore[no-untyped-def]
    """Edges of the outline ``(R, 6)`` from each direction with enough points: low and high edge, cosine and sine of the
    direction, weight, number of the direction. An edge is where the number of points falls to half of that inside,
    since blur moves as many points out as in."""
    found = np.empty((VIEWS, 6))
    n = 0
    for view in range(VIEWS):
        count, weight = histogram[:, view, :, 0].sum(axis=0), histogram[:, view, :, 1].sum()
        total = count.sum()
        if total < 60.0:
            continue
        # Half of the mean count over points, not cells; for a uniform strip, this is half of its level.
        half = 0.5 * (count * count).sum() / total
        middle = int((count * np.arange(CELLS)).sum() / total + 0.5)
        if count[middle] < half:
            middle = int(np.argmax(count))
        inside = True
        for side in range(2):
            step, cell = 2 * side - 1, middle
            while 0 < cell < CELLS - 1 and count[cell] >= half:
                cell += step
            inside &= 0 < cell < CELLS - 1
            if inside:
                level, outside = count[cell - step], count[cell]
                edge = cell + 0.5 - step * (half - outside) / max(level - outside, 1e-9)
                found[n, side] = edge * CELL_M - CELLS * CELL_M / 2
        if not inside:
            continue
        found[n, 2], found[n, 3] = direction_of(view)
        found[n, 4], found[n, 5] = weight, view
        n += 1
    return found[:n]


@njit(cache=True)
def outline(turn, flange, thickness, corner):  # type: ignore[no-untyped-def]
    """Write the outline of a section about its centroid to ``corner (6, 2)``, metres. ``thickness``: share of the
    flange."""
    if turn != turn:
        corner[:] = np.nan
        corner[0, 0] = 0.5 * flange
        return
    if flange == math.inf:
        corner[:] = np.nan
        corner[1, 0], corner[1, 1] = -PLATE_M * math.sin(turn), PLATE_M * math.cos(turn)
        corner[0] = corner[5] = -corner[1]
        return
    t = thickness * flange
    c = (flange * flange + flange * t - t * t) / (2.0 * (2.0 * flange - t))
    xs = (0.0, flange, flange, t, t, 0.0)
    ys = (0.0, 0.0, t, t, flange, flange)
    cosine, sine = math.cos(turn), math.sin(turn)
    for k in range(6):
        x, y = xs[k] - c, ys[k] - c
        corner[k, 0], corner[k, 1] = cosine * x - sine * y, sine * x + cosine * y


@njit(cache=True)
def front_face(corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    """Height of the outline towards the viewer, metres from its centroid, at a position ``beside`` it; its slope; and
    the corner at which its edge ends, −1 for a tube. The height is −1e9 outside of the outline. The corners are
    counterclockwise, so ``beside`` grows along edges facing the viewer."""
    if corner[5, 0] != corner[5, 0]:
        if abs(beside) >= 0.999 * corner[0, 0]:
            return -1e9, 0.0, -1
        front = math.sqrt(corner[0, 0] ** 2 - beside * beside)
        return front, -beside / front, -1
    front, rise, edge = -1e9, 0.0, -1
    b0, d0 = -sine * corner[5, 0] + cosine * corner[5, 1], cosine * corner[5, 0] + sine * corner[5, 1]
    for i in range(6):
        b1, d1 = -sine * corner[i, 0] + cosine * corner[i, 1], cosine * corner[i, 0] + sine * corner[i, 1]
        if b0 <= beside < b1:
            s = (d1 - d0) / (b1 - b0)
            if d0 + s * (beside - b0) > front:
                front, rise, edge = d0 + s * (beside - b0), s, i
        b0, d0 = b1, d1
    return front, rise, edge


@njit(cache=True)
def face_growth(edge, flange, thickness):  # type: ignore[no-untyped-def]
    """How far the face on an ``edge`` (`front_face`) moves outwards, metres per unit of the thickness; 0 for a tube or
    plate. The centroid moves away from the heel, so the outer faces and the tips move, too."""
    if edge < 0 or flange == math.inf:
        return 0.0
    centroid = (3.0 - 4.0 * thickness + thickness * thickness) / (2.0 * (2.0 - thickness) ** 2)
    if edge < 2:  # outer faces
        return centroid * flange
    return ((1.0 if edge == 3 or edge == 4 else 0.0) - centroid) * flange


@njit(cache=True, error_model="numpy")
def face_distance(u, v, t, p, q, w, corner, length):  # type: ignore[no-untyped-def]
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
    front, rise, edge = front_face(corner, cosine, sine, beside)
    residual = cosine * u + sine * v - front if front > -1e8 and abs(rise) <= 2.0 else np.nan
    # The noise at the range of the face. At the measured range, points that noise moves nearer would weigh more.
    sigma = range_sigma_m(range_ * (1.0 + residual / distance)) * distance / range_
    return residual, sigma, distance, cosine, sine, beside, front, rise, edge


@njit(cache=True)
def nearest_edge(corner, cosine, sine, beside):  # type: ignore[no-untyped-def]
    """The position beside the axis of the corner, or edge of a tube, that appears nearest to ``beside``."""
    if corner[5, 0] != corner[5, 0]:
        return math.copysign(corner[0, 0], beside)
    nearest, edge = 1e9, 0.0
    for i in range(6):
        b = -sine * corner[i, 0] + cosine * corner[i, 1]
        if abs(beside - b) < nearest:
            nearest, edge = abs(beside - b), b
    return edge


@njit(cache=True)
def outlines(turn, flange, thickness=THICKNESS):  # type: ignore[no-untyped-def]
    """The outlines ``(B, 6, 2)`` of B sections about their centroids, metres; ``thickness``: share of the flange."""
    corner = np.empty((len(turn), 6, 2))
    for b in range(len(turn)):
        outline(turn[b], flange[b], thickness, corner[b])
    return corner
