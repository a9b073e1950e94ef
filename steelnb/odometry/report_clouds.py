"""Cloud odometry as in the report's program: its section 3.3, including the faults of its source code.

Facts from the published source (`pointcloud_alignment_node.cpp`, for PCL 1.10): a scan is transformed by E times the
drifting pose, where E is the correction so far, and registered to the whole map. The step ΔT is applied as E ΔT. Since
E has already moved the points, ΔT E would be correct. The aligned scan is added to the map, which is then downsampled
to one point per voxel; old and new points have equal weight. The sensor's mount is ignored. If registration fails
or the step is too large, E and the map stay unchanged.
"""

from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Scan
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.points.kdtree import build_kdtree
from steelnb.registration import FREE, AlignOptions, AnyTarget, Target, VoxelTarget, align, make_target
from steelnb.registration.pcl import Aligned, gicp_as_pcl, icp_as_pcl
from steelnb.settings import OdometrySettings, ReportCloudSettings

BOX_LOW, BOX_HIGH = np.array([-0.1, -3.0, -3.0]), np.array([4.0, 3.0, 3.0])
"""Corners of the crop box; sensor frame, metres."""
TURN_MAX_RAD, MOVE_MAX_M = np.pi / 8, 1.0
"""Larger steps are rejected. Both bounds apply to ΔT itself, a motion about the world's origin."""
VOXEL_M = 0.1
"""Edge of the map's voxels."""


class Program(NamedTuple):
    """The parameters of one of the report's programs. ``iterations_max``, ``epsilon`` and ``mse_change_min`` are PCL's
    convergence criteria (`steelnb.registration.pcl`); GICP has no ``mse_change_min``. With ``drop_rotation``, only
    the translation of each step is applied, but the scan is added to the map with its rotation."""

    error: Literal["point", "gicp"]
    max_correspondence_m: float
    iterations_max: int
    epsilon: float
    mse_change_min: float = 0.0
    drop_rotation: bool = False


PROGRAMS = {
    "report-icp": Program("point", 0.5, 150, 1e-3, 1e-3),
    "report-icp-3dof": Program("point", 0.1, 200, 5e-4, 1e-6, drop_rotation=True),
    "report-gicp": Program("gicp", 0.3, 150, 1e-5),
}


class ReportCloudOdometry(BaseOdometry):
    """Corrects a drifting pose by registering each scan to the map, as the report's program does.

    ``correction (4, 4)`` is E; a corrected pose is E times the drifting one. Traits in ``switched`` are replaced.
    """

    kind, method = ReportCloudSettings, "report-gicp"
    stages = "preprocess", "prepare", "register", "map"
    settings: ReportCloudSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        self.program, self.switched = PROGRAMS[self.settings.method], self.settings.switched
        if "mount" not in self.switched:
            self.T_drone_sensor = np.eye(4)
        self.map = VoxelMap(VOXEL_M, accumulate=False)
        self.first = np.zeros((0, 3))  # the first scan is downsampled together with the second one
        self.correction = np.eye(4)

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        points = self.placed(scan, prior)
        watch.lap("preprocess")
        if not len(points):
            return self.correction @ prior, "too few points", 0, 0
        if not len(self.map_points()):
            self.first = points
            return self.correction @ prior, "first scan", 0, 0
        watch.lap("prepare")
        result = self.registered(points)
        step = result.T_target_source.copy()
        if self.program.drop_rotation:
            step[:3, :3] = np.eye(3)
        reason = "" if "gates" in self.switched else rejection(step)
        reason = reason if result.converged else "too few pairs"
        watch.lap("register")
        if not reason:
            aligned = transform_points(result.T_target_source, points)
            self.map.insert(np.concatenate([self.first, aligned]) if not len(self.map) else aligned)
            from_left = "order" in self.switched
            self.correction = step @ self.correction if from_left else self.correction @ step
        watch.lap("map")
        return self.correction @ prior, reason, result.inliers, 0

    def placed(self, scan: Scan, T_world_drone_prior: Array) -> Array:
        """The scan's points inside the box ``(N, 3)``, transformed to the world frame by the correction so far."""
        points = scan.points.reshape(-1, 3)
        points = points[((points >= BOX_LOW) & (points <= BOX_HIGH)).all(axis=1)]  # also removes NaN
        if "thinning" in self.switched:
            points = voxel_grid(points, self.settings.preprocess.voxel_leaf_m)
        T_world_sensor = self.correction @ T_world_drone_prior @ self.T_drone_sensor
        world = transform_points(T_world_sensor, points)
        return world[world[:, 2] >= self.settings.preprocess.floor_m] if "floor" in self.switched else world

    def registered(self, points: Array) -> Aligned:
        """Register points ``(N, 3)``, world frame, to the whole map."""
        t, covariance = self.program, None
        target: AnyTarget
        if t.error == "point":
            target = VoxelTarget(self.map) if len(self.map) else make_target(self.first, "point")
        else:
            tree, covariance = build_kdtree(self.map_points()), neighbour_covariances(points)
            if "covariances" in self.switched:
                target = Target(tree, covariance=neighbour_covariances(tree.point, tree=tree))
            else:
                target, covariance = Target.with_planes(tree), regularised(covariance)
        if "solver" in self.switched:
            options = AlignOptions(
                t.error, FREE["se3"], t.max_correspondence_m, iterations_max=t.iterations_max,
                rotation_epsilon_rad=1e-4, translation_epsilon_m=2e-4,
            )  # fmt: skip
            result = align(points, target, np.eye(4), options, covariance)
            solved = result.reason not in ("singular", "too few pairs")
            return Aligned(result.T_target_source, solved, result.iterations, result.inliers)
        if covariance is not None:
            return gicp_as_pcl(points, covariance, target, t.max_correspondence_m, t.iterations_max, t.epsilon)
        return icp_as_pcl(points, target, t.max_correspondence_m, t.iterations_max, t.epsilon, t.mse_change_min)

    def map_points(self) -> Array:
        """The map, ``(N, 3)`` in the world frame: one point per voxel, or the first scan alone."""
        return self.map.means() if len(self.map) else self.first


def rejection(step: Array) -> str:
    """Why a step ``(4, 4)`` is rejected; empty if it is within the gates."""
    angle = float(Rotation.from_matrix(step[:3, :3], assume_valid=True).magnitude())
    distance = float(np.linalg.norm(step[:3, 3]))
    if angle > TURN_MAX_RAD:
        return f"turn of {np.degrees(angle):.0f}°"
    return f"jump of {distance:.2f} m" if distance > MOVE_MAX_M else ""
