"""Odometry by clouds: the report's section 3.3, with one loop for all methods."""

from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Imu, IntArray, Scan
from steelnb.fusion.point_to_bar import world_points
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.odometry.inertial import make_prediction
from steelnb.odometry.near_side import NearSide, parted, pixels_on_surfaces, within_plane
from steelnb.odometry.prediction import LastingError, RegisteredPose
from steelnb.points import VoxelMap, preprocess_scan, smooth_ranges
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.kdtree import build_kdtree
from steelnb.points.ranges import SIGMA_M, range_sigma_m
from steelnb.registration import FREE, AlignOptions, AnyTarget, RegistrationResult, Target, VoxelTarget, align
from steelnb.registration.solver import NORMALS_MIN
from steelnb.settings import LoamSettings, OdometrySettings, RegistrationSettings

INLIER_SHARE_MIN = 0.3
"""Minimum share of a scan's points that find a correspondence. LOAM as published has no such bound."""
JUMP_MAX_VOXELS = 10
"""Maximum accepted distance of a registration from its prediction, in voxels of the map."""


class MapStyle(NamedTuple):
    """How the map is built, and how scans are registered to it.

    ``accumulate``: a voxel's mean is that of all its points (`VoxelMap`). ``covariances`` of GICP: ``neighbours``,
    those of the nearest neighbours, regularised to planes; ``measured``, those of the points accumulated around each
    voxel for the target, and of the range noise for the source. ``near_side``: move points by the near-side bias
    (`steelnb.odometry.near_side`). ``accelerated`` and what follows are the solver's (`AlignOptions`);
    ``iterations_max`` is by degrees of freedom.
    """

    accumulate: bool
    covariances: Literal["neighbours", "measured"]
    near_side: bool
    accelerated: bool
    iterations_max: Mapping[str, int]
    rotation_epsilon_rad: float
    translation_epsilon_m: float


RE_VOXELISED = MapStyle(
    accumulate=False, covariances="neighbours", near_side=False, accelerated=False,
    iterations_max={"xyz": 200, "xyz_yaw": 150, "se3": 150},
    rotation_epsilon_rad=1e-4, translation_epsilon_m=2e-4,
)  # fmt: skip
"""The map of the report's programs, with their maximum numbers of iterations."""
WEIGHTED = RE_VOXELISED._replace(accumulate=True)
MEASURED = MapStyle(
    accumulate=True, covariances="measured", near_side=True, accelerated=True,
    iterations_max={"xyz": 20, "xyz_yaw": 20, "se3": 20}, rotation_epsilon_rad=5e-4, translation_epsilon_m=7e-4,
)  # fmt: skip
"""A model of bars and of the sensor's noise. Extrapolated steps need fewer iterations."""
MAPS = {"re-voxelised": RE_VOXELISED, "weighted": WEIGHTED, "measured": MEASURED}
"""The setting ``map`` → its style."""


class ScanDemand(NamedTuple):
    """What a scan must have to correct its prediction: a minimum number of points, and a minimum strength of the
    normals along a direction, relative to the strongest one (`unobserved_shifts`), for a correction along it by
    GICP."""

    points_min: int
    normals_min: float


UNANCHORED = ScanDemand(points_min=10, normals_min=0.0)
"""For a prediction without a stated uncertainty."""
ANCHORED = ScanDemand(points_min=100, normals_min=NORMALS_MIN)
"""For a prediction with one. 8 × 8 pixels are too few: they sample a surface more coarsely than the map's voxels. The
normals' strength is in front of the report's tower at least 0.18, or 0.06 with the
report's sensor. On a tower 6 m wide it sometimes falls to 0.03."""


CLOUD_ERROR = LastingError(sigma_rad=0.004, sigma_m=0.03, time_s=10.0)
"""Lasting error of registrations to a map of clouds. Chosen on 60 s of the development seeds 11 to 14 with the honest
sensor, so that the filter's errors are as large as it claims; 2 to 4 cm and 5 to 10 s leave similar errors."""


