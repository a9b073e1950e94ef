"""Bars of a cloud by one cost: tubes in which points are denser than around them.

A line gains, for each point in its tube, the logarithm of how much denser the tube is than what lies around it and than
the bars that are known there, and pays `COST`. Its width is the one of a few that gains most, and its ends are those of
the best stretch along it (Kadane's maximum subarray). The line that gains most is taken, its points leave, and so on
(as in Progressive-X, Barath & Matas, ICCV 2019). Then lines are fitted anew and joined where one costs less than two,
as labels are in PEaRL (Isack & Boykov, IJCV 2012).
"""

import heapq
import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Segments
from steelnb.hough.lines import spacing

COST = 10.0
"""What a line must gain, nats."""
PROMISE, AS_GOOD = 0.7, 0.95
"""A candidate is worth fitting if it gains the first share of the cost, and is taken if it gains the second of what the
next one promised."""
SETTLED = 1.001
"""A line is fitted until a fit multiplies its gain by no more."""
PRIOR = 0.5
"""Added to the numbers of points in a cell that are compared. With less, random clumps are lines."""
EMPTY, EACH = 1.2, 0.75
"""What an empty cell along a line costs, and one with points, nats. The latter pays for choosing the best stretch."""
WIDTHS = (1.0, 1.5, 2.2)
"""Radii of the tubes, in multiples of the narrowest."""
SHELL = 3.0
"""Outer radius of what counts as around a tube, in its radii."""
WINDOW, PLANE_WINDOW = 2, 5
"""Cells before and after one in which the points of the tube and around it are counted, and those of a plane."""
TAIL = 4
"""Beyond the radius of a known bar, its points are expected to thin out with this power of the distance."""
SECTORS = 16
"""Directions around a tube in which points are counted. A plane through the line fills two opposite ones."""
NEAR, FAR, PARTNERS = 6.0, 24.0, 8
"""A candidate runs through a point and one of some partners, at such distances from it in tube radii."""
POOL = 4096
"""Maximum number of points from which partners are drawn."""
SEED_EDGE = 4.0
"""Edge of the cells in which one point each is a seed, in tube radii."""
SWEEPS, LAST_SWEEPS, IDLE = 20, 3, 2
"""Maximum number of sweeps before and after lines are joined, and of those in a row that find nothing."""
MARGIN, GROWN, CELLS = 4, 6, 800
"""Cells past the ends of a line in which a fit looks for more of it; a line that ends nearer to where the search does
may be longer; and the number of cells past which none is."""
FIT = 1.5
"""A line is fitted to points within so many radii of its tube."""
BEND_RAD = math.radians(2.0), math.radians(20.0)
"""Angles between two lines that meet in a bend."""
BEND_REACH, BEND_CELLS, BEND_PLACES, BEND_NOISE, BENDS = 1.25, 5, 12, 0.25, 3
"""A bend: reach of its points in tube radii, minimum length of both its lines in cells, parts of a line between which
it may lie, lowest noise in radii of the narrowest tube, and how often the halves of a line may bend again."""
MERGE_RAD, MERGE_GAP = math.radians(8.0), 40.0
"""Angle and gap, in tube radii, up to which two lines may be one."""
POINTS_MIN = 5
"""A line with fewer points near it is none."""
NEIGHBOUR = 4
"""The distance of points is that to their fourth neighbours: in a cloud that was thinned by a voxel filter, it is the
edge of the voxels, while nearest neighbours may be close together on both sides of a boundary."""
CELLS_MAX = 10**7
"""Maximum number of cells of the grid that points are sorted into."""


