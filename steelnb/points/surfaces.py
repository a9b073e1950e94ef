"""Surfaces of a cloud: ground, walls, decks and roofs, where points cover a plane over much more than a bar's width.

In this order: the cells that lie on a covered plane (`local_planes`), the lines in which a scanner samples a surface
(`line_directions`), the surfaces as connected cells (`Surfaces`), and the search for those of a whole cloud, however
densely each is sampled (`surfaces_of`). A spinning scanner leaves rings on the ground and rows on walls, between which
there may be metres.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.geometry import connected
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.filters import voxel_grid
from steelnb.points.kdtree import advance, columns_of, gather
from steelnb.points.moments import eigen
from steelnb.points.voxel_map import VoxelMap, offsets_within, pack

DISC = 3.5
"""Radius, in cells, of the disc that points must cover."""
COVERED_MIN = 0.7
"""Minimum share of the disc that is covered. Bars that meet at a joint of a lattice cover less than half of it."""
ASIDE_MAX = 0.3
"""Maximum share of the points around a cell of a surface that are farther from it than those near it."""


@njit(cache=True, nogil=True)
def local_planes(key, mean, cell, reach, around):  # type: ignore[no-untyped-def]
    """Plane through the cells around each cell: a point of it ``(M, 3)``, its normal ``(M, 3)``, and whether it is
    covered ``(M,)`` by those within ``reach`` of it. These alone determine a covered plane: steel stands on ground. The
    keys of the cells are sorted; ``around``: `Columns`."""
    count = len(key)
    point, normal, inner = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    first, last = np.zeros(len(around.low), np.int64), np.zeros(len(around.low), np.int64)
    at, others = np.full(len(around.place), -1), np.empty(len(around.place), np.int64)
    is_covered, full = np.zeros(64, np.bool_), math.pi * DISC * DISC
    for n in range(count):
        if advance(key, n, around, first, last) < COVERED_MIN * full:
            continue
        found = gather(key, n, around, first, last, at, others)
        sx, sy, sz, nx, ny, nz, ux, uy, uz = _plane(mean, n, others[:found])
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        is_covered[:] = False
        near = 0
        for k in range(found):
            x, y, z = mean[others[k], 0] - sx, mean[others[k], 1] - sy, mean[others[k], 2] - sz
            if abs(x * nx + y * ny + z * nz) <= reach:
                others[near] = others[k]
                near += 1
                # Cells of the disc, seen along the normal: 8 x 8 of them.
                i = math.floor((x * ux + y * uy + z * uz) / cell) + 4
                j = math.floor((x * vx + y * vy + z * vz) / cell) + 4
                if 0 <= i < 8 and 0 <= j < 8:
                    is_covered[8 * i + j] = True
        inner[n] = is_covered.sum() >= COVERED_MIN * full and found - near <= ASIDE_MAX * near
        if inner[n] and near < found:
            sx, sy, sz, nx, ny, nz, _, _, _ = _plane(mean, n, others[:near])
        point[n, 0], point[n, 1], point[n, 2] = sx, sy, sz
        normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
    return point, normal, inner


@njit(cache=True, nogil=True)
def _plane(mean, centre, others):  # type: ignore[no-untyped-def]
    """Plane through some of the points, which lie around the ``centre``: their mean, its normal and the direction in
    which they extend farthest."""
    found = len(others)
    sx = sy = sz = 0.0
    for k in range(found):
        sx += mean[others[k], 0] - mean[centre, 0]
        sy += mean[others[k], 1] - mean[centre, 1]
        sz += mean[others[k], 2] - mean[centre, 2]
    sx, sy, sz = mean[centre, 0] + sx / found, mean[centre, 1] + sy / found, mean[centre, 2] + sz / found
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(found):
        x, y, z = mean[others[k], 0] - sx, mean[others[k], 1] - sy, mean[others[k], 2] - sz
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    small, _, large = eigen(xx / found, xy / found, xz / found, yy / found, yz / found, zz / found)
    return sx, sy, sz, small[1], small[2], small[3], large[1], large[2], large[3]


POINTS_MAX, AROUND_MAX, LINES_MIN = 2000, 12, 20
"""Maximum number of points at which the direction is measured, and of points around each; and minimum number of those
that lie along a line."""
FLAT_MAX = 0.1
"""Maximum ratio of the variances across and along a line."""
BINS, SIDE_BINS, STRONGEST = 36, 4, 4
"""Number of bins of 180°; of those to each side of the direction of rows, which curve; and of the strongest directions
of a lattice, each of three bins: chords, struts and two diagonals."""


def line_directions(points: Array, normal: Array, radius_m: float) -> Array:
    """Numbers of lines in a plane by their direction ``(BINS,)``, over 180°; all 0 if there are fewer than `LINES_MIN`.

    ``points (N, 3)``, metres, in the plane with the unit ``normal (3,)``. A line is counted at a point if those within
    ``radius_m`` of it lie along one.
    """
    if len(points) < LINES_MIN:
        return np.zeros(BINS)
    u, v = np.linalg.svd(normal[None, :])[2][1:]
    flat = points @ np.column_stack([u, v])
    some = flat[:: -(-len(flat) // POINTS_MAX)]
    distance, near = cKDTree(flat).query(some, min(AROUND_MAX, len(flat)), distance_upper_bound=radius_m)
    inside = np.isfinite(distance)
    offset = np.where(inside[..., None], flat[np.where(inside, near, 0)] - some[:, None], 0.0)
    count = inside.sum(axis=1)
    x, y = np.moveaxis((offset - (offset.sum(axis=1) / count[:, None])[:, None]) * inside[..., None], -1, 0)
    xx, xy, yy = (x * x).sum(axis=1), (x * y).sum(axis=1), (y * y).sum(axis=1)
    root = np.hypot(0.5 * (xx - yy), xy)
    is_line = (count > 3) & (0.5 * (xx + yy) - root < FLAT_MAX * (0.5 * (xx + yy) + root))
    if np.count_nonzero(is_line) < LINES_MIN:
        return np.zeros(BINS)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[is_line] % math.pi
    return np.bincount((angle / math.pi * BINS).astype(np.int64) % BINS, minlength=BINS).astype(float)


def share_of_rows(lines: Array) -> float:
    """Share of the lines ``(BINS,)`` within `SIDE_BINS` of the strongest direction; 0 without lines."""
    around = sum(np.roll(lines, shift) for shift in range(-SIDE_BINS, SIDE_BINS + 1))
    return float(np.max(around) / max(lines.sum(), 1.0))


def share_of_lattice(lines: Array) -> float:
    """Share of the lines ``(BINS,)`` in the `STRONGEST` directions; 1 without lines."""
    left, total = lines.copy(), lines.sum()
    for _ in range(STRONGEST):
        best = int((left + np.roll(left, 1) + np.roll(left, -1)).argmax())
        left[[best - 1, best, (best + 1) % BINS]] = 0.0
    return float(1.0 - left.sum() / total) if total else 1.0


NEAR = 1.2
"""Maximum distance, in cells, of points of a surface from it."""
BAND = 1.5
"""Points within this many of the smallest cells of a surface belong to it; range noise spreads them."""
TURN_MAX_RAD = math.radians(15)
"""Maximum angle between the normals of neighbouring cells of one surface."""
BESIDE = 2.5
"""Points within this many cells of a surface's cell, and in its band, belong to it. Covered discs end one to two cells
before its rim."""
STEP, RISE_MAX = 1.2, 0.4
"""How far apart cells are that continue a surface, in cells, and maximum distance of a cell from the plane at the step
before, as a share of the band. A member beside a deck is off its plane or behind a gap."""
NEW_MIN = 0.1
"""Minimum share of a surface in wider cells that narrower ones have not found."""
CELLS_MIN = 80
"""Minimum number of cells of a surface."""
LEVEL_RAD = math.radians(30)
"""Maximum slope of a level surface."""


@dataclass(frozen=True)
class Surface:
    """A connected surface: mean of its cells ``centre (3,)``, metres, unit ``normal (3,)`` of its plane, its area in
    that plane, root mean square distance ``rms_m`` of its cells from it, and its number of ``points`` in the cloud."""

    centre: Array
    normal: Array
    area_m2: float
    rms_m: float
    points: int

    @property
    def is_level(self) -> bool:
        """Whether it slopes by less than `LEVEL_RAD`."""
        return abs(float(self.normal[2])) > math.cos(LEVEL_RAD)

    def scaled(self, scale: float) -> "Surface":
        """The same with all lengths multiplied."""
        return replace(self, centre=scale * self.centre, area_m2=scale**2 * self.area_m2, rms_m=scale * self.rms_m)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The cells of all surfaces: edge ``cell_m (C,)`` and mean ``point (C, 3)``, metres, unit ``normal (C, 3)``,
    ``reach_m (C,)``, how far past the cell its surface continues, and number of the surface ``label (C,)``, those in
    narrow cells first. Points within ``band_m`` of a surface belong to it."""

    cell_m: Array
    point: Array
    normal: Array
    reach_m: Array
    label: IntArray
    band_m: float

    @classmethod
    def found_in(cls, points: Array, cell_m: float, near_m: float | None = None) -> "Surfaces":
        """The surfaces of a finite cloud ``(N, 3)``, metres. Its points should be at most a cell apart, and their
        noise less than a cell.

        A cell lies on a surface if the points around it cover `COVERED_MIN` of a disc of `DISC` cells, and few are
        farther from its plane than ``near_m``, by default `NEAR` cells. Cells with similar normals are connected;
        `CELLS_MIN` of them or more are a surface.
        """
        voxels = VoxelMap(cell_m)
        voxels.insert(points)
        order = np.argsort(voxels.keys(), kind="stable")
        around = columns_of(offsets_within(DISC * cell_m, cell_m))
        near_m = near_m or NEAR * cell_m
        point, normal, inner = local_planes(voxels.keys()[order], voxels.means(order), cell_m, near_m, around)
        as_inserted = np.argsort(order[inner], kind="stable")
        point, normal, band_m = point[inner][as_inserted], normal[inner][as_inserted], BAND / NEAR * near_m
        if not inner.any():
            return cls(np.zeros(0), point, normal, np.zeros(0), np.zeros(0, dtype=np.int64), band_m)
        pair = cKDTree(point).query_pairs(2 * cell_m, output_type="ndarray")
        cosine = np.abs(np.einsum("pi,pi->p", normal[pair[:, 0]], normal[pair[:, 1]]))
        pair = pair[cosine > math.cos(TURN_MAX_RAD)]
        group = connected(pair, len(point))
        size = np.bincount(group)
        rank = np.empty(len(size), dtype=np.int64)
        rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
        large = size[group] >= CELLS_MIN
        cell = np.full(large.sum(), cell_m)
        return cls(cell, point[large], normal[large], BESIDE * cell, rank[group[large]], band_m)

    def grown(self, points: Array, steps: IntArray) -> "Surfaces":
        """These, continued to their rims: cells of a cloud ``(N, 3)`` that lie next to each other, each in the plane of
        the one before. ``steps (S,)``: maximum number of such cells in a row for each surface."""
        if not len(self.point):
            return self
        rest, parts, edge = voxel_grid(points, float(self.cell_m.min())), [self], self
        for done in range(int(steps.max())):
            if not len(edge.point) or not len(rest):
                break
            far_m = STEP * edge.cell_m
            distance, before = cKDTree(edge.point).query(rest, distance_upper_bound=float(far_m.max()))
            near = np.flatnonzero(distance < np.append(np.where(steps[edge.label] > done, far_m, 0.0), 0.0)[before])
            normal = edge.normal[before[near]]
            rise = np.einsum("ni,ni->n", rest[near] - edge.point[before[near]], normal)
            level = np.abs(rise) <= RISE_MAX * self.band_m
            near, rise, normal = near[level], rise[level, None], normal[level]
            cell_m, label = edge.cell_m[before[near]], edge.label[before[near]]
            edge = Surfaces(cell_m, rest[near] - rise * normal, normal, cell_m, label, self.band_m)
            parts.append(edge)
            rest = np.delete(rest, near, axis=0)
        return Surfaces._joined(parts)

    def extended(
        self,
        points: Array,
        cell_m: float,
        near_m: float,
        choose: "Callable[[Surfaces], NDArray[np.bool_]] | None" = None,
        new_min: float = NEW_MIN,
    ) -> "Surfaces":
        """These, and those in a sparser cloud ``(N, 3)`` with wider cells of which ``new_min`` or more is new, and that
        are chosen. They replace the surfaces whose greater part they cover."""
        wide = Surfaces.found_in(points, cell_m, near_m)
        wide = wide._with(wide._share_of(self.label_of(wide.point) < 0) >= new_min)
        if choose is not None:
            wide = wide._with(choose(wide))
        kept = self._with(self._share_of(wide.label_of(self.point) >= 0) < 0.5)
        return Surfaces._joined([kept, replace(wide, label=wide.label + len(kept))])

    @staticmethod
    def _joined(parts: "list[Surfaces]") -> "Surfaces":
        """The cells of all, with the band of the last."""
        names = ("cell_m", "point", "normal", "reach_m", "label")
        cell_m, point, normal, reach_m, label = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
        return Surfaces(cell_m, point, normal, reach_m, label, parts[-1].band_m)

    @property
    def is_level(self) -> NDArray[np.bool_]:
        """Whether most of each surface slopes by less than `LEVEL_RAD` ``(S,)``."""
        return np.asarray(self._share_of(np.abs(self.normal[:, 2]) > math.cos(LEVEL_RAD)) > 0.5)

    @property
    def cells(self) -> list[Array]:
        """The mean points of the cells of each surface, ``(C, 3)``."""
        return [self.point[self.label == k] for k in range(len(self))]

    def _share_of(self, is_so: NDArray[np.bool_]) -> Array:
        """Share of the cells of each surface for which ``is_so (C,)``."""
        return np.bincount(self.label, is_so, len(self)) / np.maximum(np.bincount(self.label, minlength=len(self)), 1)

    def _with(self, chosen: NDArray[np.bool_]) -> "Surfaces":
        """The ``chosen (S,)`` surfaces."""
        cell = chosen[self.label]
        label = (np.cumsum(chosen) - 1)[self.label[cell]]
        return Surfaces(self.cell_m[cell], self.point[cell], self.normal[cell], self.reach_m[cell], label, self.band_m)

    def __len__(self) -> int:
        return int(self.label.max(initial=-1)) + 1

    def label_of(self, points: Array) -> IntArray:
        """Number ``(N,)`` of the surface that each point ``(N, 3)`` lies on, or −1."""
        label, own_m = np.full(len(points), -1, dtype=np.int64), np.minimum(self.reach_m, BESIDE * self.cell_m)
        for reach_m in (own_m, np.where(self.reach_m > own_m, self.reach_m, 0.0)):
            cells, rest = np.flatnonzero(reach_m), np.flatnonzero(label < 0)
            if len(cells) and len(rest):
                reach_m = reach_m[cells]
                tree, far_m = cKDTree(self.point[cells]), float(reach_m.max())
                # Neighbours one after the other find their part of the tree in the cache.
                rest = rest[np.argsort(pack(*np.floor(points[rest] / far_m).astype(np.int64).T), kind="stable")]
                distance, nearest = tree.query(points[rest], distance_upper_bound=far_m)
                near = np.flatnonzero(distance < np.append(reach_m, 0.0)[nearest])
                cell, near = cells[nearest[near]], rest[near]
                off = np.abs(np.einsum("ni,ni->n", points[near] - self.point[cell], self.normal[cell]))
                on = off <= self.band_m
                label[near[on]] = self.label[cell[on]]
        return label

    def described(self, label: IntArray) -> list[Surface]:
        """Each surface, with its number of the points whose surfaces are ``label (N,)``."""
        found, count = [], np.bincount(label[label >= 0], minlength=len(self))
        for k, cells in enumerate(self.cells):
            cell_m = float(self.cell_m[self.label == k][0])
            centre = cells.mean(axis=0)
            value, vector = np.linalg.eigh((cells - centre).T @ (cells - centre) / len(cells))
            seen = np.floor((cells - centre) @ vector[:, 1:] / cell_m).astype(np.int64)
            area_m2 = len(np.unique(seen, axis=0)) * cell_m**2
            found.append(Surface(centre, vector[:, 0], area_m2, math.sqrt(max(value[0], 0.0)), int(count[k])))
        return found


