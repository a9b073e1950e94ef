"""Visual odometry by ORB features with depths from the Time-of-Flight sensor: the report's section 2.1.1.

This is the tracking of ORB-SLAM (Mur-Artal, Montiel, Tardós, IEEE Transactions on Robotics 31, 2015) with a local map,
but without bundle adjustment or loop closure.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.geometry import exp_about, transform_points
from steelnb.core.robust import geman_mcclure
from steelnb.core.types import Array, CameraImages, GreyImage, Imu, IntArray, Scan, project, unproject
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.odometry.inertial import make_prediction
from steelnb.odometry.orb_features import SCALE, Features, features_with_depth, match
from steelnb.odometry.prediction import PRIOR_SIGMA, RegisteredPose
from steelnb.points.ranges import range_sigma_m
from steelnb.registration import FREE, Term
from steelnb.settings import OdometrySettings, OrbSettings

SIGHTINGS_MAX = 50
"""The weight of a new observation stops decreasing after this number, so that positions can still change."""
ANGLE_MIN = 0.6
"""Minimum cosine between the current and the first viewing direction of a landmark."""
MISSES_MAX = 8
"""A landmark is removed when its misses exceed three times its observations by this number."""
LANDMARK = np.dtype(
    [("point", "f8", 3), ("towards", "f8", 3), ("descriptor", "u8", 4), ("octave", "i8"), ("found", "i8"),
     ("missed", "i8"), ("last", "i8")]
)  # fmt: skip
"""``point``, world frame; ``towards``: unit vector to the position of the first observation; ``found`` and ``missed``:
numbers of observations and of expected observations that failed; ``last``: number of the last image that showed it."""


class Expected(NamedTuple):
    """Landmarks expected in a camera's view: ``number (M,)`` in the map, ``pixel (M, 2)`` and ``depth (M,)``,
    metres."""

    number: IntArray
    pixel: Array
    depth: Array


class LandmarkMap:
    """At most ``count_max`` landmarks, ``table (N,)`` of `LANDMARK`. Beyond that, the least recently observed are
    removed."""

    def __init__(self, count_max: int) -> None:
        self.count_max, self.table = count_max, np.zeros(0, LANDMARK)

    def __len__(self) -> int:
        return len(self.table)

    def expected(self, T_world_camera: Array, K: Array, shape: tuple[int, int], range_max_m: float) -> Expected:
        """The landmarks in view of a camera at a pose ``(4, 4)`` whose image has ``shape``, rows and columns."""
        to_camera = T_world_camera[:3, 3] - self.table["point"]
        distance = np.linalg.norm(to_camera, axis=1)
        similar_view = (to_camera * self.table["towards"]).sum(axis=1) > ANGLE_MIN * distance
        index = np.flatnonzero(similar_view & (distance < range_max_m) & (distance > 0.1))
        in_camera = -to_camera[index] @ T_world_camera[:3, :3]
        pixel = project(in_camera, K)
        inside = ((pixel > 0) & (pixel < np.array(shape[::-1]) - 1.0)).all(axis=1)
        return Expected(index[inside], pixel[inside], in_camera[inside, 0])

    def update(self, index: IntArray, point: Array, features: Features, missed: IntArray, now: int) -> None:
        """Update the landmarks ``index (M,)``, observed as ``features`` at ``point (M, 3)`` (NaN if unknown) in image
        ``now``, and those that were ``missed``."""
        table = self.table
        table["descriptor"][index], table["octave"][index] = features.descriptor, features.octave
        table["found"][index] += 1
        table["last"][index] = now
        table["missed"][missed] += 1
        known = np.isfinite(point[:, 0])
        index, point = index[known], point[known]
        weight = 1.0 / np.minimum(table["found"][index], SIGHTINGS_MAX)[:, None]
        table["point"][index] += weight * (point - table["point"][index])

    def insert(self, point: Array, features: Features, position: Array, now: int) -> None:
        """Add landmarks at ``point (M, 3)``, observed as ``features`` from a ``position (3,)`` in image ``now``."""
        new, to_camera = np.zeros(len(point), LANDMARK), position - point
        new["point"], new["towards"] = point, to_camera / np.linalg.norm(to_camera, axis=1)[:, None]
        new["descriptor"], new["octave"] = features.descriptor, features.octave
        new["found"], new["last"] = 1, now
        table = np.concatenate([self.table, new])
        keep = table["missed"] <= 3 * table["found"] + MISSES_MAX
        oldest = np.argsort(np.where(keep, -table["last"], 1), kind="stable")
        keep[oldest[self.count_max :]] = False
        self.table = table[keep]


ITERATIONS_MAX = 15
ROTATION_EPSILON_RAD, TRANSLATION_EPSILON_M = 1e-4, 1e-4
PIXEL_SIGMA = 1.0
"""Standard deviation of a feature's pixel on the finest level, as in ORB-SLAM."""
FRONT_M = 0.05
"""Landmarks with a smaller depth than this are ignored."""


