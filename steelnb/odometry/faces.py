"""Odometry by the front faces of bars found during the flight.

A map of points is biased: a voxel averages over the faces that it contains, so a registration depends on the side from
which the scan sees them. A bar with a known section has no such bias.

1. Every `KEYFRAME_S` a scan becomes a keyframe.
2. Every `REFIT_S`, a second thread finds bars in all keyframes, and adjusts bars and poses together
   (`steelnb.odometry.faces`). It also does whatever else can wait until then, for short frames.
3. Each scan is registered to the front faces of these bars (`steelnb.odometry.scan_to_bars`).
4. Odometry by clouds takes over where the bars do not determine the pose: at the start, and in unmapped areas.
"""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.geometry import information_at, moved_poses, pose_step
from steelnb.core.types import Array, Imu, Scan, Segments, Trajectory
from steelnb.fusion.adjustment.factors import DRIFT_PERIOD_S, DRIFT_SIGMA, TILT_SIGMA_RAD, drift_ratio
from steelnb.fusion.adjustment.imu_factors import Inertial
from steelnb.fusion.adjustment.mount import Mount
from steelnb.fusion.adjustment.problem import Problem, pose_size
from steelnb.fusion.adjustment.smooth import adjust
from steelnb.fusion.bars import VOXEL_M
from steelnb.fusion.mapped_scans import MappedScans, insert_scan
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.inertial import InertialPrediction
from steelnb.odometry.prediction import LastingError, RegisteredPose
from steelnb.odometry.scan_to_bars import MATCHED_BARS_MIN, SCAN_POINTS_MIN, Fit, Locator, points_in_range
from steelnb.points import VoxelMap
from steelnb.settings import FaceSettings, ImuSettings, OdometrySettings, StructureSettings

KEYFRAME_S = 1.0
REFIT_S = 10.0
"""Time between two adjustments of keyframes and bars."""
ADOPT_S = 2.0
"""Time of flight from the start of an adjustment until its result is used. It is fixed, so that estimates do not depend
on the machine's speed; an adjustment takes up to 2 s on one core of a laptop."""
SCAN_POINTS, KEYFRAME_POINTS = 2000, 4000
"""Number of points registered from a scan, and kept of a keyframe to fit bars to."""
FACE_ERROR = LastingError(sigma_rad=0.003, sigma_m=0.03, time_s=20.0)
"""Lasting error of registrations to bars, which are adjusted together with the poses that observed them. Chosen like
`clouds.CLOUD_ERROR`."""
REFITTED_SIGMA = np.array([0.001, 0.001, 0.001, 0.003, 0.003, 0.003])
"""Standard deviation of the latest pose relative to the adjusted bars, radians and metres."""
GATE = {4: 18.5, 6: 22.5}
"""Degrees of freedom → gate on the squared Mahalanobis distance of a registration from its prediction: the 99.9 %
quantile of chi-squared. A larger distance means that wrongly fitted bars led the registration astray."""


