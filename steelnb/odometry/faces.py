"""Odometry by the front faces of bars that the flight itself has found.

A map of points is biased: a voxel averages over the faces that it holds, so what a scan is registered to changes with
the side from which it is seen. A bar whose section is known has no such bias. So every `KEYFRAME_S` a scan becomes a
keyframe; every ``refit_s`` bars are found in all of these, and their poses and the bars adjusted together
(`steelnb.fusion.keyframes`), in a thread beside the scans to come; and scans are registered to the bars' front faces
(`steelnb.fusion.locate`). Where these do not tell the pose, at the beginning and where the view is new,
the odometry by clouds does.
"""

import time
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from steelnb.fusion.inertial import TILT_SIGMA_RAD
from steelnb.fusion.keyframes import Keyframes, Readings
from steelnb.fusion.locate import POINTS_MIN, Fit, Locator, points_in_range
from steelnb.fusion.poses import DRIFT_PERIOD_S, DRIFT_SIGMA, moved_poses, pose_size, pose_step
from steelnb.fusion.problem import Problem
from steelnb.odometry.base import scan_of, settings_of
from steelnb.odometry.combined import by_clouds
from steelnb.odometry.inertial_prediction import NONE, SCAN_SHARE, information_at
from steelnb.points.inputs import checked_pose
from steelnb.settings import FaceSettings, OdometrySettings, StructureSettings
from steelnb.types import Array, Imu, OdometryStep, Scan, Segments

KEYFRAME_S = 1.0
ADOPT_S = 2.0
"""Time of flight after which the result of an adjustment is taken over, whenever it is there: estimates do not depend
on the machine's speed. It takes up to 2 s of one core of a laptop."""
SCAN_POINTS, KEYFRAME_POINTS = 2000, 4000
"""Numbers of points of a scan that are registered, and of a keyframe to which bars are fitted."""
REFITTED_SIGMA = np.array([0.003, 0.003, 0.003, 0.001, 0.001, 0.001])
"""Standard deviation of the latest pose in the adjusted bars, metres and radians."""
STEP_OF_TWIST, TWIST_OF_STEP = [3, 4, 5, 2, 0, 1], [4, 5, 3, 0, 1, 2]
"""Where x, y, z, yaw, roll and pitch are in (turn, shift), and the other way round."""
GATE = {4: 18.5, 6: 22.5}
"""Degrees of freedom → the largest squared distance of a registration from its prediction, in standard deviations:
99.9 % of chi-squared. Beyond it, bars that were fitted wrongly lead the registration astray."""
STAGES = ("preprocess", "prepare", "register", "map", "refit")