class Solved(NamedTuple):
    """``T_world_drone (4, 4)``; the robust ``weight (N,)`` of each observation, 0 to 1; and the normal matrix ``H (6,
    6)`` of the last step, for twists about the ``centre (3,)``."""

    T_world_drone: Array
    weight: Array
    H: Array
    centre: Array


def solve_pose(
    landmark: Array,
    features: Features,
    K: Array,
    T_drone_camera: Array,
    T_init: Array,
    free: Array,
    terms: list[Term],
    middle: Array,
    scale: float,
) -> Solved | None:
    """The pose of the drone that minimises Σ ρ(‖(Δu, Δv)/σ_px, Δ(1/x)/σ_1/x‖) + the costs of ``terms``.

    ``landmark (N, 3)``, world frame, were observed as ``features``. ρ is the Geman-McClure loss with a ``scale`` in
    standard deviations. The third residual, of the inverse depth, applies where a depth was measured. Up to a factor,
    it is ORB-SLAM2's coordinate in a virtual right camera (Mur-Artal, Tardós, IEEE Transactions on Robotics 33, 2017,
    section III.B). Steps are twists in the span of ``free (6, k)`` about the world position of ``middle (3,)``, a
    point in the drone frame. Returns None if the equations are singular.
    """
    T = T_init
    for _ in range(ITERATIONS_MAX):
        centre = T[:3, :3] @ middle + T[:3, 3]
        H, b = np.zeros((6, 6)), np.zeros(6)
        for term in terms:
            H_term, b_term, _ = term(T, centre)
            H, b = H + H_term, b + b_term
        error, J, weight = linearised_reprojections(landmark, features, K, T @ T_drone_camera, centre, scale)
        weighted = weight[:, None, None] * J
        H = np.vstack([H[None], (weighted[..., None] * J[:, :, None]).reshape(-1, 6, 6)]).sum(axis=0)
        b = np.vstack([b, (weighted * error[..., None]).reshape(-1, 6)]).sum(axis=0)
        try:
            step = -free @ np.linalg.solve(free.T @ H @ free, free.T @ b)
        except np.linalg.LinAlgError:
            return None
        T = exp_about(centre, step) @ T
        if np.linalg.norm(step[:3]) < ROTATION_EPSILON_RAD and np.linalg.norm(step[3:]) < TRANSLATION_EPSILON_M:
            break
    return Solved(T, weight, H, centre) if np.isfinite(T).all() else None


def linearised_reprojections(
    landmark: Array, features: Features, K: Array, T_world_camera: Array, centre: Array, scale: float
) -> tuple[Array, Array, Array]:
    """Residuals ``(N, 3)`` in standard deviations, their derivatives ``(N, 3, 6)`` with respect to a twist (ω, v) of
    the pose about ``centre (3,)``, world frame, and the robust weights ``(N,)``."""
    R, depth = T_world_camera[:3, :3], features.depth
    sigma_px = PIXEL_SIGMA * SCALE ** features.octave.astype(np.float64)
    point = ((landmark - T_world_camera[:3, 3])[:, :, None] * R).sum(axis=1)
    x = np.where(point[:, 0] < FRONT_M, np.nan, point[:, 0])
    # Residuals u = c − f·y/x, v = c − f·z/x and 1/x, and their derivatives with respect to the point.
    error, gradient = np.zeros((len(x), 3)), np.zeros((len(x), 3, 3))
    for k in range(2):
        f = K[k, k] / (x * sigma_px)
        error[:, k] = (K[k, 2] - features.pixel[:, k]) / sigma_px - f * point[:, k + 1]
        gradient[:, k, 0], gradient[:, k, k + 1] = f * point[:, k + 1] / x, -f
    sigma = range_sigma_m(depth) / depth**2
    error[:, 2], gradient[:, 2, 0] = (1 / x - 1 / depth) / sigma, -1 / (x * x * sigma)
    error, gradient = np.nan_to_num(error), np.nan_to_num(gradient)
    weight = np.where(np.isnan(x), 0.0, geman_mcclure((error**2).sum(axis=1), scale)[0])
    # A twist of the pose translates the point in the camera frame by −Rᵀ(ω × arm + v).
    by_shift = -(gradient[:, :, None] * R).sum(axis=3)
    by_turn = np.cross((landmark - centre)[:, None], by_shift)
    return error, np.concatenate([by_turn, by_shift], axis=2), weight