COARSER, DENSE_MIN, CLEAR_VOXELS = (2, 4), 4, 3
"""See `surfaces_of`: wider cells, in multiples of the edge; number of points in a voxel of dense steel, or this part
of the usual one; and distance of what is sparse from it, in voxels, since range noise spreads points around a bar."""
RINGS, FEW, CONTINUED = (8, 16, 32), 0.02, 6.4
"""Cells in which ground is sought that was scanned in rings, in multiples of the edge; share of it that must be new,
and of the points that may lie below it; and how many times farther than other surfaces it continues past its cells."""
STEPS, GROUND_STEPS = 3, 9
"""Maximum number of cells by which a surface continues, and by which ground does, which is seen in strips and patches.
A member may continue a wall or a deck in its plane."""
RINGS_MAX, ROWS_MIN = 0.8, 0.97
"""Maximum share of the lines of rings in four directions, .4 to .6 for ground and 1 for a lattice; minimum share of
those on a wall in one direction. A direction is measured within `BESIDE` cells."""


def surfaces_of(voxels: VoxelMap, ridge: Array, cell_m: float) -> Surfaces:
    """The surfaces of a cloud: in its ridges, and in wider cells in what is sparse and off dense steel. Ground that is
    sampled more sparsely than the steel has gaps, and its points lie along many lines. Level surfaces are sought in the
    whole cloud, too: if its density varies, ground may be as dense as steel elsewhere. Towers of few points have faces
    with the look of walls, but no floors; a wall that was scanned in rows has lines in one direction. The lowest
    surface may have been scanned in rings: then its lines have all directions. All continue to their rims."""
    found, thin, weight = Surfaces.found_in(ridge, cell_m), voxels.means(), voxels.weights()
    ordered = np.sort(weight)
    usual = ordered[np.searchsorted(np.cumsum(ordered), weight.sum() / 2)]  # half of the points lie in fuller voxels
    label, is_dense = found.label_of(thin), weight >= min(DENSE_MIN, usual / DENSE_MIN)
    steel = thin[is_dense & (label < 0)]
    is_sparse = ~is_dense
    if len(steel):
        distance = cKDTree(steel).query(thin[is_sparse], distance_upper_bound=CLEAR_VOXELS * voxels.voxel_m)[0]
        is_sparse[is_sparse] = np.isinf(distance)

    def is_level_or_in_rows(wide: Surfaces) -> NDArray[np.bool_]:
        rows = _lines_off(wide, ~wide.is_level, found, thin, BESIDE * cell_m, share_of_rows)
        return wide.is_level | (rows >= ROWS_MIN)

    def is_ground_in_rings(wide: Surfaces) -> NDArray[np.bool_]:
        return _lines_off(wide, _is_ground(wide, thin), found, thin, BESIDE * cell_m, share_of_lattice) <= RINGS_MAX

    near_m = NEAR * cell_m
    for wider in COARSER:
        label = label if wider == COARSER[0] else found.label_of(thin)
        found = found.extended(thin[is_sparse | (label >= 0)], wider * cell_m, near_m)
        found = found.extended(thin, wider * cell_m, near_m, is_level_or_in_rows)
    for wider in RINGS:
        found = found.extended(thin, wider * cell_m, near_m, is_ground_in_rings, FEW)
    # Last, since what is sought in wider cells must be new.
    is_in_rings = found.cell_m > COARSER[-1] * cell_m
    found = replace(found, reach_m=np.where(is_in_rings, CONTINUED, 1.0) * found.reach_m)
    return found.grown(thin, np.where(_is_ground(found, thin), GROUND_STEPS, STEPS))