class CloudOdometry(BaseOdometry):
    """Registers each scan to the map of the scans before it.

    The setting ``map`` selects a `MapStyle`, and the prediction a `ScanDemand`. Settings are of the family of clouds or
    faces. ``imu``: readings in the drone frame, used up to the current scan if the settings have ``inertial``.
    """

    kind: ClassVar[type[OdometrySettings]] = RegistrationSettings
    method = "best"
    uses: ClassVar[tuple[str, ...]] = ("imu",)
    stages: ClassVar[tuple[str, ...]] = ("preprocess", "prepare", "register", "map")
    inliers_min = INLIER_SHARE_MIN
    settings: RegistrationSettings | LoamSettings

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        super().__init__(settings, T_drone_sensor)
        s = self.settings.registration
        self.style = style = MAPS[s.map]
        self.map = VoxelMap(s.map_voxel_m, style.accumulate)
        self.prediction = make_prediction(s.prior_sigma, s.tilt_sigma_rad, s.inertial, imu)
        self.demand = ANCHORED if self.prediction.known else UNANCHORED
        self.options = AlignOptions(
            s.error, FREE["se3" if self.prediction.tilted else s.dof], s.max_correspondence_m, s.robust_scale or np.inf,
            style.iterations_max[s.dof], style.rotation_epsilon_rad, style.translation_epsilon_m, style.accelerated,
            self.demand.normals_min if s.error == "gicp" else 0.0,
        )  # fmt: skip
        self.sigma_filter_px = s.sigma_filter_px
        self.near_side = NearSide()
        self._surfaces = np.zeros((2, 0, 3))  # points on wide surfaces, the last that `preprocessed` returned; normals

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        T_world_drone, reason, matches, unobserved = self.corrected(scan, prior, watch)
        return self.prediction.levelled(T_world_drone), reason, matches, unobserved

    def _covariance(self, T_world_drone: Array) -> Array | None:
        return self.prediction.covariance(T_world_drone)

    def corrected(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        """What `update` does with a checked scan; also for an odometry that falls back on this one."""
        T_init = self.prediction.pose(prior, scan.stamp_s, CLOUD_ERROR)
        if self.style.near_side:
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
            self.prediction.correct(RegisteredPose(T_world_drone, result.unobserved, result.H, arm))
        else:
            self.prediction.lose()
        if reason in ("", "first scan") and len(points):
            self.insert(points, T_world_drone)
        watch.lap("map")
        return T_world_drone, reason, result.inliers if result else 0, unobserved

    def preprocessed(self, scan: Scan, T_world_drone: Array) -> Array:
        """Points ``(N, 3)`` of a scan, drone frame, as they enter the map: denoised, filtered, and moved by the current
        near-side shift. ``T_world_drone (4, 4)`` is an estimate, to cut off the floor."""
        s, mount, on_surface = self.settings.preprocess, self.T_drone_sensor, np.zeros(0, dtype=bool)
        if self.style.near_side:
            flat = np.ascontiguousarray(scan.points).reshape(-1, 3)
            used = world_points(flat, T_world_drone @ mount, s.crop_m, s.floor_m)[2]
            on_surface = pixels_on_surfaces(scan.points, used)
        if self.sigma_filter_px:
            scan = Scan(scan.stamp_s, smooth_ranges(scan.points, self.sigma_filter_px), scan.fault)
        self._surfaces = np.zeros((2, 0, 3))
        if not on_surface.any():
            points = preprocess_scan(scan, T_world_drone, mount, s)
            return self.near_side.shifted(points, mount[:3, 3]) if self.style.near_side else points
        without = [np.where(mask[..., None], np.nan, scan.points) for mask in (on_surface, ~on_surface)]
        parts = [preprocess_scan(Scan(scan.stamp_s, points), T_world_drone, mount, s) for points in without]
        bars, *surfaces = parted(*parts)
        self._surfaces = np.array(surfaces)
        return np.concatenate([self.near_side.shifted(bars, mount[:3, 3]), self._surfaces[0]])

    def _prepare(self, points: Array, T_init: Array) -> tuple[AnyTarget | None, Array | None]:
        """The part of the map that a scan may see, None if empty, and the covariances of the scan's points."""
        chosen = self._in_sight(self.map, points, T_init)
        if not len(chosen):
            return None, None
        if self.options.error != "gicp":
            return VoxelTarget(self.map), None
        if self.style.covariances == "measured":
            return VoxelTarget(self.map, (0.5 * SIGMA_M) ** 2), self._ray_covariances(points)
        tree = build_kdtree(self.map.means(chosen))
        return Target.with_planes(tree), regularised(neighbour_covariances(points))

    def _in_sight(self, voxels: VoxelMap, points: Array, T_init: Array) -> IntArray:
        """Slots of the voxels near the points ``(N, 3)``, drone frame, of a scan."""
        if not len(points) or not len(voxels):
            return np.zeros(0, dtype=np.int64)
        world = transform_points(T_init, points)
        low, high = world.min(axis=0), world.max(axis=0)
        reach_m = float((high - low).max() / 2 + 2 * self.options.max_correspondence_m)
        return voxels.near((low + high) / 2, reach_m)

    def _ray_covariances(self, points: Array) -> Array:
        """Covariances of points, drone frame, as upper triangles ``(N, 6)``. The standard deviation is the range
        noise along each ray, and half of `SIGMA_M` across it; on wide surfaces it is large in all but their normals."""
        ray = points - self.T_drone_sensor[:3, 3]
        distance = np.linalg.norm(ray, axis=1)
        ray = ray / np.maximum(distance, 1e-9)[:, None]
        across = (0.5 * SIGMA_M) ** 2
        extra = range_sigma_m(distance) ** 2 - across
        i, j = upper = np.triu_indices(3)
        covariance = (extra[:, None] * ray)[:, i] * ray[:, j] + across * np.eye(3)[upper]
        surfaces, normal = self._surfaces
        first = len(points) - len(surfaces)
        if first >= 0 and np.array_equal(points[first:], surfaces):  # unless a subclass has chosen some
            covariance[first:] += within_plane(normal)
        return covariance

    def _register(
        self, points: Array, covariance: Array | None, target: AnyTarget | None, T_init: Array
    ) -> tuple[RegistrationResult | None, str]:
        """The registration of a scan, and the reason if it is not used."""
        if len(points) < self.demand.points_min:
            return None, "too few points"
        if not self.mapped:
            return None, "first scan"
        if target is None:
            return None, "no map in sight"
        result = align(points, target, T_init, self.options, covariance, self.prediction.terms(T_init, points))
        jump_m = np.linalg.norm(result.T_target_source[:3, 3] - T_init[:3, 3])
        if result.inliers < self.inliers_min * len(points):
            return result, "too little overlap"
        if result.reason in ("singular", "too few pairs") or not np.isfinite(result.T_target_source).all():
            return result, result.reason
        return result, f"jump of {jump_m:.2f} m" if jump_m > JUMP_MAX_VOXELS * self.settings.map_voxel_m else ""

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