SPACING_PX = 4.0
"""Minimum distance of new landmarks, along u or v, from those already expected in the image."""
FEATURES = 800
"""Maximum number of features per image."""
KEYFRAME_M, TURN_RAD_PER_M = 0.1, 0.5
"""A keyframe is taken after this distance; this many radians of rotation count as one metre."""
SEARCH_PX, HAMMING = 8.0, 60
"""Search radius around the predicted pixel, and maximum Hamming distance of the 256-bit descriptors. An error of 5 cm,
the prior's standard deviation, is 8 pixels of the forward camera at 1.1 m."""
NEAR_PX, NEAR_HAMMING = 3.0, 110
"""The same for the second search, which starts from the result of the first."""
RATIO = 0.85
"""Ratio test: maximum distance of the best descriptor relative to the second best (Lowe, IJCV 60, 2004: 0.8)."""
ROBUST_SCALE = 2.0
"""Scale of the Geman-McClure weights, in standard deviations. An inlier has at most this error."""
INLIER_WEIGHT, _ = geman_mcclure(np.square(ROBUST_SCALE), ROBUST_SCALE)
MATCHES_MIN = 8
"""Minimum number of matches: four for a pose, and four to check it."""
LANDMARKS_MAX = 10_000
"""Maximum number of landmarks; beyond it, the least recently observed ones are removed."""
NO_IMAGES = CameraImages(np.zeros(0), (), np.eye(3), np.eye(4))


class Tracked(NamedTuple):
    """The result of one image: ``T_world_drone (4, 4)``, or the predicted pose and the ``reason`` of the failure; the M
    landmarks ``expected`` in view; ``found (M,)``, the feature that matches each, −1 for none; ``inlier (M,)``, whether
    the match agrees with the pose; and the normal matrix ``H (6, 6)`` of the solve, for twists about the ``centre
    (3,)``."""

    T_world_drone: Array
    reason: str
    expected: Expected
    found: IntArray
    inlier: NDArray[np.bool_]
    H: Array = np.zeros((6, 6))
    centre: Array = np.zeros(3)

    @property
    def matches(self) -> int:
        """Number of landmarks that agree with the pose."""
        return int(np.count_nonzero(self.inlier))


