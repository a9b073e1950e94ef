"""Odometry by clouds: the report's section 3.3, one loop for every method."""

from typing import NamedTuple

import numpy as np

from steelnb.odometry.base import Odometry, Stopwatch, mount_of, nothing_left, scan_of, settings_of
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import PosePredictor
from steelnb.points import VoxelMap, VoxelShapes, preprocess_scan, smooth_ranges
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.inputs import checked_pose
from steelnb.points.kdtree import build_kdtree
from steelnb.points.ranges import SIGMA_M, SIGMA_SHARE
from steelnb.registration import FREE, AnyTarget, Target, align
from steelnb.settings import LoamSettings, OdometrySettings, RegistrationSettings
from steelnb.types import Array, Imu, OdometryStep, Scan

INLIER_SHARE_MIN = 0.3
"""Minimum share of a scan's points that find a correspondence. LOAM as published has no such bound."""
POINTS_MIN = {False: 10, True: 100}
"""Whether the prediction has a stated uncertainty → minimum number of points of a scan. Eight by eight pixels are never
enough: they sample a surface more coarsely than the map's voxels."""
NORMALS_MIN = 0.05
"""Minimum share of normals along a direction in which a scan corrects the prediction, if that has a stated uncertainty
(`unobserved_shifts`). The share is up to 0.02 along a wall, with noise, at least 0.18 before the report's tower, and
0.06 there with the report's sensor. On a tower 6 m wide it falls to 0.03 now and then."""
JUMP_MAX_VOXELS = 10
"""Largest accepted distance of a registration from its prediction, in voxels of the map."""
ITERATIONS_MAX = {"xyz": 200, "xyz_yaw": 150, "se3": 150}
"""Degrees of freedom → maximum number of iterations of the solver, as in the report's programs."""
ITERATIONS_MEASURED = 20
"""Maximum number of iterations with a ``measured`` map, whose solver extrapolates its steps."""
EPSILONS = {False: (1e-4, 2e-4), True: (5e-4, 7e-4)}
"""Whether the map is ``measured`` → rotation epsilon (rad) and translation epsilon (m) of the solver."""


class Registered(NamedTuple):
    """Result of a registration. ``T_world_drone (4, 4)`` is the predicted pose if there is a ``reason``. ``unobserved
    (u, 3)`` are unit vectors along which the pose is the prediction's. ``information (6, 6)`` about rotation and
    position of the drone is that of scan and prediction together."""

    T_world_drone: Array
    reason: str
    inliers: int = 0
    unobserved: Array = np.zeros((0, 3))
    information: Array = np.zeros((6, 6))