class SortedCloud(NamedTuple):
    """N points, metres, sorted into the cells of a grid, and what is known of them.

    ``point (N, 3)``; ``weight (N,)``: how many points each stands for; ``owner (N,)``: the line each belongs to, −1 for
    none; ``tail (N,)``: points of known lines that are expected in a cell of the narrowest tube there. Cells have the
    edge ``edge``, the grid begins at ``low (3,)`` and has the ``shape (3,)``; ``first (C + 1,)``: the first point of
    each cell. ``found (N,)``: what `near_line` writes to.
    """

    point: Array
    weight: Array
    owner: IntArray
    tail: Array
    low: Array
    edge: float
    shape: IntArray
    first: IntArray
    found: IntArray

    @classmethod
    def of(cls, points: Array, weight: Array, edge: float) -> "SortedCloud":
        """Sort points ``(N, 3)``; the cells are wider than ``edge`` if there would be too many."""
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
        edge, low = max(edge, float((np.prod(high - low + edge) / CELLS_MAX) ** (1 / 3))), low - 1e-9
        cell = np.floor((points - low) / edge).astype(np.int64)
        shape = np.floor((high - low) / edge).astype(np.int64) + 1
        key = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        order = np.argsort(key, kind="stable")
        first = np.append(0, np.cumsum(np.bincount(key, minlength=int(np.prod(shape)))))
        n = len(points)
        none, empty = np.full(n, -1), np.empty(n, np.int64)
        return cls(points[order], weight[order].astype(float), none, np.zeros(n), low, edge, shape, first, empty)


class Tubes(NamedTuple):
    """Radii of the tubes ``(W,)``, the narrowest first, and the length of the cells along them, metres."""

    radius: Array
    cell: float


class Found(NamedTuple):
    """A line through ``point (3,)`` along the unit vector ``axis (3,)``, from ``low`` to ``high``, metres; its gain in
    nats, and the number of its tube."""

    point: Array
    axis: Array
    gain: float
    tube: int
    low: float
    high: float

    @property
    def length(self) -> float:
        return self.high - self.low

    @property
    def middle(self) -> Array:
        return self.point + 0.5 * (self.low + self.high) * self.axis

    def between(self, points: Array) -> "Found":
        """The same from the first of its points ``(N, 3)`` to the last."""
        along = (points - self.point) @ self.axis
        return self._replace(low=along.min(), high=along.max()) if len(along) else self

    @property
    def ends(self) -> Array:
        return self.point + np.array([[self.low], [self.high]]) * self.axis


