"""Published odometry libraries behind our interface, for comparison.

KISS-ICP (Vizzo et al., IEEE Robotics and Automation Letters 8, 2023), and VGICP of small_gicp (Koide, Journal of Open
Source Software 9, 2024) to a voxel map, as in that library's odometry example. Except for voxel size and range, all
parameters are the libraries' defaults. Both solve for six degrees of freedom.
"""

from collections.abc import Callable

import numpy as np

from steelnb.core.types import Array, Scan
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.settings import LibrarySettings

POINTS_MIN = 10
"""Scans with fewer returns within range are not registered."""
NEIGHBOURS = 10
"""Number of neighbours for a point's covariance, as in small_gicp's example."""
FINER = 4
"""Scans for VGICP are downsampled to voxels this many times finer than the map's, as in that example."""
Register = Callable[[Array, Array], tuple[Array, int]]
"""Points ``(N, 3)`` of a scan, sensor frame, and the sensor's predicted pose → its registered pose, and the number of
points registered."""
MapPoints = Callable[[], Array]


class PeerOdometry(BaseOdometry):
    """Corrects a drifting pose with a library. The prior's motion replaces the library's own prediction.

    The voxel is ``preprocess.voxel_leaf_m``; points beyond ``preprocess.crop_m`` are ignored.
    """

    kind, method = LibrarySettings, "kiss-icp"
    stages = ("register",)
    settings: LibrarySettings
    _register: Register | None = None
    _last_prior: Array | None = None  # T_world_sensor of the last scan by the prior

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        prior, points = prior @ self.T_drone_sensor, scan.points.reshape(-1, 3)
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)])
        matches, reason = 0, ""
        if self._last_prior is None:
            self._last_prior = self._T_world_sensor = prior
        self._T_world_sensor = self._T_world_sensor @ (np.linalg.inv(self._last_prior) @ prior)
        self._last_prior = prior
        if (np.linalg.norm(points, axis=1) < self.settings.preprocess.crop_m).sum() < POINTS_MIN:
            reason = "too few points"
        else:
            if self._register is None:
                s, reason = self.settings, "first scan"
                make = LIBRARIES[s.method]
                self._register, self._map_points = make(s.preprocess.voxel_leaf_m, prior, s.preprocess.crop_m)
            self._T_world_sensor, matches = self._register(points, self._T_world_sensor)
        watch.lap("register")
        return self._T_world_sensor @ np.linalg.inv(self.T_drone_sensor), reason, matches, 0

    def map_points(self) -> Array:
        """The points of the library's map, ``(N, 3)`` in the world frame."""
        return self._map_points() if self._register else np.zeros((0, 3))


def kiss_icp(voxel_m: float, first: Array, range_max_m: float) -> tuple[Register, MapPoints]:
    """KISS-ICP on one thread, starting at the sensor's ``first`` pose."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.deskew = range_max_m, False
    config.mapping.voxel_size, config.registration.max_num_threads = voxel_m, 1
    peer = KissICP(config)
    peer.last_pose = first

    def register(points: Array, predicted: Array) -> tuple[Array, int]:
        peer.last_delta = np.linalg.inv(peer.last_pose) @ predicted
        _, source = peer.register_frame(points, np.zeros(0))
        return peer.last_pose, len(source)

    return register, lambda: np.asarray(peer.local_map.point_cloud())


def small_gicp(voxel_m: float, first: Array, range_max_m: float) -> tuple[Register, MapPoints]:
    """VGICP of small_gicp to a voxel map, on one thread."""
    import small_gicp as library

    target = library.GaussianVoxelMap(voxel_m)

    def register(points: Array, predicted: Array) -> tuple[Array, int]:
        near = points[np.linalg.norm(points, axis=1) < range_max_m]
        source, _ = library.preprocess_points(near, voxel_m / FINER, NEIGHBOURS)
        pose = predicted
        if target.size():
            pose = library.align(target, source, predicted, voxel_m).T_target_source
        target.insert(source, pose)
        return pose, source.size()

    return register, lambda: np.asarray(target.voxel_points())[:, :3]


LIBRARIES = {"kiss-icp": kiss_icp, "small-gicp": small_gicp}
"""Method → its library."""
