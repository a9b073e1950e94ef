"""Surfaces of a cloud: ground, walls, decks and roofs, where points cover a plane over much more than a bar's width."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.geometry import connected
from steelnb.core.types import Array, IntArray
from steelnb.points.filters import voxel_grid
from steelnb.points.neighbours import columns_of
from steelnb.points.surface_kernels import DISC, local_planes
from steelnb.points.voxel_kernels import offsets_within, pack
from steelnb.points.voxel_map import VoxelMap

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