class FaceOdometry:
    """Corrects a drifting pose by the front faces of bars, beside an odometry by clouds.

    What is put out follows an adjustment in steps that are no larger than those of the drift (`DRIFT_SIGMA`), so that
    it does not jump.

    Parameters
    ----------
    settings : of the family of faces, default ``OdometrySettings.preset("faces")``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    imu : readings in the axes of the drone, as for `CloudOdometry`; they take part in the adjustments, too.
    """

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        self.settings = settings_of(settings, FaceSettings, "faces")
        self.clouds = by_clouds(self.settings, T_drone_sensor, imu)
        self.T_drone_sensor = self.clouds.T_drone_sensor
        seen, self.predictor = self.settings.preprocess, self.clouds.predictor
        self.inertial = self.predictor.inertial
        self.tilt_sigma_rad = self.settings.tilt_sigma_rad or (TILT_SIGMA_RAD if self.inertial else 0.0)
        bars = StructureSettings(floor_m=seen.floor_m, range_max_m=seen.crop_m)
        self.keyframes = Keyframes(bars, self.tilt_sigma_rad)
        if self.inertial:
            self.keyframes.readings = Readings(self.inertial.imu, self.inertial.noise, self.T_drone_sensor)
        self.faces: Locator | None = None
        self._stamp_s, self._keyframe_s, self._refit_s = -np.inf, -np.inf, np.inf
        # What is put out lies behind the estimate by so much: x, y, z, yaw, and roll and pitch where they are free.
        self._behind = np.zeros(pose_size(self.tilt_sigma_rad))
        self._adjustment: Future[Problem | None] | None = None
        self._adopt_s, self._adjusted_from = np.inf, np.eye(4)
        self._waiting: list[tuple[Scan, Array, Array, Array]] = []  # keyframes that came during an adjustment

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan, correct the pose, add the scan to the map; see `SegmentOdometry.update`."""
        scan, prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        if not scan.stamp_s > self._stamp_s:  # scans without stamps are taken to come at the usual rate
            scan = Scan(self._stamp_s + DRIFT_PERIOD_S, scan.points, scan.fault)
        self._stamp_s = scan.stamp_s
        begin = time.perf_counter()
        fit = self._fitted(scan, prior)
        if fit is None:
            step = self.clouds.update(scan, prior)
            T_world_drone, seconds, held = step.T_world_drone, {**step.seconds, "refit": 0.0}, step.reason == ""
        else:
            T_world_drone, held = fit.T_world_sensor @ np.linalg.inv(self.T_drone_sensor), True
            self.predictor.correct(T_world_drone, prior, NONE, self._at_drone(fit))
            step = OdometryStep(scan.stamp_s, T_world_drone, True, "", fit.bars, {})
            seconds = dict.fromkeys(STAGES, 0.0) | {"register": time.perf_counter() - begin}
        put_out = self._put_out(T_world_drone)
        if (held or step.reason == "first scan") and scan.stamp_s >= self._keyframe_s + KEYFRAME_S - 1e-6:
            begin = time.perf_counter()
            self._add_keyframe(scan, T_world_drone, prior, mapped=fit is None)
            seconds["map"] += time.perf_counter() - begin
        if scan.stamp_s >= self._adopt_s - 1e-6:
            begin = time.perf_counter()
            self._adopt(T_world_drone, put_out, prior)
            seconds["refit"] = time.perf_counter() - begin
        return OdometryStep(step.stamp_s, put_out, step.used, step.reason, step.matches, seconds, step.unobserved)

    def map_points(self) -> Array:
        """Means of the voxels of the keyframes, ``(N, 3)`` in the world frame."""
        return self.clouds.map_points()

    def map_segments(self) -> Segments:
        """The bars with sections of the last adjustment; before the first one, those of the odometry by clouds."""
        return self.faces.bars.segments if self.faces else self.clouds.map_segments()

    def _fitted(self, scan: Scan, prior: Array) -> Fit | None:
        """The registration of a scan to front faces, if it holds."""
        if self.faces is None:
            return None
        self.faces.predict(scan.stamp_s)
        s, T_sensor = self.settings.preprocess, self.predictor.pose(scan.stamp_s, prior) @ self.T_drone_sensor
        points = points_in_range(scan, T_sensor, s.crop_m, s.floor_m, SCAN_POINTS)
        if len(points) < POINTS_MIN:
            return None
        known, size = None, len(self._behind)
        if self.inertial:
            arm = T_sensor[:3, :3] @ np.linalg.inv(self.T_drone_sensor)[:3, 3]
            known = information_at(self.inertial.information, -arm)[np.ix_(STEP_OF_TWIST, STEP_OF_TWIST)]
        fit = self.faces.fit(points, T_sensor, known=known)
        apart = pose_step(T_sensor, fit.T_world_sensor, size)
        square = (apart**2 / self.faces.variance).sum() if known is None else SCAN_SHARE * apart @ known @ apart
        if fit.reason or square > GATE[size]:
            return None
        self.faces.accept(fit)
        return fit

    def _at_drone(self, fit: Fit) -> Array:
        """The information ``(6, 6)`` of a registration about turn and place of the drone; zero where only four degrees
        of freedom were free."""
        if not self.inertial:
            return np.zeros((6, 6))
        arm = fit.T_world_sensor[:3, :3] @ np.linalg.inv(self.T_drone_sensor)[:3, 3]
        return information_at(fit.information[np.ix_(TWIST_OF_STEP, TWIST_OF_STEP)], arm)

    def _add_keyframe(self, scan: Scan, T_world_drone: Array, prior: Array, mapped: bool) -> None:
        """Add a scan to the keyframes, and where it is not ``mapped`` yet to the cloud."""
        s, T_sensor = self.settings.preprocess, T_world_drone @ self.T_drone_sensor
        points = points_in_range(scan, T_sensor, s.crop_m, s.floor_m, KEYFRAME_POINTS)
        self._waiting.append((scan, points, T_sensor, prior @ self.T_drone_sensor))
        self._keyframe_s = scan.stamp_s
        if self._adjustment is None:
            self._insert_waiting(np.eye(4))
            self._start_adjustment()
        if mapped:
            return
        cloud = self.clouds.preprocessed(scan, T_world_drone)
        if len(cloud):
            self.clouds.insert(cloud, T_world_drone)

    def _insert_waiting(self, moved: Array) -> None:
        """Hand over the keyframes that wait, ``moved (4, 4)`` in the world as an adjustment moved the one before."""
        for scan, points, T_sensor, prior in self._waiting:
            self.keyframes.add(scan, points, moved @ T_sensor, prior)
        self._waiting = []

    def _start_adjustment(self) -> None:
        """Adjust the keyframes in a thread, if it is time to."""
        period_s = self.settings.refit_s
        self._refit_s = min(self._refit_s, self._stamp_s + period_s)
        if self._stamp_s < self._refit_s - 1e-6:
            return
        self._refit_s, self._adopt_s = self._stamp_s + period_s, self._stamp_s + min(ADOPT_S, period_s)
        self._adjusted_from = self.keyframes.T_world_sensor[-1]
        pool = ThreadPoolExecutor(1)
        self._adjustment = pool.submit(self.keyframes.adjust)
        pool.shutdown(wait=False)

    def _adopt(self, T_world_drone: Array, put_out: Array, prior: Array) -> None:
        """Go on from the result of the adjustment, at the scan at hand."""
        assert self._adjustment is not None
        state = self._adjustment.result()
        self._adjustment, self._adopt_s = None, np.inf
        if state is None:
            self._insert_waiting(np.eye(4))
            return
        moved = state.T_world_sensor[-1] @ np.linalg.inv(self._adjusted_from)
        self._insert_waiting(moved)
        ratio = self.faces.ratio if self.faces else state.sigma_ratio
        self.faces = Locator(state.bars.sectioned(), self._stamp_s, ratio, self.tilt_sigma_rad)
        self.faces.variance = REFITTED_SIGMA[: len(self._behind)] ** 2
        if self.inertial:
            self.inertial.move(moved, REFITTED_SIGMA[TWIST_OF_STEP] ** 2)
        else:
            self.predictor.drift.lose()  # an adjustment is no motion
            self.predictor.drift.correct(moved @ T_world_drone, prior)
        self._behind = pose_step(moved @ T_world_drone, put_out, len(self._behind))

    def _put_out(self, T_world_drone: Array) -> Array:
        """The pose to put out for an estimate: behind it after an adjustment, and catching up."""
        for part, most in ((slice(0, 3), DRIFT_SIGMA[0]), (slice(3, 6), DRIFT_SIGMA[3])):
            size = float(np.linalg.norm(self._behind[part]))
            self._behind[part] *= max(0.0, 1.0 - most / size) if size > 0 else 0.0
        return moved_poses(T_world_drone[None], self._behind[None])[0] if self._behind.any() else T_world_drone
