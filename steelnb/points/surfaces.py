"""Surfaces of a cloud: ground, walls, decks and roofs, where points cover a plane over much more than a bar's width."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray
from steelnb.points.moments import eigen
from steelnb.points.voxel_kernels import find, hash_table, offsets_within
from steelnb.points.voxel_map import VoxelMap

DISC = 3.5
"""Radius, in cells, of the disc that points must cover."""
COVERED_MIN = 0.7
"""Minimum share of the disc that is covered. Bars that meet at a joint of a lattice cover less than half of it."""
NEAR, ASIDE_MAX = 1.2, 0.3
"""Maximum distance, in cells, of points of a surface from it, and maximum share of those around that are farther."""
BAND = 1.5
"""Points within this many of the smallest cells of a surface belong to it; range noise spreads them."""
TURN_MAX_RAD = math.radians(15)
"""Maximum angle between the normals of neighbouring cells of one surface."""
NEW_MIN = 0.1
"""Minimum share of a surface in wider cells that narrower ones have not found."""
CELLS_MIN = 80
"""Minimum number of cells of a surface."""
COARSER, DENSE_MIN, CLEAR_VOXELS = (2, 4), 4, 3
"""See `surfaces_of`: wider cells, in multiples of the edge; number of points in a voxel of dense steel, or this part
of the usual one; and distance of what is sparse from it, in voxels, since range noise spreads points around a bar."""
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
    """The cells of all surfaces: edge ``cell_m (C,)`` and mean ``point (C, 3)``, metres, unit ``normal (C, 3)``, and
    number of the surface ``label (C,)``, those found first and the largest first."""

    cell_m: Array
    point: Array
    normal: Array
    label: IntArray

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
        mean, key = voxels.means(), voxels.keys()
        around = offsets_within(DISC * cell_m, cell_m)
        point, normal, inner = _local_planes(
            key, mean, cell_m, near_m or NEAR * cell_m, around, *hash_table(key, len(key))
        )
        point, normal = point[inner], normal[inner]
        if not inner.any():
            return cls(np.zeros(0), point, normal, np.zeros(0, dtype=np.int64))
        pair = cKDTree(point).query_pairs(2 * cell_m, output_type="ndarray")
        cosine = np.abs(np.einsum("pi,pi->p", normal[pair[:, 0]], normal[pair[:, 1]]))
        pair = pair[cosine > math.cos(TURN_MAX_RAD)]
        n = len(point)
        _, group = connected_components(coo_array((np.ones(len(pair)), tuple(pair.T)), shape=(n, n)), directed=False)
        size = np.bincount(group)
        rank = np.empty(len(size), dtype=np.int64)
        rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
        large = size[group] >= CELLS_MIN
        return cls(np.full(large.sum(), cell_m), point[large], normal[large], rank[group[large]])

    def extended(self, points: Array, cell_m: float, near_m: float, only_level: bool = False) -> "Surfaces":
        """These, and those in a sparser cloud ``(N, 3)`` with wider cells of which `NEW_MIN` or more is new, all or the
        level ones. They replace the surfaces whose greater part they cover."""
        wide = Surfaces.found_in(points, cell_m, near_m)
        if only_level:
            wide = wide._with(wide._share_of(np.abs(wide.normal[:, 2]) > math.cos(LEVEL_RAD)) > 0.5)
        wide = wide._with(wide._share_of(self.label_of(wide.point) < 0) >= NEW_MIN)
        kept = self._with(self._share_of(wide.label_of(self.point) >= 0) < 0.5)
        pairs = [(getattr(kept, name), getattr(wide, name)) for name in ("cell_m", "point", "normal")]
        cell, point, normal = map(np.concatenate, pairs)
        return Surfaces(cell, point, normal, np.concatenate([kept.label, wide.label + len(kept)]))

    def _share_of(self, is_so: NDArray[np.bool_]) -> Array:
        """Share of the cells of each surface for which ``is_so (C,)``."""
        return np.bincount(self.label, is_so, len(self)) / np.maximum(np.bincount(self.label, minlength=len(self)), 1)

    def _with(self, chosen: NDArray[np.bool_]) -> "Surfaces":
        """The ``chosen (S,)`` surfaces."""
        cell = chosen[self.label]
        label = (np.cumsum(chosen) - 1)[self.label[cell]]
        return Surfaces(self.cell_m[cell], self.point[cell], self.normal[cell], label)

    def __len__(self) -> int:
        return int(self.label.max(initial=-1)) + 1

    def label_of(self, points: Array) -> IntArray:
        """Number ``(N,)`` of the surface that each point ``(N, 3)`` lies on, or −1."""
        label = np.full(len(points), -1, dtype=np.int64)
        if len(self.point) and len(points):
            reach_m = (DISC + 0.5) * self.cell_m
            distance, nearest = cKDTree(self.point).query(points, distance_upper_bound=float(reach_m.max()))
            near = np.flatnonzero(np.isfinite(distance))
            near = near[distance[near] < reach_m[nearest[near]]]
            cell = nearest[near]
            off = np.abs(np.einsum("ni,ni->n", points[near] - self.point[cell], self.normal[cell]))
            on = off <= BAND * self.cell_m.min()
            label[near[on]] = self.label[cell[on]]
        return label

    def described(self, label: IntArray) -> list[Surface]:
        """Each surface, with its number of the points whose surfaces are ``label (N,)``."""
        found, count = [], np.bincount(label[label >= 0], minlength=len(self))
        for k in range(len(self)):
            cells, cell_m = self.point[self.label == k], float(self.cell_m[self.label == k][0])
            centre = cells.mean(axis=0)
            value, vector = np.linalg.eigh((cells - centre).T @ (cells - centre) / len(cells))
            seen = np.floor((cells - centre) @ vector[:, 1:] / cell_m).astype(np.int64)
            area_m2 = len(np.unique(seen, axis=0)) * cell_m**2
            found.append(Surface(centre, vector[:, 0], area_m2, math.sqrt(max(value[0], 0.0)), int(count[k])))
        return found


def surfaces_of(voxels: VoxelMap, ridge: Array, cell_m: float) -> Surfaces:
    """The surfaces of a cloud: in its ridges, and in wider cells in what is sparse and off dense steel. Ground that is
    sampled more sparsely than the steel has gaps, and its points lie along many lines. Level surfaces are sought in the
    whole cloud, too: if its density varies, ground may be as dense as steel elsewhere. Towers of few points have faces
    with the look of walls, but no floors."""
    found, thin, weight = Surfaces.found_in(ridge, cell_m), voxels.means(), voxels.weights()
    ordered = np.sort(weight)
    usual = ordered[np.searchsorted(np.cumsum(ordered), weight.sum() / 2)]  # half of the points lie in fuller voxels
    label, is_dense = found.label_of(thin), weight >= min(DENSE_MIN, usual / DENSE_MIN)
    steel = thin[is_dense & (label < 0)]
    is_sparse = ~is_dense
    if len(steel):
        distance = cKDTree(steel).query(thin[is_sparse], distance_upper_bound=CLEAR_VOXELS * voxels.voxel_m)[0]
        is_sparse[is_sparse] = np.isinf(distance)
    for wider in COARSER:
        found = found.extended(thin[is_sparse | (label >= 0)], wider * cell_m, NEAR * cell_m)
        found = found.extended(thin, wider * cell_m, NEAR * cell_m, only_level=True)
        label = found.label_of(thin)
    return found


@njit(cache=True, nogil=True)
def _local_planes(centre, mean, cell, reach, around, key, slot):  # type: ignore[no-untyped-def]
    """Plane through the cells around each cell: a point of it ``(M, 3)``, its normal ``(M, 3)``, and whether it is
    covered ``(M,)`` by those within ``reach`` of it."""
    count = len(centre)
    point, normal, inner = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    others, is_covered = np.empty(len(around), np.int64), np.zeros(64, np.bool_)
    full = math.pi * DISC * DISC
    for n in range(count):
        found = 0
        sx = sy = sz = 0.0
        for k in range(len(around)):
            other = find(centre[n] + around[k], key, slot)
            if other >= 0:
                others[found] = other
                found += 1
                sx += mean[other, 0] - mean[n, 0]
                sy += mean[other, 1] - mean[n, 1]
                sz += mean[other, 2] - mean[n, 2]
        if found < COVERED_MIN * full:
            continue
        sx, sy, sz = mean[n, 0] + sx / found, mean[n, 1] + sy / found, mean[n, 2] + sz / found
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
        nx, ny, nz = small[1], small[2], small[3]
        ux, uy, uz = large[1], large[2], large[3]
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        is_covered[:] = False
        near = 0
        for k in range(found):
            x, y, z = mean[others[k], 0] - sx, mean[others[k], 1] - sy, mean[others[k], 2] - sz
            if abs(x * nx + y * ny + z * nz) <= reach:
                near += 1
                # Cells of the disc, seen along the normal: 8 x 8 of them.
                i = math.floor((x * ux + y * uy + z * uz) / cell) + 4
                j = math.floor((x * vx + y * vy + z * vz) / cell) + 4
                if 0 <= i < 8 and 0 <= j < 8:
                    is_covered[8 * i + j] = True
        point[n, 0], point[n, 1], point[n, 2] = sx, sy, sz
        normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
        inner[n] = is_covered.sum() >= COVERED_MIN * full and found - near <= ASIDE_MAX * near
    return point, normal, inner