class OrbOdometry(BaseOdometry):
    """Corrects a drifting pose by the image features at each scan, matched to a map of landmarks.

    Landmarks farther away than ``preprocess.crop_m`` are ignored. Reading or rendering an image is not measured.

    Parameters
    ----------
    imu : readings in the drone frame; used, up to the current scan, if the settings have ``inertial``.
    images : images of a camera on the drone; each scan uses the last one before or at its stamp. A scan without one
        follows the prior.
    """

    kind, method, uses = OrbSettings, "orb", ("imu", "images")
    stages = "features", "track", "map"
    settings: OrbSettings

    def __init__(
        self,
        settings: OdometrySettings | None = None,
        T_drone_sensor: Array | None = None,
        imu: Imu | None = None,
        images: CameraImages | None = None,
    ) -> None:
        super().__init__(settings, T_drone_sensor)
        self.images = NO_IMAGES if images is None else images
        self.T_camera_sensor = np.linalg.inv(self.images.T_drone_camera) @ self.T_drone_sensor
        self.map, self.count = LandmarkMap(LANDMARKS_MAX), 0
        self.T_keyframe: Array | None = None
        self.prediction = make_prediction(PRIOR_SIGMA, 0.0, self.settings.inertial, imu)
        self.free = FREE["se3" if self.prediction.tilted else "xyz_yaw"]

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        number = self.images.at(scan.stamp_s)
        image = None if number is None else self.images.images[number]
        T_predicted = self.prediction.pose(prior, scan.stamp_s)
        if image is None:
            self.prediction.lose()
            return T_predicted, "no image", 0, 0
        features = features_with_depth(image, scan.points, self.T_camera_sensor, self.images.K, FEATURES)
        watch.lap("features")
        tracked = self._solve(features, image, T_predicted, T_predicted, SEARCH_PX, HAMMING)
        if not tracked.reason:
            second = self._solve(features, image, T_predicted, tracked.T_world_drone, NEAR_PX, NEAR_HAMMING)
            tracked = tracked if second.reason else second
        watch.lap("track")
        T_world_drone, reason = tracked.T_world_drone, tracked.reason
        if reason:
            self.prediction.lose()
        else:
            arm = T_world_drone[:3, 3] - tracked.centre
            self.prediction.correct(RegisteredPose(T_world_drone, H=tracked.H, arm=arm))
            inlier, landmark = tracked.inlier, tracked.expected.number
            observed = features.take(tracked.found[inlier])
            points = self._world(observed, T_world_drone)
            self.map.update(landmark[inlier], points, observed, landmark[~inlier], self.count)
        if reason or self._is_keyframe(T_world_drone):
            self._extend(features, image, T_world_drone)
        self.count += 1
        watch.lap("map")
        return T_world_drone, reason, tracked.matches, 0

    def map_points(self) -> Array:
        """Landmarks with at least two observations, ``(N, 3)`` in the world frame."""
        table = self.map.table
        return table["point"][table["found"] > 1]

    def _solve(
        self, features: Features, image: GreyImage, T_predicted: Array, T_init: Array, search_px: float,
        hamming_max: int,
    ) -> Tracked:  # fmt: skip
        """The pose from the landmarks that are expected at ``T_init`` and match features."""
        expected = self._expected(T_init, image)
        found = match(
            *features, expected.pixel, self.map.table["octave"][expected.number], expected.depth,
            self.map.table["descriptor"][expected.number], search_px, hamming_max, RATIO,
        )  # fmt: skip
        inlier = found >= 0
        failed = Tracked(T_predicted, "", expected, found, inlier)
        if len(features.pixel) < MATCHES_MIN:
            return failed._replace(reason="too few features")
        if not len(self.map):
            return failed._replace(reason="first scan")
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches")
        matched, landmark = features.take(found[inlier]), self.map.table["point"][expected.number[inlier]]
        in_drone = (landmark - T_predicted[:3, 3]) @ T_predicted[:3, :3]
        solved = solve_pose(
            landmark, matched, self.images.K, self.images.T_drone_camera, T_init, self.free,
            self.prediction.terms(T_predicted, in_drone), in_drone.mean(axis=0), ROBUST_SCALE,
        )  # fmt: skip
        if solved is None:
            return failed._replace(reason="singular")
        inlier[inlier] = solved.weight >= INLIER_WEIGHT
        if failed.matches < MATCHES_MIN:
            return failed._replace(reason="too few matches agree")
        return failed._replace(T_world_drone=solved.T_world_drone, H=solved.H, centre=solved.centre)

    def _expected(self, T_world_drone: Array, image: GreyImage) -> Expected:
        """The landmarks expected in an image at a pose."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        return self.map.expected(T_world_camera, self.images.K, image.shape, self.settings.preprocess.crop_m)

    def _world(self, features: Features, T_world_drone: Array) -> Array:
        """Positions ``(N, 3)`` of features in the world frame, NaN without a depth."""
        T_world_camera = T_world_drone @ self.images.T_drone_camera
        points = features.depth[:, None] * unproject(features.pixel, self.images.K)
        return transform_points(T_world_camera, points)

    def _is_keyframe(self, T_world_drone: Array) -> bool:
        T_last = self.T_keyframe
        if T_last is None:
            return True
        distance_m = np.linalg.norm(T_world_drone[:3, 3] - T_last[:3, 3])
        angle_rad = np.linalg.norm(T_world_drone[:3, :3] - T_last[:3, :3]) / 2**0.5
        return bool(distance_m + angle_rad / TURN_RAD_PER_M >= KEYFRAME_M)

    def _extend(self, features: Features, image: GreyImage, T_world_drone: Array) -> None:
        """Add landmarks at features with a depth, where no landmark is expected."""
        self.T_keyframe = T_world_drone
        new = np.flatnonzero(np.isfinite(features.depth))
        known = cKDTree(self._expected(T_world_drone, image).pixel)
        new = new[known.query(features.pixel[new], p=np.inf)[0] >= SPACING_PX]
        if len(new):
            position = (T_world_drone @ self.images.T_drone_camera)[:3, 3]
            added = features.take(new)
            self.map.insert(self._world(added, T_world_drone), added, position, self.count)
