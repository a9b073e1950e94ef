"""Odometry by clouds: the report's section 3.3, one loop for every method."""

import time

import numpy as np

from steelnb.config import CloudSettings, PreprocessSettings
from steelnb.datatypes import Array, OdometryStep, Scan, Segments
from steelnb.mapping import VoxelMap
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import Prediction
from steelnb.preprocess import preprocess_scan
from steelnb.preprocess.covariances import neighbour_covariances, regularised
from steelnb.preprocess.kdtree import build_kdtree
from steelnb.registration import RegistrationResult, Target, Term, VoxelTarget, align, free_directions, voxel_target


class CloudOdometry:
    """Corrects a drifting pose by registering each scan to the map of those before it."""

    def __init__(
        self,
        settings: CloudSettings | None = None,
        preprocess: PreprocessSettings | None = None,
        T_drone_sensor: Array | None = None,
    ) -> None:
        self.settings = settings or CloudSettings.preset("best")
        self.preprocess = preprocess or PreprocessSettings(x_max_m=4.0, y_max_m=4.0, z_max_m=4.0)
        self.T_drone_sensor = np.eye(4) if T_drone_sensor is None else T_drone_sensor
        self.map = VoxelMap(self.settings.map_voxel_m, self.settings.remember)
        self.prediction = Prediction(self.settings.drift_gain)
        self.free = free_directions(self.settings.dof)
        s = self.settings
        self.information = np.diag([s.prior_sigma_rad**-2.0] * 3 + [s.prior_sigma_m**-2.0] * 3)
        self.last: RegistrationResult | None = None
        self.near_side = NearSide()

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan, correct the pose, add the scan to the map; see `SegmentOdometry.update`."""
        scan = scan if isinstance(scan, Scan) else Scan(0.0, scan)
        s, clock = self.settings, [time.perf_counter()]
        T_init = self.prediction.pose(T_world_drone_prior)
        points = preprocess_scan(scan, T_init, self.T_drone_sensor, self.preprocess)
        if s.near_side:
            self.near_side.look(scan.points)
            points = self.near_side.behind(points, self.T_drone_sensor[:3, 3])
        clock.append(time.perf_counter())
        target, covariance = self._prepare(points, T_init)
        clock.append(time.perf_counter())
        T_world_drone, reason, inliers = self._register(points, covariance, target, T_init)
        used = reason == ""
        clock.append(time.perf_counter())
        if (used or reason == "first scan") and len(points):
            self.insert(points, T_world_drone)
        if used:
            if s.drop_rotation:
                T_world_drone = np.block([[T_init[:3, :3], T_world_drone[:3, 3:]], [np.array([[0, 0, 0, 1.0]])]])
            self.prediction.correct(T_world_drone, T_world_drone_prior)
        else:
            self.prediction.lose()
        clock.append(time.perf_counter())
        seconds = dict(zip(("preprocess", "prepare", "register", "map"), np.diff(clock).tolist(), strict=True))
        return OdometryStep(scan.stamp_s, T_world_drone, used, reason, inliers, seconds)

    def _prepare(self, points: Array, T_init: Array) -> tuple[Target | VoxelTarget | None, Array | None]:
        s = self.settings
        if not len(points) or not len(self.map):
            return None, None
        if s.shape == "voxels":
            return voxel_target(self.map), self._ray_covariances(points)
        world = points @ T_init[:3, :3].T + T_init[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        chosen = self.map.near((low + high) / 2, float((high - low).max() / 2 + 2 * s.max_correspondence_m))
        if not len(chosen):
            return None, None
        tree = build_kdtree(self.map.means(chosen))
        none = np.zeros((0, 6))
        if s.error != "gicp":
            return Target(tree, np.zeros((0, 3)), none), None
        if s.shape == "neighbours":
            around = regularised(neighbour_covariances(tree.point, s.neighbours, tree))
            return Target(tree, np.zeros((0, 3)), around), regularised(neighbour_covariances(points, s.neighbours))
        around = self.map.shapes(chosen)[tree.order].copy()
        around[:, [0, 3, 5]] += (0.5 * s.sigma_floor_m) ** 2
        return Target(tree, np.zeros((0, 3)), around), self._ray_covariances(points)

    def _ray_covariances(self, points: Array) -> Array:
        """Range noise along each ray, and the floor across it, upper triangles ``(N, 6)`` in the drone frame."""
        s = self.settings
        ray = points - self.T_drone_sensor[:3, 3]
        distance = np.linalg.norm(ray, axis=1)
        ray = ray / np.maximum(distance, 1e-9)[:, None]
        along = np.maximum(s.sigma_floor_m, s.sigma_relative * distance) ** 2
        across = (0.5 * s.sigma_floor_m) ** 2
        extra = along - across
        x, y, z = ray.T
        return np.stack(
            [extra * x * x + across, extra * x * y, extra * x * z, extra * y * y + across, extra * y * z,
             extra * z * z + across], axis=1,
        )  # fmt: skip

    def _register(
        self, points: Array, covariance: Array | None, target: Target | VoxelTarget | None, T_init: Array
    ) -> tuple[Array, str, int]:
        s = self.settings
        if len(points) < 10:
            return T_init, "too few points", 0
        if not len(self.map):
            return T_init, "first scan", 0
        if target is None:
            return T_init, "no map in sight", 0
        prior = self.information if s.prior_sigma_m < 1e2 else None
        result = align(
            points, target, s.error, self.free, T_init, s.max_correspondence_m, covariance, s.robust, s.robust_scale,
            s.iterations_max, s.rotation_epsilon_rad, s.translation_epsilon_m, prior, s.accelerated,
            self._other_term(points),
        )  # fmt: skip
        self.last = result
        jump = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        if result.inliers < s.inlier_share_min * len(points):
            return T_init, "too little overlap", result.inliers
        if result.reason in ("singular", "too few pairs") or not np.isfinite(result.T_target_source).all():
            return T_init, result.reason, result.inliers
        if jump > s.jump_max_m:
            return T_init, f"jump of {jump:.2f} m", result.inliers
        return result.T_target_source, "", result.inliers

    def _other_term(self, points: Array) -> Term | None:
        """What else than the cloud is known of the pose of the scan's ``points (N, 3)``; nothing here."""
        return None

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)`` of the drone frame to the map at a pose that is known."""
        touched = self.map.insert(points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3])
        if self.settings.shape != "neighbours":
            self.map.update_shapes(touched)

    def map_points(self) -> Array:
        """Means of the map's voxels, ``(N, 3)`` in the world frame."""
        return self.map.means()

    def map_segments(self) -> Segments:
        """The bars of the map; none, since it is a cloud."""
        return Segments.empty()
