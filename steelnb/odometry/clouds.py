"""Odometry by clouds: the report's section 3.3, with one loop for all methods."""

from typing import ClassVar

import numpy as np

from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Imu, IntArray, Scan
from steelnb.odometry.base import BaseOdometry, Outcome, Stopwatch
from steelnb.odometry.drift_filter import make_prediction
from steelnb.odometry.near_side import NearSide
from steelnb.points import VoxelMap, VoxelShapes, preprocess_scan, smooth_ranges
from steelnb.points.covariances import UPPER, neighbour_covariances, regularised
from steelnb.points.kdtree import build_kdtree
from steelnb.points.ranges import SIGMA_M, range_sigma_m
from steelnb.registration import FREE, AnyTarget, RegistrationResult, Target, align
from steelnb.settings import LoamSettings, OdometrySettings, RegistrationSettings

INLIER_SHARE_MIN = 0.3
"""Minimum share of a scan's points that find a correspondence. LOAM as published has no such bound."""
POINTS_MIN = {False: 10, True: 100}
"""Whether the prediction has a stated uncertainty → minimum number of points of a scan. With one, 8 × 8 pixels are too
few: they sample a surface more coarsely than the map's voxels."""
NORMALS_MIN = 0.05
"""Minimum strength of the normals along a direction, relative to the strongest one, for a scan to correct a prediction
with a stated uncertainty there (`unobserved_shifts`). It is up to 0.02 along a noisy wall, and in front of the report's
tower at least 0.18, or 0.06 with the report's sensor. On a tower 6 m wide it sometimes falls to 0.03."""
JUMP_MAX_VOXELS = 10
"""Maximum accepted distance of a registration from its prediction, in voxels of the map."""
ITERATIONS_MAX = {"xyz": 200, "xyz_yaw": 150, "se3": 150}
"""Degrees of freedom → maximum number of iterations of the solver, as in the report's programs."""
ITERATIONS_MEASURED = 20
"""Maximum number of iterations with a ``measured`` map, whose solver extrapolates its steps."""
EPSILONS = {False: (1e-4, 2e-4), True: (5e-4, 7e-4)}
"""Whether the map is ``measured`` → rotation epsilon (rad) and translation epsilon (m) of the solver."""