def _lines_off(
    wide: Surfaces,
    chosen: NDArray[np.bool_],
    known: Surfaces,
    points: Array,
    radius_m: float,
    share: Callable[[Array], float],
) -> Array:
    """A share of the lines ``(S,)`` along which the ``points (N, 3)`` on each ``chosen (S,)`` surface lie, without
    points on known surfaces; NaN for the other surfaces."""
    found = np.full(len(wide), np.nan)
    if not chosen.any():
        return found
    label, cells_of = np.where(known.label_of(points) < 0, wide.label_of(points), -1), wide.cells
    for k in np.flatnonzero(chosen).tolist():
        cells = cells_of[k]
        normal = np.linalg.svd(cells - cells.mean(axis=0), full_matrices=False)[2][2]
        found[k] = share(line_directions(points[label == k], normal, radius_m))
    return found


def _is_ground(surfaces: Surfaces, points: Array) -> NDArray[np.bool_]:
    """Whether each surface is level and the lowest ``(S,)``: at most `FEW` of the ``points (N, 3)`` lie below it,
    by more than twice its band."""
    is_ground, cells_of, height = surfaces.is_level, surfaces.cells, points[:, 2]
    for k in np.flatnonzero(is_ground).tolist():
        cells = cells_of[k]
        bound = cells[:, 2] - 2 * surfaces.band_m
        below, unsure = height < bound.min(), (height >= bound.min()) & (height < bound.max())
        count, most = np.count_nonzero(below), np.count_nonzero(below | unsure)
        if count / len(points) <= FEW < most / len(points):
            nearest = cKDTree(cells[:, :2]).query(points[unsure, :2])[1]
            count += np.count_nonzero(height[unsure] < bound[nearest])
        is_ground[k] = count / len(points) <= FEW
    return is_ground
