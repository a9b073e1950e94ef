"""LOAM on range images: odometry by edge and plane features."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from steelnb.core.geometry import transform_points
from steelnb.core.kernels import njit
from steelnb.core.types import Array, IntArray, Scan
from steelnb.odometry.clouds import JUMP_MAX_VOXELS, CloudOdometry
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.kdtree import KdTree, build_kdtree, nearest_k
from steelnb.points.moments import NO_MOMENTS, add_point, covariance, eigen
from steelnb.points.ranges import STEP_M
from steelnb.registration import AnyTarget, RegistrationResult, align
from steelnb.registration.target import Search
from steelnb.settings import LoamSettings, OdometrySettings

SHARPEST = {0: 2, 1: 4}
"""Edge (0) or plane (1) → number of features per part of a scan line in scan-to-scan registration, as published."""
ITERATIONS_MAX = 15
SIGMA_M = 0.02
"""Standard deviation of a feature's distance from its line or plane; the unit of ``robust_scale``."""


class LoamOdometry(CloudOdometry):
    """Registers the features of each scan to lines and planes of the previous scans.

    Features are those of Zhang and Singh, "LOAM: Lidar odometry and mapping in real-time" (RSS 2014). A scan is
    registered to the last one (section V), starting from the prior's motion, then to the map (section VI). Unlike
    there, every scan is registered to the map, and Geman-McClure weights replace the bisquare ones.

    Scans are range images ``(H, W, 3)``; clouds ``(N, 3)`` of spinning LiDARs are first sorted into scan lines.
    """

    kind, method, uses = LoamSettings, "loam", ()
    inliers_min = 0.0
    settings: LoamSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        self.options = replace(self.options, iterations_max=ITERATIONS_MAX)
        self.planes = VoxelMap(self.settings.map_voxel_m)  # `map` holds the edges
        none = np.zeros(0, dtype=np.int64)
        self._features = LoamFeatures(np.zeros((0, 3)), none, none)  # of this scan, drone frame, before downsampling
        self._plane: IntArray = none  # kinds of the points that `preprocessed` returned
        self._last = self._features.point, none  # points and kinds of the last scan's features, world frame

    def preprocessed(self, scan: Scan, T_world_drone: Array) -> Array:
        """Features ``(N, 3)`` of a scan in the drone frame, edges before planes, downsampled and without the floor."""
        image, s = scan.points if scan.points.ndim == 3 else scan_lines(scan.points), self.settings
        found = loam_features(image)
        point = transform_points(self.T_drone_sensor, found.point)
        inside = (np.abs(point) <= s.preprocess.crop_m).all(axis=1)
        inside &= point @ T_world_drone[2, :3] + T_world_drone[2, 3] >= s.preprocess.floor_m
        self._features = own = LoamFeatures(point[inside], found.plane[inside], found.rank[inside])
        kinds = [voxel_grid(own.point[own.plane == kind], s.preprocess.voxel_leaf_m) for kind in (0, 1)]
        self._plane = np.repeat([0, 1], [len(points) for points in kinds])
        return np.concatenate(kinds)

    def _prepare(self, points: Array, T_init: Array) -> tuple[AnyTarget | None, Array | None]:
        chosen = [self._in_sight(voxels, points, T_init) for voxels in (self.map, self.planes)]
        if not any(map(len, chosen)):
            return None, None
        edges, planes = (voxels.means(slots) for voxels, slots in zip((self.map, self.planes), chosen, strict=True))
        return FeatureTarget.of(edges, planes, self._plane, SIGMA_M), np.zeros((len(points), 6))

    def _register(
        self, points: Array, covariance: Array | None, target: AnyTarget | None, T_init: Array
    ) -> tuple[RegistrationResult | None, str]:
        return super()._register(points, covariance, target, self._scan_to_scan(T_init))

    def _scan_to_scan(self, T_init: Array) -> Array:
        """The pose ``(4, 4)`` of this scan by registration to the last one, or ``T_init`` if that fails."""
        own, (last, last_plane) = self._features, self._last
        sharp = own.rank < np.where(own.plane == 1, SHARPEST[1], SHARPEST[0])
        if not sharp.any() or not len(last):
            return T_init
        edges, planes = (last[last_plane == kind] for kind in (0, 1))
        target = FeatureTarget.of(edges, planes, own.plane[sharp], SIGMA_M)
        result = align(own.point[sharp], target, T_init, self.options, np.zeros((int(sharp.sum()), 6)))
        jump_m = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        jump_max_m = JUMP_MAX_VOXELS * self.settings.map_voxel_m
        return result.T_target_source if result.converged and jump_m <= jump_max_m else T_init

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)``, drone frame, to the maps at a known pose."""
        world = transform_points(T_world_drone, points)
        self.map.insert(world[self._plane == 0])
        self.planes.insert(world[self._plane == 1])
        self._last = transform_points(T_world_drone, self._features.point), self._features.plane

    @property
    def mapped(self) -> bool:
        """Whether the maps have any points."""
        return len(self.map) + len(self.planes) > 0

    def map_points(self) -> Array:
        """Voxel means of both maps, ``(N, 3)`` in the world frame."""
        return np.concatenate([self.map.means(), self.planes.means()])


SIDE = 5
"""Neighbours on either side of a point, in its scan line, that enter its smoothness. As many neighbours of a chosen
feature are excluded."""
REGIONS = 4
"""Number of subregions of a scan line; each contributes an equal share of the features."""
SMOOTH = 5e-3
"""Smoothness threshold, as published: edge points are above it, planar points below."""
GRAZING = 4.0
"""A surface is roughly parallel to the ray if the range changes by more than this many times the step across it."""
RING_GAP_RAD = 1e-3
"""Gap in elevation between two lasers of a spinning LiDAR."""
RING_MAX_RAD = 1e-2
"""Largest spread in elevation of one laser. Wider groups are split into lines of 5 × `RING_GAP_RAD`."""


class LoamFeatures(NamedTuple):
    """``point (N, 3)`` in the sensor frame, metres; ``plane (N,)``, 1 for a planar point and 0 for an edge point;
    ``rank (N,)``, its place among the features of its kind in its subregion, 0 for the sharpest or flattest."""

    point: Array
    plane: IntArray
    rank: IntArray


def loam_features(image: Array, edges: int = 20, planes: int = 40) -> LoamFeatures:
    """LOAM's features of an organised scan ``(H, W, 3)``, sensor frame, metres, NaN for no return.

    The smoothness of point i is c = ‖Σ (X_i − X_j)‖ / (|S| ‖X_i‖) over its neighbours j in the scan line (equation 1);
    pixels without a return are skipped. Each of the four subregions of a line contributes up to ``edges`` points of
    largest and ``planes`` points of smallest smoothness. Neighbours of a chosen point on the same surface, points on
    surfaces roughly parallel to the ray, and occluded boundaries are excluded. LOAM matches consecutive scans by the
    first 2 edge and 4 planar points of each subregion, and matches ten times as many to its map.
    """
    point = np.empty((image.shape[0] * REGIONS * (edges + planes), 3))
    plane, rank = np.empty(len(point), np.int64), np.empty(len(point), np.int64)
    count = _loam_features(np.ascontiguousarray(image, dtype=np.float64), edges, planes, point, plane, rank)
    return LoamFeatures(point[:count], plane[:count], rank[:count])


def scan_lines(points: Array) -> Array:
    """Scan lines ``(H, W, 3)`` of a spinning LiDAR's cloud ``(N, 3)``, metres, sensor frame with z along its axis.

    Row h holds the returns of one laser, sorted by azimuth and padded with NaN. Lasers are told apart by elevation and
    sorted from the lowest to the highest. Returns that are zero or not finite are dropped.
    """
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    if not len(points):
        return np.full((0, 0, 3), np.nan)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    order = np.argsort(elevation, kind="stable")
    points, elevation = points[order], elevation[order]
    group = np.cumsum(np.diff(elevation, prepend=elevation[0]) > RING_GAP_RAD)
    low = elevation[np.searchsorted(group, np.arange(group[-1] + 1))]
    wide = np.diff(np.append(low, elevation[-1])) > RING_MAX_RAD
    part = np.where(wide[group], (elevation - low[group]) // (5 * RING_GAP_RAD), 0)
    line = np.cumsum((np.diff(group, prepend=0) > 0) | (np.diff(part, prepend=0) > 0))
    order = np.lexsort((np.arctan2(points[:, 1], points[:, 0]), line))
    points, line = points[order], line[order]
    column = np.arange(len(line)) - np.searchsorted(line, line)
    image = np.full((line[-1] + 1, column.max() + 1, 3), np.nan)
    image[line, column] = points
    return image


@njit(cache=True)
def _loam_features(image, edges, planes, point, plane, rank):
    rows, columns = image.shape[0], image.shape[1]
    column = np.empty(columns, np.int64)
    p, distance = np.empty((columns, 3)), np.empty(columns)
    smoothness, excluded = np.empty(columns), np.empty(columns, np.bool_)
    count = 0
    for r in range(rows):
        n = 0
        for c in range(columns):
            x, y, z = image[r, c, 0], image[r, c, 1], image[r, c, 2]
            d = np.sqrt(x * x + y * y + z * z)
            if 0.0 < d < np.inf:
                p[n, 0], p[n, 1], p[n, 2], distance[n], column[n] = x, y, z, d, c
                n += 1
        if n < 2 * SIDE + REGIONS:
            continue
        for k in range(SIDE, n - SIDE):
            x = y = z = 0.0
            for j in range(k - SIDE, k + SIDE + 1):
                x += p[k, 0] - p[j, 0]
                y += p[k, 1] - p[j, 1]
                z += p[k, 2] - p[j, 2]
            smoothness[k] = np.sqrt(x * x + y * y + z * z) / (2 * SIDE * distance[k])
        _exclude_unreliable(p, distance, column, n, excluded)
        for region in range(REGIONS):
            first = SIDE + (n - 2 * SIDE) * region // REGIONS
            last = SIDE + (n - 2 * SIDE) * (region + 1) // REGIONS
            order = first + np.argsort(smoothness[first:last])
            for kind in range(2):
                limit, chosen = (edges, planes)[kind], 0
                for i in range(len(order)):
                    k = order[i] if kind else order[len(order) - 1 - i]
                    if chosen == limit or (smoothness[k] >= SMOOTH) == (kind == 1):
                        break
                    if excluded[k]:
                        continue
                    point[count, 0], point[count, 1], point[count, 2] = p[k, 0], p[k, 1], p[k, 2]
                    plane[count], rank[count] = kind, chosen
                    count, chosen = count + 1, chosen + 1
                    _exclude_neighbours(p, k, n, excluded)
    return count


@njit(cache=True)
def _exclude_unreliable(p, distance, column, n, excluded):
    """Mark the points at the ends of a scan line, at occlusions, and on surfaces roughly parallel to the ray."""
    excluded[:n] = False
    excluded[:SIDE], excluded[n - SIDE : n] = True, True
    for k in range(1, n - 1):
        adjacent = column[k + 1] - column[k] <= SIDE
        if adjacent and distance[k] - distance[k + 1] > STEP_M:
            excluded[max(k - SIDE, 0) : k + 1] = True
        elif adjacent and distance[k + 1] - distance[k] > STEP_M:
            excluded[k + 1 : min(k + 2 + SIDE, n)] = True
        if _grazing(p, distance, k, k - 1) and _grazing(p, distance, k, k + 1):
            excluded[k] = True


@njit(cache=True)
def _grazing(p, distance, k, j):
    along = (distance[k] - distance[j]) ** 2
    return along > GRAZING**2 * (_squared_distance(p, k, j) - along)


@njit(cache=True)
def _exclude_neighbours(p, k, n, excluded):
    """Mark a chosen point and its neighbours on the same surface."""
    excluded[k] = True
    for step in (-1, 1):
        for i in range(1, SIDE + 1):
            j = k + step * i
            if j < 0 or j >= n or _squared_distance(p, j, j - step) > STEP_M**2:
                break
            excluded[j] = True


@njit(cache=True)
def _squared_distance(p, i, j):
    return (p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2


NEIGHBOURS = 5
"""Number of features to which a line or plane is fitted."""
EIGENVALUE_RATIO = 3.0
"""Minimum ratio of the largest to the middle eigenvalue of a line, and of the middle to the smallest of a plane."""
ALONG_M2 = 100.0
"""Variance along a line or in a plane, so large that a pair does not constrain these directions."""


@dataclass(frozen=True)
class FeatureTarget:
    """Edge and planar features of a map or a scan, for the error ``gicp``.

    ``trees`` index the edge and the planar features. ``plane (N,)`` is 1 for planar source points and 0 for edge
    points. The covariance of a pair is ``sigma_m`` squared across its line or plane and very large along it. The
    residual is therefore the distance to the line or plane in standard deviations: equations 2 and 3 of Zhang and
    Singh, "LOAM" (RSS 2014). Lines and planes are eigenvectors of the neighbours' covariance, as in its section VI.
    """

    trees: tuple[KdTree, KdTree]
    plane: IntArray
    sigma_m: float
    point: Array
    covariance: Array
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, edges: Array, planes: Array, plane: IntArray, sigma_m: float) -> "FeatureTarget":
        """Target of ``edges`` and ``planes (M, 3)``, metres, for a source with points of the kinds ``plane (N,)``."""
        trees = build_kdtree(edges), build_kdtree(planes)
        return cls(trees, plane, sigma_m, np.zeros((len(plane), 3)), np.zeros((len(plane), 6)))

    def search(self, source: Array, limit_m: float) -> Search:
        """Line or plane near each source point ``(N, 3)``, fitted again at each pose."""
        match = np.full(len(source), -1)

        def search(T: Array) -> IntArray:
            across = self.sigma_m**2
            for kind, tree in enumerate(self.trees):
                _fit(tree, kind, source, self.plane, T, limit_m, across, self.point, self.covariance, match)
            return match

        return search


@njit(cache=True)
def _fit(tree, kind, source, plane, T, limit, across, point, shape, match):
    """Write the mean and covariance of the line (kind 0) or plane (1) near each source point of that kind under T.

    ``match (N,)`` becomes the point's own index, or −1 if there is no such line or plane.
    """
    node_of, node_distance = np.empty(64, np.int64), np.empty((64, 4))
    found, distance = np.empty(NEIGHBOURS, np.int64), np.empty(NEIGHBOURS)
    p = tree.point
    for i in range(len(source)):
        if plane[i] != kind:
            continue
        match[i] = -1
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if nearest_k(tree, qx, qy, qz, NEIGHBOURS, limit * limit, found, distance, node_of, node_distance) < NEIGHBOURS:
            continue
        m = NO_MOMENTS
        for k in found:
            m = add_point(m, 1.0, p[k, 0] - qx, p[k, 1] - qy, p[k, 2] - qz)
        xx, xy, xz, yy, yz, zz = covariance(m)
        small, medium, large = eigen(xx, xy, xz, yy, yz, zz)
        if kind == 1:
            if medium[0] < EIGENVALUE_RATIO * small[0]:
                continue
            (_, nx, ny, nz), base, extra = small, ALONG_M2, across - ALONG_M2
        else:
            if large[0] < EIGENVALUE_RATIO * medium[0]:
                continue
            (_, nx, ny, nz), base, extra = large, across, ALONG_M2 - across
        match[i] = i
        point[i, 0], point[i, 1], point[i, 2] = qx + m[1] / m[0], qy + m[2] / m[0], qz + m[3] / m[0]
        shape[i, 0], shape[i, 1], shape[i, 2] = base + extra * nx * nx, extra * nx * ny, extra * nx * nz
        shape[i, 3], shape[i, 4], shape[i, 5] = base + extra * ny * ny, extra * ny * nz, base + extra * nz * nz