class FaceOdometry(BaseOdometry):
    """Corrects a drifting pose by the front faces of bars, with odometry by clouds as the fallback.

    After an adjustment, the output pose catches up gradually, by at most `DRIFT_SIGMA` per scan, so it never jumps.
    Adjustments also use the readings of an ``imu``. The fallback has the same settings and shares its prediction. If
    the settings say that the mount is not known, adjustments estimate it, and ``T_drone_sensor`` is their latest one.
    """

    kind, method, uses = FaceSettings, "faces", ("imu",)
    stages = (*CloudOdometry.stages, "refit")
    settings: FaceSettings

    def __init__(
        self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None, imu: Imu | None = None
    ) -> None:
        super().__init__(settings, T_drone_sensor)
        self.clouds = CloudOdometry(self.settings, self.T_drone_sensor, imu)
        self.prediction = self.clouds.prediction
        self.T_sensor_drone = np.linalg.inv(self.T_drone_sensor)
        self.inertial = self.prediction if isinstance(self.prediction, InertialPrediction) else None
        self.tilt_sigma_rad = self.settings.tilt_sigma_rad or (TILT_SIGMA_RAD if self.inertial else 0.0)
        self.keyframes = Keyframes(StructureSettings.of(self.settings.preprocess), self.tilt_sigma_rad)
        if self.inertial:
            self.keyframes.readings = self.inertial.imu, self.inertial.noise, self.T_drone_sensor
        sigma = self.settings.mount.sigma
        sigma[6] = 0.0  # a delay needs the prior between scans
        if sigma.any():
            self.keyframes.mount = Mount.known_as(self.T_drone_sensor, sigma)
        self.faces: Locator | None = None
        self._stamp_s, self._keyframe_s, self._refit_s = -np.inf, -np.inf, np.inf
        # The step from the estimate to the output pose.
        self._lag = np.zeros(pose_size(self.tilt_sigma_rad))
        self._adjustment: Future[tuple[Problem, Locator] | None] | None = None
        self._adopt_s, self._adjusted_from = np.inf, np.eye(4)
        self._waiting: list[tuple[Scan, Array, Array, Array]] = []  # keyframes since the start of the last adjustment

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        if not scan.stamp_s > self._stamp_s:  # assume the usual rate for scans without stamps
            scan = Scan(self._stamp_s + DRIFT_PERIOD_S, scan.points, scan.fault)
        self._stamp_s = scan.stamp_s
        fit = self._located(scan, prior)
        if fit is None:
            T_world_drone, reason, matches, unobserved = self.clouds.corrected(scan, prior, watch)
        else:
            T_world_drone, reason, matches, unobserved = fit.T_world_sensor @ self.T_sensor_drone, "", fit.bars, 0
            arm = fit.T_world_sensor[:3, :3] @ self.T_sensor_drone[:3, 3]
            self.prediction.correct(RegisteredPose(T_world_drone, H=fit.information, arm=arm))
            watch.lap("register")
        output = self._output_pose(self.prediction.levelled(T_world_drone))
        if reason in ("", "first scan") and scan.stamp_s >= self._keyframe_s + KEYFRAME_S - 1e-6:
            self._add_keyframe(scan, T_world_drone, prior, mapped=fit is None)
            watch.lap("map")
        if scan.stamp_s >= self._adopt_s - 1e-6:
            self._adopt(T_world_drone, output)
            watch.lap("refit")
        return output, reason, matches, unobserved

    def _covariance(self, T_world_drone: Array) -> Array | None:
        return self.prediction.covariance(T_world_drone)

    def map_points(self) -> Array:
        """The map of the odometry by clouds, ``(N, 3)`` in the world frame."""
        return self.clouds.map_points()

    def map_segments(self) -> Segments:
        """The bars of the last adjustment that have a section and are no plates; none before the first one."""
        return self.faces.bars.take(self.faces.bars.is_bar).segments if self.faces else Segments.empty()

    def _located(self, scan: Scan, prior: Array) -> Fit | None:
        """Registration of a scan to front faces; None if it is rejected."""
        if self.faces is None:
            return None
        self.faces.predict(scan.stamp_s)
        s, T_predicted = self.settings.preprocess, self.prediction.pose(prior, scan.stamp_s, FACE_ERROR)
        T_sensor = T_predicted @ self.T_drone_sensor
        points = points_in_range(scan, T_sensor, s.crop_m, s.floor_m, SCAN_POINTS)
        if len(points) < SCAN_POINTS_MIN:
            return None
        known, size = None, len(self._lag)
        if self.inertial:
            known = information_at(self.inertial.information, -(T_sensor[:3, :3] @ self.T_sensor_drone[:3, 3]))
        fit = self.faces.fit(points, T_sensor, known=known)
        error = pose_step(T_sensor, fit.T_world_sensor, size)
        square = (error**2 / self.faces.variance).sum() if known is None else error @ known @ error
        if fit.reason or square > GATE[size]:
            return None
        self.faces.accept(fit)
        return fit

    def _add_keyframe(self, scan: Scan, T_world_drone: Array, prior: Array, mapped: bool) -> None:
        """Add a scan to the keyframes, and to the map of points unless it is ``mapped`` already."""
        s, T_sensor = self.settings.preprocess, T_world_drone @ self.T_drone_sensor
        points = points_in_range(scan, T_sensor, s.crop_m, s.floor_m, KEYFRAME_POINTS)
        of_prior = prior if self.keyframes.mount else prior @ self.T_drone_sensor
        self._waiting.append((scan, points, T_sensor, of_prior))
        self._keyframe_s = scan.stamp_s
        if self._adjustment is None:
            self._start_adjustment()
        if mapped:
            return
        cloud = self.clouds.preprocessed(scan, T_world_drone)
        if len(cloud):
            self.clouds.insert(cloud, T_world_drone)

    def _start_adjustment(self) -> None:
        """Start an adjustment of the keyframes in a thread, once in `REFIT_S`."""
        self._refit_s = min(self._refit_s, self._stamp_s + REFIT_S)
        if self._stamp_s < self._refit_s - 1e-6:
            return
        self._refit_s, self._adopt_s = self._stamp_s + REFIT_S, self._stamp_s + min(ADOPT_S, REFIT_S)
        *_, self._adjusted_from, _ = self._waiting[-1]
        pool = ThreadPoolExecutor(1)
        self._adjustment = pool.submit(self._adjust, self._waiting)
        pool.shutdown(wait=False)
        self._waiting = []

    def _adjust(self, taken: list[tuple[Scan, Array, Array, Array]]) -> tuple[Problem, Locator] | None:
        """Add the keyframes ``taken`` and adjust all; None if there are too few bars."""
        for keyframe in taken:
            self.keyframes.add(*keyframe)
        state = self.keyframes.adjust()
        if state is None:
            return None
        return state, Locator(state.bars.take(state.bars.has_section), tilt_sigma_rad=self.tilt_sigma_rad)

    def _adopt(self, T_world_drone: Array, output: Array) -> None:
        """Continue from the result of the adjustment, at the current scan."""
        assert self._adjustment is not None
        adjusted = self._adjustment.result()
        self._adjustment, self._adopt_s = None, np.inf
        if adjusted is None:
            return
        state, faces = adjusted
        T_correction = state.T_world_sensor[-1] @ np.linalg.inv(self._adjusted_from)
        T_sensor_sensor = np.eye(4)
        if state.mount:
            T_correction = state.poses[-1] @ np.linalg.inv(self._adjusted_from @ self.T_sensor_drone)
            T_sensor_sensor = self.T_sensor_drone @ state.mount.T_drone_sensor
            self.T_drone_sensor = self.clouds.T_drone_sensor = state.mount.T_drone_sensor
            self.T_sensor_drone = np.linalg.inv(self.T_drone_sensor)
        self._waiting = [
            (scan, points, T_correction @ T @ T_sensor_sensor, prior) for scan, points, T, prior in self._waiting
        ]
        faces.ratio = self.faces.ratio if self.faces else state.sigma_ratio
        faces.stamp_s, faces.variance = self._stamp_s, REFITTED_SIGMA[-len(self._lag) :] ** 2
        self.faces = faces
        self.prediction.adjust(T_correction, REFITTED_SIGMA**2)
        self._lag = pose_step(T_correction @ T_world_drone, output, len(self._lag))

    def _output_pose(self, T_world_drone: Array) -> Array:
        """The output pose for an estimate, which lags behind after an adjustment and catches up."""
        for part, most in ((slice(-3, None), DRIFT_SIGMA[-1]), (slice(0, -3), DRIFT_SIGMA[0])):
            size = float(np.linalg.norm(self._lag[part]))
            self._lag[part] *= max(0.0, 1.0 - most / size) if size > 0 else 0.0
        return moved_poses(T_world_drone[None], self._lag[None])[0] if self._lag.any() else T_world_drone