class CloudOdometry(BaseOdometry):
    """Registers each scan to the map of the scans before it.

    The covariances of GICP are those of the nearest neighbours, regularised to planes. With a ``measured`` map, the
    target's are those of the points accumulated around each voxel, and the source's follow from the range noise. Then,
    points are moved by the near-side bias (`near_side`), and the solver extrapolates and stops earlier (`EPSILONS`).

    Settings are of the family of clouds or faces. ``imu``: readings in the drone frame, used up to the current scan if
    the settings have ``inertial``.
    """

    kind: ClassVar[type[OdometrySettings]] = RegistrationSettings
    method = "best"
    stages: ClassVar[tuple[str, ...]] = ("preprocess", "prepare", "register", "map")
    inliers_min = INLIER_SHARE_MIN
    settings: RegistrationSettings | LoamSettings

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        super().__init__(settings, T_drone_sensor)
        s = self.settings
        self.measured = s.map == "measured"
        iterations_max = ITERATIONS_MEASURED if self.measured else ITERATIONS_MAX[s.dof]
        self.stop = iterations_max, *EPSILONS[self.measured]
        self.map = VoxelMap(s.map_voxel_m, s.map != "re-voxelised")
        self.prediction = make_prediction(s.prior_sigma, s.tilt_sigma_rad, s.inertial, imu)
        self.free = FREE["se3" if self.prediction.tilted else s.dof]
        self.near_side = NearSide()

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> Outcome:
        T_init = self.prediction.pose(prior, scan.stamp_s)
        if self.measured:
            self.near_side.update(scan.points)
        points = self.preprocessed(scan, T_init)
        watch.lap("preprocess")
        target, covariance = self._prepare(points, T_init)
        watch.lap("prepare")
        result, reason = self._register(points, covariance, target, T_init)
        watch.lap("register")
        T_world_drone, unobserved = T_init, 0
        if result and not reason:
            T_world_drone, unobserved = result.T_target_source, len(result.unobserved)
            arm = T_world_drone[:3, 3] - result.centre
            self.prediction.correct(T_world_drone, prior, result.unobserved, result.H, arm)
        else:
            self.prediction.lose()
        if reason in ("", "first scan") and len(points):
            self.insert(points, T_world_drone)
        watch.lap("map")
        return T_world_drone, reason, result.inliers if result else 0, unobserved

    def preprocessed(self, scan: Scan, T_world_drone: Array) -> Array:
        """Points ``(N, 3)`` of a scan, drone frame, as they enter the map: denoised, filtered, and moved by the current
        near-side shift. ``T_world_drone (4, 4)`` is an estimate, to cut off the floor."""
        if self.settings.sigma_filter_px:
            scan = Scan(scan.stamp_s, smooth_ranges(scan.points, self.settings.sigma_filter_px), scan.fault)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, self.settings.preprocess)
        return self.near_side.shifted(points, self.T_drone_sensor[:3, 3]) if self.measured else points

    def _prepare(self, points: Array, T_init: Array) -> tuple[AnyTarget | None, Array | None]:
        """The part of the map that a scan may see, None if empty, and the covariances of the scan's points."""
        chosen = self._in_sight(self.map, points, T_init)
        if not len(chosen):
            return None, None
        tree = build_kdtree(self.map.means(chosen))
        if self.settings.error != "gicp":
            return Target(tree), None
        if not self.measured:
            return Target.with_planes(tree), regularised(neighbour_covariances(points))
        shapes = VoxelShapes(self.map, chosen[tree.order], (0.5 * SIGMA_M) ** 2)
        return Target(tree, covariance=shapes.value, filled=shapes), self._ray_covariances(points)

    def _in_sight(self, voxels: VoxelMap, points: Array, T_init: Array) -> IntArray:
        """Slots of the voxels near the points ``(N, 3)``, drone frame, of a scan."""
        if not len(points) or not len(voxels):
            return np.zeros(0, dtype=np.int64)
        world = transform_points(T_init, points)
        low, high = world.min(axis=0), world.max(axis=0)
        reach_m = float((high - low).max() / 2 + 2 * self.settings.max_correspondence_m)
        return voxels.near((low + high) / 2, reach_m)

    def _ray_covariances(self, points: Array) -> Array:
        """Covariances of points, drone frame, as upper triangles ``(N, 6)``. The standard deviation is the range
        noise along each ray, and half of `SIGMA_M` across it."""
        ray = points - self.T_drone_sensor[:3, 3]
        distance = np.linalg.norm(ray, axis=1)
        ray = ray / np.maximum(distance, 1e-9)[:, None]
        across = (0.5 * SIGMA_M) ** 2
        extra = range_sigma_m(distance) ** 2 - across
        i, j = UPPER
        return (extra[:, None] * ray)[:, i] * ray[:, j] + across * np.eye(3)[UPPER]

    def _register(
        self, points: Array, covariance: Array | None, target: AnyTarget | None, T_init: Array
    ) -> tuple[RegistrationResult | None, str]:
        """The registration of a scan, and the reason if it is not used."""
        s, known = self.settings, self.prediction.known
        if len(points) < POINTS_MIN[known]:
            return None, "too few points"
        if not self.mapped:
            return None, "first scan"
        if target is None:
            return None, "no map in sight"
        result = align(
            points, target, s.error, self.free, T_init, s.max_correspondence_m, covariance,
            s.robust_scale or np.inf, *self.stop, self.measured,
            self.prediction.terms(T_init, points), NORMALS_MIN if known and s.error == "gicp" else 0.0,
        )  # fmt: skip
        jump_m = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        if result.inliers < self.inliers_min * len(points):
            return result, "too little overlap"
        if result.reason in ("singular", "too few pairs") or not np.isfinite(result.T_target_source).all():
            return result, result.reason
        return result, f"jump of {jump_m:.2f} m" if jump_m > JUMP_MAX_VOXELS * s.map_voxel_m else ""

    def insert(self, points: Array, T_world_drone: Array) -> None:
        """Add preprocessed points ``(N, 3)``, drone frame, to the map at a known pose."""
        self.map.insert(transform_points(T_world_drone, points))

    @property
    def mapped(self) -> bool:
        """Whether the map has points."""
        return len(self.map) > 0

    def map_points(self) -> Array:
        """Means of the map's voxels, ``(N, 3)`` in the world frame."""
        return self.map.means()
