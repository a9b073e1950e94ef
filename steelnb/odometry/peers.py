"""Odometries that others publish and maintain, by their own wheels, behind the interface of ours: for comparison.

KISS-ICP (Vizzo et al., IEEE Robotics and Automation Letters 8, 2023) and the registration VGICP of small_gicp (Koide,
Journal of Open Source Software 9, 2024) to a voxel map, as that library's own example of an odometry has it. Everything
but voxel and range is their default; both solve for six degrees of freedom.
"""

import time
from collections.abc import Callable

import numpy as np

from steelnb.odometry.base import Odometry, scan_of, settings_of
from steelnb.points.inputs import checked_pose
from steelnb.settings import LibrarySettings, OdometrySettings
from steelnb.types import Array, OdometryStep, Scan

POINTS_MIN = 10
"""Scans with fewer returns are not shown to a peer."""
NEIGHBOURS = 10
"""Of a point's covariance, as in small_gicp's example."""
FINER = 4
"""Points for VGICP are thinned to a voxel this many times finer than the map's, as in that example."""
Register = Callable[[Array, Array], tuple[Array, int]]
"""Points ``(N, 3)`` of a scan in the sensor frame, and the motion of the sensor that the prior tells → the pose of the
sensor and the number of points registered."""
MapPoints = Callable[[], Array]


class PeerOdometry(Odometry):
    """Corrects a drifting pose by a ``library``, told each scan's motion by the prior where its own would predict it.

    Parameters
    ----------
    settings : of the family ``library``, default ``OdometrySettings.preset("kiss-icp")``; its voxel is
        ``preprocess.voxel_leaf_m``, and points beyond ``preprocess.crop_m`` are left out.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    """

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        self.settings = settings_of(settings, LibrarySettings, "kiss-icp")
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self._make = kiss_icp if self.settings.library == "kiss_icp" else small_gicp
        self._register: Register | None = None
        self._map_points: MapPoints = lambda: np.zeros((0, 3))
        self._last: Array | None = None  # pose of the sensor at the last scan, by the prior
        self._pose = np.eye(4)  # and corrected

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan; see `Odometry.update`. The one stage of ``seconds`` is ``register``."""
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior") @ self.T_drone_sensor
        points = scan.points.reshape(-1, 3)
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)])
        begin, matches, reason = time.perf_counter(), 0, ""
        if self._last is None:
            self._last = self._pose = prior
        self._pose, self._last = self._pose @ (np.linalg.inv(self._last) @ prior), prior
        if len(points) < POINTS_MIN:
            reason = "too few points"
        else:
            if self._register is None:
                seen, reason = self.settings.preprocess, "first scan"
                self._register, self._map_points = self._make(seen.voxel_leaf_m, prior, seen.crop_m)
            self._pose, matches = self._register(points, self._pose)
        T_world_drone = self._pose @ np.linalg.inv(self.T_drone_sensor)
        seconds = {"register": time.perf_counter() - begin}
        return OdometryStep(scan.stamp_s, T_world_drone, reason == "", reason, matches, seconds)

    def map_points(self) -> Array:
        """The points of the library's map, ``(N, 3)`` in the world frame."""
        return self._map_points()


def kiss_icp(voxel_m: float, first: Array, range_max_m: float) -> tuple[Register, MapPoints]:
    """KISS-ICP on one thread, from a ``first`` pose of the sensor."""
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
    """VGICP of small_gicp to a voxel map, on one thread, from a ``first`` pose of the sensor."""
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