FITS, STAGES = 2, ((1, 2),)
"""Number of times that bars are fitted before an adjustment, and its stages (`smooth.Stages`)."""
MOUNT_STAGES = ((1, 4),)
"""With an unknown mount, the first adjustment has far to go."""
DRIFT_KNOWN_S = 30.0
"""Time of flight after which the level of the drift is measured, if the mount is unknown."""
BLURRED_RAD, BLURRED_M = 0.005, 0.02
"""A larger change of the mount has blurred the voxels of earlier keyframes."""
KEYFRAMES_MAX, RECENT = 400, 100
"""Above this number every second keyframe is dropped, except the first and the most recent ones. This bounds the time
of an adjustment."""


class Keyframes:
    """K scans of a flight, accumulated in voxels at the poses at which they were added.

    ``T_world_sensor (K, 4, 4)``: their poses after the last adjustment; ``settings``: of the bars; ``tilt_sigma_rad``:
    standard deviation of the prior's roll and pitch (`Problem`); ``readings``: of an IMU, with its data sheet and the
    sensor's mount ``T_drone_sensor (4, 4)``.
    """

    def __init__(self, settings: StructureSettings, tilt_sigma_rad: float = 0.0) -> None:
        self.settings, self.tilt_sigma_rad = settings, tilt_sigma_rad
        self.readings: tuple[Imu, ImuSettings, Array] | None = None
        self.mount: Mount | None = None
        self._drift: Array | float = 1.0
        self.voxels = VoxelMap(VOXEL_M)
        self.scans: list[Scan] = []
        self.T_world_sensor, self._prior = np.zeros((2, 0, 4, 4))
        self._before: Problem | None = None

    def add(self, scan: Scan, points: Array, T_world_sensor: Array, prior: Array) -> None:
        """Add a scan with its pose ``(4, 4)``. Bars are fitted to its ``points (N, 3)``, sensor frame. ``prior (4, 4)``
        is the sensor's drifting pose; drift begins at the first one."""
        insert_scan(self.voxels, scan, T_world_sensor, self.settings)
        self.scans.append(Scan(scan.stamp_s, points))
        self.T_world_sensor = np.concatenate([self.T_world_sensor, T_world_sensor[None]])
        self._prior = np.concatenate([self._prior, prior[None]])
        if len(self.scans) > KEYFRAMES_MAX:
            kept = [0, *range(2, KEYFRAMES_MAX - RECENT, 2), *range(KEYFRAMES_MAX - RECENT, len(self.scans))]
            self.scans = [self.scans[k] for k in kept]
            self.T_world_sensor, self._prior = self.T_world_sensor[kept], self._prior[kept]

    def adjust(self) -> Problem | None:
        """Find bars, and adjust bars and poses together (`adjust`); None if there are too few bars."""
        if not len(self.voxels):
            return None
        mapped = MappedScans(self.scans, self.T_world_sensor, self.voxels, self.settings)
        stamp_s, inertial = np.array([scan.stamp_s for scan in self.scans]), None
        if self.readings:
            imu, noise, mount = self.readings
            of_drone = mount if self.mount is None else self.mount.T_drone_sensor
            inertial = Inertial.started(
                imu, noise, mount if self.mount is None else np.eye(4),
                Trajectory(stamp_s, self.T_world_sensor @ np.linalg.inv(of_drone)),
            )  # fmt: skip
        if self.mount:
            self.mount = self.mount.at(Trajectory(stamp_s, self._prior))
        try:
            state, _ = adjust(
                mapped, self._prior, stamp_s, STAGES if self.mount is None else MOUNT_STAGES, FITS, every=1,
                bars_min=MATCHED_BARS_MIN, tilt_sigma_rad=self.tilt_sigma_rad, inertial=inertial, before=self._before,
                mount=self.mount, drift=self._drift,
            )  # fmt: skip
        except InputError:
            return None
        self.T_world_sensor, self._before = state.T_world_sensor, state
        if state.mount:
            self._follow(state, stamp_s)
        return state

    def _follow(self, state: Problem, stamp_s: Array) -> None:
        """Continue with the mount of an adjustment. Voxels that a wrong one has blurred are made anew."""
        assert self.mount is not None
        assert state.mount is not None
        step = np.abs(state.mount.error - self.mount.error)
        self.mount = state.mount
        if np.ndim(self._drift) == 0 and np.ptp(stamp_s) > DRIFT_KNOWN_S:
            self._drift = drift_ratio(state.poses, self._prior, stamp_s, len(self.mount.free))
        if step[:3].max() < BLURRED_RAD and step[3:6].max() < BLURRED_M:
            return
        self.voxels = VoxelMap(VOXEL_M)
        for scan, T in zip(self.scans, self.T_world_sensor, strict=True):
            insert_scan(self.voxels, scan, T, self.settings)
        self._before = None