@njit(cache=True, nogil=True)
def near_line(cloud, point, axis, low, high, reach):
    """Write the points within ``reach`` of a line to ``cloud.found``; returns their number. The grid is walked along
    the coordinate that changes fastest."""
    m = int(np.argmax(np.abs(axis)))
    u, v = (m + 1) % 3, (m + 2) % 3
    du, dv = axis[u] / axis[m], axis[v] / axis[m]
    begin, end = point[m] + low * axis[m], point[m] + high * axis[m]
    if begin > end:
        begin, end = end, begin
    edge, shape = cloud.edge, cloud.shape
    i0 = max(0, int((begin - reach - cloud.low[m]) // edge))
    i1 = min(shape[m] - 1, int((end + reach - cloud.low[m]) // edge))
    ru = reach * math.sqrt(1 + du * du) + 0.5 * edge * abs(du)
    rv = reach * math.sqrt(1 + dv * dv) + 0.5 * edge * abs(dv)
    found, index = 0, np.zeros(3, np.int64)
    for i in range(i0, i1 + 1):
        along = cloud.low[m] + (i + 0.5) * edge - point[m]
        at_u, at_v = point[u] + along * du - cloud.low[u], point[v] + along * dv - cloud.low[v]
        for j in range(max(0, int((at_u - ru) // edge)), min(shape[u] - 1, int((at_u + ru) // edge)) + 1):
            for k in range(max(0, int((at_v - rv) // edge)), min(shape[v] - 1, int((at_v + rv) // edge)) + 1):
                index[m], index[u], index[v] = i, j, k
                cell = (index[0] * shape[1] + index[1]) * shape[2] + index[2]
                for q in range(cloud.first[cell], cloud.first[cell + 1]):
                    x, y, z = cloud.point[q, 0] - point[0], cloud.point[q, 1] - point[1], cloud.point[q, 2] - point[2]
                    t = x * axis[0] + y * axis[1] + z * axis[2]
                    if low <= t <= high and x * x + y * y + z * z - t * t <= reach * reach:
                        cloud.found[found] = q
                        found += 1
    return found


@njit(cache=True, nogil=True)
def across(axis):
    """Two unit vectors that are perpendicular to an axis and to each other."""
    e = np.zeros(3)
    m = int(np.argmin(np.abs(axis)))
    e[m] = 1.0
    e -= axis[m] * axis
    e /= math.sqrt((e * e).sum())
    f = np.array([axis[1] * e[2] - axis[2] * e[1], axis[2] * e[0] - axis[0] * e[2], axis[0] * e[1] - axis[1] * e[0]])
    return e, f


@njit(cache=True, nogil=True)
def sector_of(x, y):
    """Which of 16 sectors a direction lies in; without an arc tangent, which processors round differently."""
    u, v = max(abs(x), abs(y)), min(abs(x), abs(y))
    sector = 0 if v <= 0.41421356237 * u else 1
    if abs(y) > abs(x):
        sector = 3 - sector
    if x < 0.0:
        return 7 - sector if y >= 0.0 else 8 + sector
    return sector if y >= 0.0 else 15 - sector


@njit(cache=True, nogil=True)
def best_stretch(gain):
    """Kadane's maximum subarray: the sum, its first cell, and one past its last."""
    best, first, last, total, begin = 0.0, 0, 0, 0.0, 0
    for c in range(len(gain)):
        total += gain[c]
        if total > best:
            best, first, last = total, begin, c + 1
        if total <= 0.0:
            total, begin = 0.0, c + 1
    return best, first, last


@njit(cache=True, nogil=True)
def gain_along(cloud, tubes, point, axis, half, grows):
    """Gain of a line: (gain in nats, number of the tube, low, high), the ends of its best stretch in metres from
    ``point``. It is sought within ``half`` metres of the point and, if it ``grows``, farther until it ends.

    In a cell, the n free points in the tube gain n log(N / B) and the logarithm of a Gaussian profile across the tube,
    of half its radius. N: their mean number in the `WINDOW` around the cell. B: what is expected in as large a volume,
    the largest of the free points around all tubes, around this one, and of the smaller of two opposite sectors along
    the `PLANE_WINDOW`, which is that of a plane through the line; and the tails of known lines. `PRIOR` is added to
    both. A cell with nothing but points of other lines costs nothing.
    """
    radius, cell = tubes.radius, tubes.cell
    low, high, reach, widest = -half, half, SHELL * tubes.radius[-1], len(tubes.radius)
    e, f = across(axis)
    result = (0.0, 0, 0.0, 0.0)
    while True:
        cells = round((high - low) / cell)
        free, mass, square = np.zeros((widest, cells)), np.zeros((widest, cells)), np.zeros((widest, cells))
        known, beyond, tail = np.zeros((widest, cells)), np.zeros((widest, cells)), np.zeros((widest, cells))
        around = np.zeros((widest, cells + 1, SECTORS))
        for i in range(near_line(cloud, point, axis, low, high - 1e-9, reach)):
            q = cloud.found[i]
            x, y, z = cloud.point[q, 0] - point[0], cloud.point[q, 1] - point[1], cloud.point[q, 2] - point[2]
            t = x * axis[0] + y * axis[1] + z * axis[2]
            p, r = x * e[0] + y * e[1] + z * e[2], x * f[0] + y * f[1] + z * f[2]
            aside = math.sqrt(p * p + r * r)
            c, sector = min(int((t - low) / cell), cells - 1), sector_of(p, r)
            for k in range(widest):
                if cloud.owner[q] >= 0:
                    known[k, c] += aside <= radius[k]
                elif aside <= radius[k]:
                    free[k, c] += 1.0
                    mass[k, c] += cloud.weight[q]
                    square[k, c] += (aside / radius[k]) ** 2
                    tail[k, c] += cloud.tail[q] * (radius[k] / radius[0]) ** 2
                else:
                    beyond[k, c] += cloud.weight[q]
                    if aside <= SHELL * radius[k]:
                        around[k, c + 1, sector] += cloud.weight[q]
        best, first, last, tube, gain = 0.0, 0, 0, 0, np.zeros(cells)
        for k in range(widest):
            for c in range(cells):
                around[k, c + 1] += around[k, c]
            outside = (reach / radius[k]) ** 2 - 1.0
            for c in range(cells):
                if free[k, c] == 0.0:
                    gain[c] = 0.0 if known[k, c] > 0.0 else -EMPTY
                    continue
                begin, end = max(0, c - WINDOW), min(cells, c + WINDOW + 1)
                window = end - begin
                inside = mass[k, begin:end].sum() / window
                ring = around[k, end] - around[k, begin]
                expected = max(beyond[k, begin:end].sum() / outside, ring.sum() / (SHELL**2 - 1.0)) / window
                of_others = tail[k, begin:end].sum() / free[k, begin:end].sum()
                begin, end = max(0, c - PLANE_WINDOW), min(cells, c + PLANE_WINDOW + 1)
                ring = around[k, end] - around[k, begin]
                for s in range(SECTORS // 2):
                    t = (s + 1) % SECTORS
                    one, other = ring[s] + ring[t], ring[s + SECTORS // 2] + ring[(t + SECTORS // 2) % SECTORS]
                    expected = max(expected, min(one, other) / (end - begin))
                ratio = math.log((inside + PRIOR) / (expected + of_others + PRIOR))
                gain[c] = free[k, c] * (ratio + math.log(2.0)) - 2.0 * square[k, c] - EACH
            total, begin, end = best_stretch(gain)
            if total > best:
                best, first, last, tube = total, begin, end, k
        if best <= 0.0:
            return result
        result = (best, tube, low + first * cell, low + last * cell)
        more = max(last - first, 2 * MARGIN) * cell
        if not grows or cells >= CELLS or (first >= GROWN and last <= cells - GROWN):
            return result
        low, high = low - more * (first < GROWN), high + more * (last > cells - GROWN)


@njit(cache=True, nogil=True)
def axis_near(cloud, point, axis, low, high, reach):
    """Mean and principal axis of the free points within ``reach`` of a line."""
    found, total, mean = near_line(cloud, point, axis, low, high, reach), 0.0, np.zeros(3)
    for i in range(found):
        q = cloud.found[i]
        if cloud.owner[q] < 0:
            total += cloud.weight[q]
            mean += cloud.weight[q] * cloud.point[q]
    if total <= 0.0:
        return point, axis
    mean /= total
    covariance = np.zeros((3, 3))
    for i in range(found):
        q = cloud.found[i]
        if cloud.owner[q] < 0:
            x = cloud.point[q] - mean
            for r in range(3):
                for s in range(3):
                    covariance[r, s] += cloud.weight[q] * x[r] * x[s]
    new = np.linalg.eigh(covariance)[1][:, 2].copy()
    return mean, new * np.sign((new * axis).sum())


@njit(cache=True, nogil=True)
def candidates(cloud, tubes, seeds, near, far, partners):
    """For each seed, the best of some lines through it and a partner between ``near`` and ``far`` from it: points
    ``(S, 3)``, axes ``(S, 3)``, gains ``(S,)``. Partners are drawn by a linear congruential generator."""
    points, axes, gains = np.zeros((len(seeds), 3)), np.zeros((len(seeds), 3)), np.zeros(len(seeds))
    pool, begin, end = np.empty(POOL, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64)
    factor, more = np.uint64(6364136223846793005), np.uint64(1442695040888963407)
    for i in range(len(seeds)):
        seed = seeds[i]
        state = np.uint64(seed) * factor + more
        for x in range(3):
            begin[x] = max(0, int((cloud.point[seed, x] - far - cloud.low[x]) // cloud.edge))
            end[x] = min(cloud.shape[x] - 1, int((cloud.point[seed, x] + far - cloud.low[x]) // cloud.edge))
        seen = beside = 0
        for a in range(begin[0], end[0] + 1):
            for b in range(begin[1], end[1] + 1):
                row = (a * cloud.shape[1] + b) * cloud.shape[2]
                for q in range(cloud.first[row + begin[2]], cloud.first[row + end[2] + 1]):
                    x, y, z = cloud.point[q] - cloud.point[seed]
                    squared = x * x + y * y + z * z
                    beside += squared < near * near
                    if cloud.owner[q] < 0 and near * near <= squared <= far * far:
                        state = state * factor + more
                        place = seen if seen < len(pool) else np.int64(state >> np.uint64(33)) % (seen + 1)
                        seen += 1
                        if place < len(pool):
                            pool[place] = q
        for _ in range(partners if seen > 0 and beside >= POINTS_MIN else 0):
            state = state * factor + more
            q = pool[np.int64(state >> np.uint64(33)) % min(seen, len(pool))]
            axis = cloud.point[q] - cloud.point[seed]
            length = math.sqrt((axis * axis).sum())
            axis, middle = axis / length, 0.5 * (cloud.point[q] + cloud.point[seed])
            if near_line(cloud, middle, axis, -length, length, tubes.radius[-1]) < POINTS_MIN:
                continue
            half = math.ceil(0.5 * length / tubes.cell + 2 * MARGIN) * tubes.cell
            gain = gain_along(cloud, tubes, middle, axis, half, True)[0]
            if gain > gains[i]:
                points[i], axes[i], gains[i] = middle, axis, gain
    return points, axes, gains


@dataclass(eq=False)
class TubeSearch:
    """The search for the lines of a cloud. ``lines``: those found, None for those that were joined or dropped;
    ``members``: the points of each; ``tails``: its points and their expected numbers in `SortedCloud.tail`."""

    cloud: SortedCloud
    tubes: Tubes
    cost: float
    lines: list[Found | None] = field(default_factory=list)
    members: list[IntArray] = field(default_factory=list)
    tails: list[tuple[IntArray, Array]] = field(default_factory=list)

    @classmethod
    def of(cls, points: Array, radius: float, cell: float | None, cost: float) -> "TubeSearch":
        """That of a cloud ``(N, 3)``. Where points are closer together than the radius of the narrowest tube, metres,
        those in a voxel of that edge count once."""
        points = np.asarray(points, dtype=np.float64)
        weight = np.ones(len(points))
        if len(points) and spacing(points, NEIGHBOUR) < radius:
            cells = np.floor((points - points.min(axis=0)) / radius).astype(np.int64)
            order = np.lexsort(cells.T)
            first = np.flatnonzero(np.append(True, np.any(np.diff(cells[order], axis=0) != 0, axis=1)))
            weight = np.diff(np.append(first, len(points))).astype(float)
            points = np.add.reduceat(points[order], first) / weight[:, None]
        tubes = Tubes(radius * np.array(WIDTHS), cell or 2.0 * radius)
        return cls(SortedCloud.of(points, weight, SHELL * radius), tubes, cost)

    @property
    def alive(self) -> list[int]:
        """Numbers of the lines, the best first."""
        gain = {k: line.gain for k, line in enumerate(self.lines) if line is not None}
        return sorted(gain, key=lambda k: -gain[k])

    def line(self, number: int) -> Found:
        found = self.lines[number]
        assert found is not None
        return found

    def along(self, point: Array, axis: Array, half: float, grows: bool = True) -> Found:
        """The best stretch of a line around a point, sought within ``half`` metres of it."""
        half = max(1, math.ceil(half / self.tubes.cell)) * self.tubes.cell
        return Found(point, axis, *gain_along(self.cloud, self.tubes, point, axis, half, grows))

    def anew(self, line: Found) -> float:
        """The gain of a line as it is, with what is free now."""
        return self.along(line.middle, line.axis, 0.5 * line.length, grows=False).gain

    def fitted(self, line: Found) -> Found:
        """The line, moved to the principal axis of its points until it gains no more."""
        while line.gain > 0.0:
            reach = FIT * self.tubes.radius[line.tube]
            point, axis = axis_near(self.cloud, line.point, line.axis, line.low, line.high, reach)
            new = self.along(point, axis, 0.5 * line.length + MARGIN * self.tubes.cell)
            if new.gain <= SETTLED * line.gain:
                return max(new, line, key=lambda each: each.gain)
            line = new
        return line

    def near(self, line: Found, margin: float, reach: float) -> IntArray:
        """Points within ``reach`` of a line that extends by a margin."""
        low, high = line.low - margin, line.high + margin
        return self.cloud.found[: near_line(self.cloud, line.point, line.axis, low, high, reach)].copy()

    def take(self, line: Found, number: int | None = None) -> None:
        """Add a line, or replace that of a number: the free points in its tube are its own."""
        radius, narrowest = self.tubes.radius[line.tube], self.tubes.radius[0]
        own = self.near(line, 0.5 * self.tubes.cell, radius)
        own = own[self.cloud.owner[own] < 0]
        beside = self.near(line, radius, SHELL * radius)
        offset = self.cloud.point[beside] - line.point
        aside = np.sqrt(np.maximum((offset**2).sum(axis=1) - (offset @ line.axis) ** 2, 0.0))
        usual = self.cloud.weight[own].sum() / max(line.length / self.tubes.cell, 1.0) * (narrowest / radius) ** 2
        tail = beside, usual * np.maximum(aside / radius, 1.0) ** -TAIL
        if number is None:
            number = len(self.lines)
            self.lines.append(line)
            self.members.append(own)
            self.tails.append(tail)
        self.lines[number], self.members[number], self.tails[number] = line, own, tail
        self.mark(number, is_known=True)

    def mark(self, number: int, is_known: bool) -> None:
        """Make the points of a line its own, or free."""
        self.cloud.owner[self.members[number]] = number if is_known else -1
        points, expected = self.tails[number]
        self.cloud.tail[points] += expected if is_known else -expected

    def drop(self, number: int) -> None:
        """Forget a line, whose points are free."""
        self.lines[number] = None

    def sweep(self, turn: int) -> int:
        """Take the best line through the seeds, and so on; returns the number of new lines."""
        cloud, tubes, before = self.cloud, self.tubes, len(self.lines)
        free = np.flatnonzero(cloud.owner < 0)
        cell = np.floor((cloud.point[free] - cloud.low) / (SEED_EDGE * tubes.radius[0])).astype(np.int64)
        order = np.lexsort(((free * 2654435761 + turn * 40503) % 2**32, *cell.T))
        seeds = free[order[np.append(True, np.any(np.diff(cell[order], axis=0) != 0, axis=1))[: len(free)]]]
        near, far = NEAR * tubes.radius[0], FAR * tubes.radius[0]
        points, axes, gains = candidates(cloud, tubes, seeds, near, far, PARTNERS)
        heap = [(-gain, k) for k, gain in enumerate(gains.tolist()) if gain > PROMISE * self.cost]
        heapq.heapify(heap)
        while heap:
            k = heapq.heappop(heap)[1]
            line = self.along(points[k], axes[k], near + MARGIN * tubes.cell)
            if heap and PROMISE * self.cost <= line.gain < -AS_GOOD * heap[0][0]:
                heapq.heappush(heap, (-line.gain, k))
            elif line.gain >= PROMISE * self.cost and (line := self.fitted(line)).gain >= self.cost:
                self.take_straight(line)
        return len(self.lines) - before

    def take_straight(self, line: Found, depth: int = 0) -> None:
        """Take a line, or two that meet in a bend."""
        pieces = self.bent(line) if depth < BENDS else []
        for piece in pieces:
            if piece.gain >= self.cost:
                self.take_straight(piece, depth + 1)
        if not pieces:
            self.take(line)

    def bent(self, line: Found) -> list[Found]:
        """Two lines that meet in a bend, if they explain the points of a line better by more than the cost of one: by
        n log σ² across it, where their noise σ is at least a quarter of the tube. Else none."""
        own = self.near(line, 0.0, BEND_REACH * self.tubes.radius[line.tube])
        own = own[self.cloud.owner[own] < 0]
        if len(own) < 2 * POINTS_MIN:
            return []
        offset, weight = self.cloud.point[own] - line.point, self.cloud.weight[own]
        along = offset @ line.axis
        order = np.argsort(along, kind="stable")
        offset, weight, along = offset[order], weight[order], along[order]
        product = np.einsum("ni,nj->nij", offset, offset).reshape(-1, 9)
        terms = weight[:, None] * np.column_stack([np.ones(len(own)), offset, product])
        sums, floor = np.cumsum(terms, axis=0), (BEND_NOISE * self.tubes.radius[0]) ** 2

        def fit(total: Array) -> tuple[Array, Array, float]:
            mean = total[1:4] / total[0]
            value, vector = np.linalg.eigh(total[4:].reshape(3, 3) / total[0] - np.outer(mean, mean))
            axis = vector[:, 2] * np.sign(vector[:, 2] @ line.axis)
            return mean, axis, math.log(max(0.5 * (value[0] + value[1]), 0.0) + floor)

        whole, most, best = fit(sums[-1])[2], self.cost, None
        for share in np.arange(1, BEND_PLACES) / BEND_PLACES:
            place = line.low + share * line.length
            k = int(np.searchsorted(along, place))
            if (
                min(k, len(own) - k) >= POINTS_MIN
                and min(share, 1 - share) * line.length >= BEND_CELLS * self.tubes.cell
            ):
                one, two = fit(sums[k - 1]), fit(sums[-1] - sums[k - 1])
                gain = len(own) * whole - k * one[2] - (len(own) - k) * two[2]
                if gain > most:
                    most, best = gain, (place, one, two)
        if best is None:
            return []
        place, one, two = best
        angle = math.acos(min(1.0, float(one[1] @ two[1])))
        rise = math.sin(angle) * min(place - line.low, line.high - place)
        if not BEND_RAD[0] < angle < BEND_RAD[1] or rise < self.tubes.radius[0]:
            return []
        pieces = []
        for (mean, axis, _), low, high in ((one, line.low, place), (two, place, line.high)):
            middle = line.point + mean + (0.5 * (low + high) - mean @ line.axis) * axis
            pieces.append(self.along(middle, axis, 0.5 * (high - low + self.tubes.cell), grows=False))
        return pieces

    def polish(self, tried: set[tuple[int, int]]) -> None:
        """Fit each line anew among what the others leave, drop those that gain too little, and join pieces."""
        for k in self.alive:
            line = self.line(k)
            self.mark(k, is_known=False)
            new = self.fitted(self.along(line.middle, line.axis, 0.5 * line.length + MARGIN * self.tubes.cell))
            if new.gain >= self.cost:
                self.take(new, k)
            elif self.anew(line) >= self.cost:
                self.mark(k, is_known=True)
            else:
                self.drop(k)
        joined = True
        while joined:
            joined = False
            for one, other in itertools.combinations(self.alive, 2):
                if (one, other) not in tried and self.may_be_one(one, other):
                    tried.add((one, other))
                    joined |= self.join(one, other)

    def may_be_one(self, one: int, other: int) -> bool:
        """Whether both lines are there, almost parallel, and one begins near the axis of the other."""
        line, piece = self.lines[one], self.lines[other]
        if line is None or piece is None or abs(line.axis @ piece.axis) < math.cos(MERGE_RAD):
            return False
        offset = piece.ends - line.point
        along = offset @ line.axis
        aside = np.linalg.norm(offset - along[:, None] * line.axis, axis=1)
        gap = max(along.min() - line.high, line.low - along.max())
        return bool(aside.min() <= SHELL * self.tubes.radius[0] and gap <= MERGE_GAP * self.tubes.radius[0])

    def join(self, one: int, other: int) -> bool:
        """Replace two lines by one through the points of both, if that gains as much less the cost of a line."""
        apart = 0.0
        for k in (one, other):
            self.mark(k, is_known=False)
            apart += self.anew(self.line(k))
            self.mark(k, is_known=True)
        for k in (one, other):
            self.mark(k, is_known=False)
        both = np.concatenate([self.members[one], self.members[other]])
        weight = self.cloud.weight[both]
        mean = weight @ self.cloud.point[both] / weight.sum()
        offset = self.cloud.point[both] - mean
        axis = np.linalg.eigh((weight[:, None] * offset).T @ offset)[1][:, 2]
        low, high = (offset @ axis).min(), (offset @ axis).max()
        half = 0.5 * (high - low) + MARGIN * self.tubes.cell
        line = self.fitted(self.along(mean + 0.5 * (low + high) * axis, axis, half))
        if line.gain >= max(self.cost, apart - self.cost) and not self.bent(line):
            self.take(line, one)
            self.drop(other)
            return True
        for k in (one, other):
            self.mark(k, is_known=True)
        return False

    def found(self) -> tuple[Segments, Array]:
        """The bars, the best first, and what each gains ``(B,)``, nats (`COST`)."""
        found = [(self.line(k), self.members[k]) for k in self.alive]
        ends = np.array([line.between(self.cloud.point[own]).ends for line, own in found]).reshape(-1, 2, 3)
        count = np.array([self.cloud.weight[own].sum() for _, own in found], dtype=np.int64)
        width = np.array([self.tubes.radius[line.tube] for line, _ in found])
        return Segments(ends[:, 0], ends[:, 1], count, width), np.array([line.gain for line, _ in found])

    def gains_of(self, bars: Segments) -> tuple[Array, Array]:
        """What each of some bars gains beside the others, and how much of it each of its points: ``(B,)`` and ``(B,)``,
        nats. They replace the lines of the search."""
        for k in self.alive:
            self.mark(k, is_known=False)
        self.lines, self.members, self.tails = [], [], []
        gain, each = np.zeros(len(bars)), np.zeros(len(bars))
        for middle, axis, length in zip(bars.middle, bars.direction, bars.length, strict=True):
            self.take(self.along(middle, axis, 0.5 * length, grows=False))
        for k, (middle, axis, length) in enumerate(zip(bars.middle, bars.direction, bars.length, strict=True)):
            self.mark(k, is_known=False)
            line = self.along(middle, axis, 0.5 * length, grows=False)
            own = self.near(line, 0.0, self.tubes.radius[line.tube])
            gain[k], count = line.gain, np.count_nonzero(self.cloud.owner[own] < 0)
            each[k] = line.gain / count if count else 0.0
            self.mark(k, is_known=True)
        return gain, each

    def run(self) -> None:
        """Sweep until two in a row find nothing, polish, and search once more what that has set free."""
        tried = set[tuple[int, int]]()
        for sweeps in (SWEEPS, LAST_SWEEPS):
            idle = 0
            for turn in range(sweeps):
                idle = 0 if self.sweep(turn) else idle + 1
                if idle == IDLE:
                    break
            self.polish(tried)


def find_tubes(points: Array, radius: float, cell: float | None = None, cost: float = COST) -> TubeSearch:
    """Search a cloud for its bars (`TubeSearch.found`).

    ``points (N, 3)``: metres, any frame, finite, without surfaces. ``radius``: that of the narrowest tube. ``cell``:
    length of the cells along it, by default twice the radius.
    """
    search = TubeSearch.of(points, radius, cell, cost)
    search.run()
    return search
