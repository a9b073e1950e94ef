"""LOAM on range images: odometry by edge and plane features."""

from dataclasses import replace

import numpy as np

from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, IntArray, Scan
from steelnb.odometry.clouds import JUMP_MAX_VOXELS, CloudOdometry
from steelnb.odometry.loam.features import LoamFeatures, loam_features, scan_lines
from steelnb.odometry.loam.target import FeatureTarget
from steelnb.points import VoxelMap, voxel_grid
from steelnb.registration import AnyTarget, RegistrationResult, align
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

    kind, method = LoamSettings, "loam"
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
