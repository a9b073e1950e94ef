"""Surfaces of a cloud: ground, walls, decks and roofs, where points cover a plane over much more than a bar's width."""

import math
from collections.abc import Callable
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
    ``reach_m (C,)``, how far past the cell its surface continues, and number of the surface ``label (C,)``, those found
    first and the largest first. Points within ``band_m`` of a surface belong to it."""

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
        mean, key = voxels.means(), voxels.keys()
        around = offsets_within(DISC * cell_m, cell_m)
        near_m = near_m or NEAR * cell_m
        point, normal, inner = _local_planes(key, mean, cell_m, near_m, around, *hash_table(key, len(key)))
        point, normal, band_m = point[inner], normal[inner], BAND / NEAR * near_m
        if not inner.any():
            return cls(np.zeros(0), point, normal, np.zeros(0), np.zeros(0, dtype=np.int64), band_m)
        pair = cKDTree(point).query_pairs(2 * cell_m, output_type="ndarray")
        cosine = np.abs(np.einsum("pi,pi->p", normal[pair[:, 0]], normal[pair[:, 1]]))
        pair = pair[cosine > math.cos(TURN_MAX_RAD)]
        n = len(point)
        _, group = connected_components(coo_array((np.ones(len(pair)), tuple(pair.T)), shape=(n, n)), directed=False)
        size = np.bincount(group)
        rank = np.empty(len(size), dtype=np.int64)
        rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
        large = size[group] >= CELLS_MIN
        cell = np.full(large.sum(), cell_m)
        return cls(cell, point[large], normal[large], (DISC + 0.5) * cell, rank[group[large]], band_m)

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
        pairs = [(getattr(kept, name), getattr(wide, name)) for name in ("cell_m", "point", "normal", "reach_m")]
        cell, point, normal, reach_m = map(np.concatenate, pairs)
        return Surfaces(cell, point, normal, reach_m, np.concatenate([kept.label, wide.label + len(kept)]), wide.band_m)

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
        label, own_m = np.full(len(points), -1, dtype=np.int64), (DISC + 0.5) * self.cell_m
        for reach_m in (own_m, np.where(self.reach_m > own_m, self.reach_m, 0.0)):
            cells, rest = np.flatnonzero(reach_m), np.flatnonzero(label < 0)
            if len(cells) and len(rest):
                reach_m = reach_m[cells]
                tree, far_m = cKDTree(self.point[cells]), float(reach_m.max())
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


@njit(cache=True, nogil=True)
def _local_planes(centre, mean, cell, reach, around, key, slot):  # type: ignore[no-untyped-def]
    """Plane through the cells around each cell: a point of it ``(M, 3)``, its normal ``(M, 3)``, and whether it is
    covered ``(M,)`` by those within ``reach`` of it. These alone determine a covered plane: steel stands on ground."""
    count = len(centre)
    point, normal, inner = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    others, is_covered = np.empty(len(around), np.int64), np.zeros(64, np.bool_)
    full = math.pi * DISC * DISC
    for n in range(count):
        found = 0
        for k in range(len(around)):
            other = find(centre[n] + around[k], key, slot)
            if other >= 0:
                others[found] = other
                found += 1
        if found < COVERED_MIN * full:
            continue
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