class CloudOdometry(Odometry):
    """Registers each scan to the map of the scans before it.

    The covariances of GICP are those of the nearest neighbours, regularised to planes. With a ``measured`` map, they
    are those of the points accumulated around each voxel and of the sensor's noise along each ray. Points are then
    moved by the near-side bias (`near_side`), and the solver extrapolates its steps and stops earlier (`EPSILONS`).

    Parameters
    ----------
    settings : of the family of clouds or faces, default ``OdometrySettings.preset("best")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    imu : readings in the drone frame, used up to the current scan if the settings have ``inertial``.
    """

    BY_FEATURES = False
    settings: RegistrationSettings | LoamSettings

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        self.settings = s = self._own(settings)
        self.T_drone_sensor, self.measured = mount_of(T_drone_sensor), s.map == "measured"
        iterations_max = ITERATIONS_MEASURED if self.measured else ITERATIONS_MAX[s.dof]
        self.stop = iterations_max, *EPSILONS[self.measured]
        self.map = VoxelMap(s.map_voxel_m, s.map != "re-voxelised")
        self.predictor = PosePredictor(s.prior_sigma, s.tilt_sigma_rad, s.inertial, imu)
        self.free = FREE["se3" if self.predictor.tilted else s.dof]
        self.near_side = NearSide()

    def _own(self, settings: OdometrySettings | None) -> RegistrationSettings | LoamSettings:
        return settings_of(settings, RegistrationSettings, "best")

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan, correct the pose, add the scan to the map; see `SegmentOdometry.update`."""
        scan, T_world_drone_prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        s, watch = self.settings, Stopwatch("preprocess", "prepare", "register", "map")
        T_init = self.predictor.pose(scan.stamp_s, T_world_drone_prior)
        if self.measured:
            self.near_side.update(scan.points)
        points = self.preprocessed(scan, T_init)
        watch.lap("preprocess")
        target, covariance = self._prepare(points, T_init)
        watch.lap("prepare")
        T_world_drone, reason, inliers, unobserved, information = self._register(points, covariance, target, T_init)
        used = reason == ""
        if not len(points):
            reason = nothing_left(scan, s.preprocess.crop_m) or reason
        watch.lap("register")
        if (used or reason == "first scan") and len(points):
            self.insert(points, T_world_drone)
        if used:
            self.predictor.correct(T_world_drone, T_world_drone_prior, unobserved, information)
        else:
            self.predictor.lose()
        watch.lap("map")
        return OdometryStep(scan.stamp_s, T_world_drone, used, reason, inliers, watch.seconds, len(unobserved))

    def preprocessed(self, scan: Scan, T_world_drone: Array) -> Array:
        """Points ``(N, 3)`` of a scan, drone frame, as they enter the map: denoised, filtered, and moved by the current
        near-side shift. ``T_world_drone (4, 4)`` is an estimate, to cut off the floor."""
        if self.settings.sigma_filter_px:
            scan = Scan(scan.stamp_s, smooth_ranges(scan.points, self.settings.sigma_filter_px), scan.fault)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, self.settings.preprocess)
        return self.near_side.shifted(points, self.T_drone_sensor[:3, 3]) if self.measured else points

    def _prepare(self, points: Array, T_init: Array) -> tuple[AnyTarget | None, Array | None]:
        s = self.settings
        if not len(points) or not len(self.map):
            return None, None
        world = points @ T_init[:3, :3].T + T_init[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        chosen = self.map.near((low + high) / 2, float((high - low).max() / 2 + 2 * s.max_correspondence_m))
        if not len(chosen):
            return None, None
        tree = build_kdtree(self.map.means(chosen))
        if s.error != "gicp":
            return Target(tree), None
        if not self.measured:
            return Target.with_planes(tree), regularised(neighbour_covariances(points))
        shapes = VoxelShapes(self.map, chosen[tree.order], (0.5 * SIGMA_M) ** 2)
        return Target(tree, covariance=shapes.value, filled=shapes), self._ray_covariances(points)

    def _ray_covariances(self, points: Array) -> Array:
        """Covariances of points, drone frame: range noise along each ray, half of its floor across. Upper triangles
        ``(N, 6)``."""
        ray = points - self.T_drone_sensor[:3, 3]
        distance = np.linalg.norm(ray, axis=1)
        ray = ray / np.maximum(distance, 1e-9)[:, None]
        along = np.maximum(SIGMA_M, SIGMA_SHARE * distance) ** 2
        across = (0.5 * SIGMA_M) ** 2
        extra = along - across
        x, y, z = ray.T
        return np.stack(
            [extra * x * x + across, extra * x * y, extra * x * z, extra * y * y + across, extra * y * z,
             extra * z * z + across], axis=1,
        )  # fmt: skip

    def _register(self, points: Array, covariance: Array | None, target: AnyTarget | None, T_init: Array) -> Registered:
        s, known = self.settings, self.predictor.known and not self.BY_FEATURES
        inliers_min = 0.0 if self.BY_FEATURES else INLIER_SHARE_MIN * len(points)
        if len(points) < POINTS_MIN[known]:
            return Registered(T_init, "too few points")
        if not self.mapped:
            return Registered(T_init, "first scan")
        if target is None:
            return Registered(T_init, "no map in sight")
        result = align(
            points, target, s.error, self.free, T_init, s.max_correspondence_m, covariance,
            s.robust_scale or np.inf, *self.stop, self.measured,
            self.predictor.terms(T_init, points), NORMALS_MIN if known and s.error == "gicp" else 0.0,
        )  # fmt: skip
        jump = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        if result.inliers < inliers_min:
            return Registered(T_init, "too little overlap", result.inliers)
        if result.reason in ("singular", "too few pairs") or not np.isfinite(result.T_target_source).all():
            return Registered(T_init, result.reason, result.inliers)
        if jump > JUMP_MAX_VOXELS * s.map_voxel_m:
            return Registered(T_init, f"jump of {jump:.2f} m", result.inliers)
        T = result.T_target_source
        information = self.predictor.information_of(result.H, T, result.centre)
        return Registered(T, "", result.inliers, result.unobserved, information)

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)``, drone frame, to the map at a known pose."""
        self.map.insert(points @ T_world_drone[:3, :3].T + T_world_drone[:3, 3])

    @property
    def mapped(self) -> bool:
        """Whether the map has points."""
        return len(self.map) > 0

    def map_points(self) -> Array:
        """Means of the map's voxels, ``(N, 3)`` in the world frame."""
        return self.map.means()
