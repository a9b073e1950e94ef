"""LOAM on range images: odometry by edges and planes."""

import numpy as np

from steelnb.odometry.base import settings_of
from steelnb.odometry.clouds import JUMP_MAX_VOXELS, STOP, CloudOdometry, Registered
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.features import Features, loam_features, scan_lines
from steelnb.registration import AnyTarget, FeatureTarget, align
from steelnb.settings import LoamSettings, OdometrySettings
from steelnb.types import Array, IntArray, Scan

SHARPEST = {0: 2, 1: 4}
"""Edge 0, plane 1 → of how many in each part of a scan line the motion between two scans is found: as published."""
SIGMA_M = 0.02
"""Standard deviation of a feature across its line or plane, in which ``robust_scale`` counts."""


class LoamOdometry(CloudOdometry):
    """Registers the features of each scan to lines and planes of those of the scans before it.

    Edges and planes are those of Zhang and Singh, "LOAM: Lidar odometry and mapping in real-time" (RSS 2014), matched
    first between this scan and the last one (section V), then to the map of all (section VI), here with every scan. The
    prior's motion is where the first begins, and Geman-McClure weights stand for its bisquare ones.

    Scans are range images ``(H, W, 3)``; clouds ``(N, 3)`` of spinning LiDARs are sorted into their scan lines first.

    Parameters
    ----------
    settings : of the family ``loam``, default ``OdometrySettings.preset("loam")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    """

    BY_FEATURES = True

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        self.planes = VoxelMap(self.settings.map_voxel_m)  # `map` is that of the edges
        none = np.zeros(0, dtype=np.int64)
        self._seen = Features(np.zeros((0, 3)), none, none)  # in this scan, drone frame, before they are thinned out
        self._plane: IntArray = none  # of the points that `preprocessed` gave
        self._last = self._seen.point, none  # of the scan before, world frame

    def _own(self, settings: OdometrySettings | None) -> LoamSettings:
        return settings_of(settings, LoamSettings, "loam")

    def preprocessed(self, scan: Scan, T_world_drone: Array) -> Array:
        """Features ``(N, 3)`` of a scan in the drone frame, edges before planes, without the floor and thinned out."""
        image, s = scan.points if scan.points.ndim == 3 else scan_lines(scan.points), self.settings
        found = loam_features(image)
        point = found.point @ self.T_drone_sensor[:3, :3].T + self.T_drone_sensor[:3, 3]
        inside = (np.abs(point) <= s.preprocess.crop_m).all(axis=1)
        inside &= point @ T_world_drone[2, :3] + T_world_drone[2, 3] >= s.preprocess.floor_m
        self._seen = Features(point[inside], found.plane[inside], found.rank[inside])
        kinds = [voxel_grid(self._seen.point[self._seen.plane == kind], s.preprocess.voxel_leaf_m) for kind in (0, 1)]
        self._plane = np.repeat([0, 1], [len(points) for points in kinds])
        return np.concatenate(kinds)

    def _prepare(self, points: Array, T_init: Array) -> tuple[AnyTarget | None, Array | None]:
        if not len(points) or not self.mapped:
            return None, None
        world = points @ T_init[:3, :3].T + T_init[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        reach = float((high - low).max() / 2 + 2 * self.settings.max_correspondence_m)
        chosen = [voxels.near((low + high) / 2, reach) for voxels in (self.map, self.planes)]
        if not any(map(len, chosen)):
            return None, None
        edges, planes = (voxels.means(slots) for voxels, slots in zip((self.map, self.planes), chosen, strict=True))
        return FeatureTarget.of(edges, planes, self._plane, SIGMA_M), np.zeros((len(points), 6))

    def _register(self, points: Array, covariance: Array | None, target: AnyTarget | None, T_init: Array) -> Registered:
        found = super()._register(points, covariance, target, self._by_last_scan(T_init))
        return found if found.reason == "" else found._replace(T_world_drone=T_init)

    def _by_last_scan(self, T_init: Array) -> Array:
        """The pose ``(4, 4)`` of this scan by the features of the one before; where that fails, ``T_init``."""
        seen, (last, of_plane) = self._seen, self._last
        sharp = seen.rank < np.where(seen.plane == 1, SHARPEST[1], SHARPEST[0])
        if not sharp.any() or not len(last):
            return T_init
        edges, planes = (last[of_plane == kind] for kind in (0, 1))
        target = FeatureTarget.of(edges, planes, seen.plane[sharp], SIGMA_M)
        s, zero = self.settings, np.zeros((int(sharp.sum()), 6))
        result = align(
            seen.point[sharp], target, s.error, self.free, T_init, s.max_correspondence_m, zero,
            s.robust_scale or np.inf, s.iterations_max, *STOP[s.fast], s.fast,
        )  # fmt: skip
        moved_m = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        return result.T_target_source if result.converged and moved_m <= JUMP_MAX_VOXELS * s.map_voxel_m else T_init

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)`` of the drone frame to the maps at a pose that is known."""
        world = points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3]
        self.map.insert(world[self._plane == 0])
        self.planes.insert(world[self._plane == 1])
        self._last = self._seen.point @ T_world_drone[:3, :3].T + T_world_drone[:3, 3], self._seen.plane

    @property
    def mapped(self) -> bool:
        """Whether there is anything in the maps."""
        return len(self.map) + len(self.planes) > 0

    def map_points(self) -> Array:
        """Means of the voxels of both maps, ``(N, 3)`` in the world frame."""
        return np.concatenate([self.map.means(), self.planes.means()])
