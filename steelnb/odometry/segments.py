"""Odometry by segments: the report's section 3.2, with the report's correction and others."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.robust import geman_mcclure
from steelnb.core.types import Array, Scan, Segments
from steelnb.fusion import SegmentMap, associate
from steelnb.hough import detect_segments_with
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.odometry.near_side import NearSide
from steelnb.odometry.prediction import PRIOR_SIGMA, DriftPrediction, RegisteredPose
from steelnb.points import preprocess_scan
from steelnb.settings import HoughSettings, OdometrySettings, SegmentSettings


class SegmentOdometry(BaseOdometry):
    """Corrects a drifting pose by the bars of its map.

    ``least_squares_yaw`` corrects position and yaw, moves points by the near-side bias (`near_side`), and estimates the
    drift rate. The other methods correct at most the position, use points as measured, and predict the last correction.
    Roll and pitch are the prior's. If a scan shows no bar of the map, the predicted pose is used.
    """

    kind, method = SegmentSettings, "least_squares_yaw"
    stages = "preprocess", "hough", "match", "map"
    settings: SegmentSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        self.with_yaw = self.settings.method == "least_squares_yaw"
        self.map = SegmentMap(self.settings.fusion)
        self.prediction = DriftPrediction(PRIOR_SIGMA if self.with_yaw else None)
        self.near_side = NearSide()

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        s, T_world_drone = self.settings, self.prediction.pose(prior, scan.stamp_s)
        points = preprocess_scan(scan, T_world_drone, self.T_drone_sensor, s.preprocess)
        if self.with_yaw:
            self.near_side.update(scan.points)
            points = self.near_side.shifted(points, self.T_drone_sensor[:3, 3])
        watch.lap("preprocess")
        found, hough_s = timed(segments_in, points, s.hough)
        observed = found.transformed(T_world_drone)
        watch.lap("hough")
        watch.seconds["hough"] = hough_s
        position = T_world_drone[:3, 3].copy()
        state, matches = CORRECTIONS[s.method](observed, self.map, s.robust_scale_m, position)
        T_world_drone[:3, :3] = Rotation.from_euler("z", state[0]).as_matrix() @ T_world_drone[:3, :3]
        T_world_drone[:3, 3] += state[1:]
        if matches:
            self.prediction.correct(RegisteredPose(T_world_drone))
        else:
            self.prediction.lose()
        watch.lap("match")
        reason = ""
        if s.method == "none":
            reason = "no correction asked for"
        elif not len(observed):
            reason = "no segment seen"
        elif not matches:
            reason = "no segment of the map seen" if len(self.map) else "first scan"
        if len(observed):
            self.map.insert(shifted(observed, state, position))
        watch.lap("map")
        return T_world_drone, reason, matches, 0

    def map_segments(self) -> Segments:
        """The bars of the map."""
        return self.map.segments


def segments_in(points: Array, settings: HoughSettings) -> Segments:
    """Segments of a scan's points ``(N, 3)``; none if there are too few points or their extent is too small."""
    if len(points) < settings.min_votes or not np.ptp(points, axis=0).max() > settings.dx_m:
        return Segments.empty()
    return detect_segments_with(points, settings)


GAIN = 0.5
"""Share of the mean offset by which `average` corrects, as in the report."""
SIGHTINGS_MIN = 2
"""Minimum number of sightings of a bar in `bar_equations`. Chosen on seeds 11 and 12."""
DAMPING_PAIRS = 1.0
"""Weight of a zero correction, in pairs of mean weight. It constrains directions that no bar does. Chosen on seeds 11
and 12."""
ITERATIONS_MAX = 10
TOLERANCE_M = 1e-4
SIGMA_FLOOR_M = 0.02
"""Added in quadrature to a segment's radius: the near-side bias limits how well the axis of a bar is known."""
POINTS_MAX = 100.0
"""More points do not make a segment more accurate: the near-side bias remains. Chosen on seeds 11 and 12."""
PRIOR = np.array([PRIOR_SIGMA[1] ** -2.0] + [PRIOR_SIGMA[0] ** -2.0] * 3)
"""Information of the prediction about (yaw, x, y, z)."""
TURN_ARM_M = 3.0
"""Lever arm that converts a yaw to a shift in the stopping criterion, metres."""


Correction = tuple[Array, int]
"""Yaw (rad) and shift (m) of a pose, ``(4,)``, world frame, and the number of pairs used."""
NO_CORRECTION: Correction = np.zeros(4), 0


def average(observed: Segments, known: SegmentMap, robust_scale_m: float, position: Array) -> Correction:
    """The report's rule: a share (`GAIN`) of the mean offset between matched segments and bars, once per scan.

    Each offset is perpendicular to its bar, so its component along the bar is zero. The mean therefore corrects too
    little if the bars have different directions.
    """
    across, _, _ = _pairs(observed, known)
    return (np.append(0.0, -GAIN * across.mean(axis=0)), len(across)) if len(across) else NO_CORRECTION


def least_squares(observed: Segments, known: SegmentMap, robust_scale_m: float, position: Array) -> Correction:
    """The translation that minimises the distances of the segments perpendicular to their bars.

    Minimises Σ w ‖(I − d dᵀ)(p + x − q)‖² + λ‖x‖² by iteratively reweighted least squares. d is the direction of the
    bar, and w the segment's share of the points times the Geman-McClure weight. Each iteration finds new pairs. λ
    (`DAMPING_PAIRS`, in pairs of mean weight) constrains directions that no bar does.
    """

    def equations(state: Array) -> tuple[Array, Array, int]:
        across, direction, count = _pairs(shifted(observed, state, position), known)
        robust, _ = geman_mcclure((across**2).sum(axis=1), robust_scale_m)
        weight = robust * count / (count.sum() / max(len(count), 1))
        projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        return (weight[:, None, None] * projector).sum(axis=0), (weight[:, None] * across).sum(axis=0), len(across)

    return _solved(equations, np.full(3, DAMPING_PAIRS))


def least_squares_yaw(observed: Segments, known: SegmentMap, robust_scale_m: float, position: Array) -> Correction:
    """Translation and yaw about ``position (3,)`` that align the segments with their bars: `bar_equations`, iterated.

    Gauss–Newton with new pairs in each iteration. The information of the prediction (`PRIOR`) constrains the directions
    that no bar does.
    """

    def equations(state: Array) -> tuple[Array, Array, int]:
        return bar_equations(shifted(observed, state, position), known, robust_scale_m, position + state[1:])

    return _solved(equations, PRIOR)


def _solved(equations: Callable[[Array], tuple[Array, Array, int]], prior: Array) -> Correction:
    """The correction, with or without yaw, by Gauss–Newton with a zero-mean prior of information ``prior (k,)``."""
    state, step, matches = np.zeros(4), np.zeros(4), 0
    free = slice(4 - len(prior), 4)
    for _ in range(ITERATIONS_MAX):
        H, b, matches = equations(state)
        if not matches:
            return NO_CORRECTION
        step[free] = -np.linalg.solve(H + np.diag(prior), b + prior * state[free])
        state = state + step
        if abs(step[0]) * TURN_ARM_M + np.linalg.norm(step[1:]) < TOLERANCE_M:
            break
    return state, matches


def bar_equations(
    observed: Segments, known: SegmentMap, robust_scale_m: float, position: Array
) -> tuple[Array, Array, int]:
    """Normal equations ``H (4, 4)``, ``b (4,)`` of a yaw about ``position (3,)`` and a shift, world frame, from pairs
    of segments and bars, and the number of pairs.

    The residuals of a pair are the distances, perpendicular to the bar, of both ends of the overlap of segment and bar:
    Σ w ρ(‖(I − d dᵀ)(p − q)‖). w is half the number of the segment's points (at most `POINTS_MAX`) over the sum of the
    variance of a point about its axis and `SIGMA_FLOOR_M`². ρ is Geman-McClure with ``robust_scale_m``.
    """
    segments, bars = _paired(observed, known, SIGHTINGS_MIN)
    count = np.minimum(segments.count, POINTS_MAX)
    information = np.repeat(0.5 * count / (segments.radius**2 + SIGMA_FLOOR_M**2), 2)
    end, direction = shared_ends(segments, bars).reshape(-1, 3), np.repeat(bars.direction, 2, axis=0)
    across = across_of(end - np.repeat(bars.start, 2, axis=0), direction)
    robust = 1.0 / (1.0 + (across**2).sum(axis=1) / (robust_scale_m * robust_scale_m))
    weight = information * robust * robust
    # Derivatives of an end with respect to yaw, x, y and z, then their part perpendicular to the bar.
    J = np.tile(np.vstack([np.zeros(3), np.eye(3)]), (len(end), 1, 1))
    J[:, 0, 0], J[:, 0, 1] = position[1] - end[:, 1], end[:, 0] - position[0]
    J = across_of(J, direction[:, None])
    H = (weight[:, None, None] * (J[:, :, None] * J[:, None]).sum(axis=3)).sum(axis=0)
    b = (weight[:, None] * (J * across[:, None]).sum(axis=2)).sum(axis=0)
    return H, b, len(bars)


def across_of(vectors: Array, direction: Array) -> Array:
    """The parts of vectors ``(…, 3)`` perpendicular to unit ``direction (…, 3)``."""
    return np.asarray(vectors - (vectors * direction).sum(axis=-1, keepdims=True) * direction)


def shared_ends(segments: Segments, bars: Segments) -> Array:
    """Ends ``(P, 2, 3)`` of the overlap of each segment with its bar; without one, its nearest end, twice."""
    direction = bars.direction
    run = ((segments.end - segments.start) * direction).sum(axis=1)
    first = ((segments.start - bars.start) * direction).sum(axis=1)
    run = np.where(np.abs(run) < 1e-9, 1e-9, run)
    share = np.sort(np.clip(np.stack([-first, bars.length - first]) / run, 0.0, 1.0), axis=0).T
    return np.asarray(segments.start[:, None] + share[..., None] * (segments.end - segments.start)[:, None])


CORRECTIONS: dict[str, Callable[[Segments, SegmentMap, float, Array], Correction]] = {
    "none": lambda *_: NO_CORRECTION,  # shows the map distorted by drift (the report's Figure 3.4a)
    "average": average,
    "least_squares": least_squares,
    "least_squares_yaw": least_squares_yaw,
}


def shifted(segments: Segments, state: Array, position: Array) -> Segments:
    """The segments after a rotation by yaw ``state[0]`` about ``position (3,)`` and a shift by ``state[1:]``."""
    c, s = np.cos(state[0]), np.sin(state[0])
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = position - T[:3, :3] @ position + state[1:]
    return segments.transformed(T)


def _pairs(observed: Segments, known: SegmentMap) -> tuple[Array, Array, Array]:
    """Offsets ``(P, 3)`` from bar to segment, perpendicular to the bar, directions ``(P, 3)`` of the bars, and numbers
    of points ``(P,)`` of the segments."""
    segments, bars = _paired(observed, known)
    direction = bars.direction
    return across_of(segments.middle - bars.start, direction), direction, segments.count.astype(np.float64)


def _paired(observed: Segments, known: SegmentMap, sightings_min: int = 1) -> tuple[Segments, Segments]:
    """The segments that match a bar with enough sightings, and the bar of each."""
    target = associate(observed, known.segments, known.settings)
    chosen = np.flatnonzero(target >= 0)
    chosen = chosen[known.sightings[target[chosen]] >= sightings_min]
    return observed.take(chosen), known.segments.take(target[chosen])


T = TypeVar("T")
_shared: ContextVar[dict[object, Any] | None] = ContextVar("shared", default=None)


@contextmanager
def shared_segments() -> Iterator[None]:
    """Within this context, equal points are segmented only once for all odometries with equal settings: several methods
    on one flight often have the same points. Each odometry reports the time of the first segmentation."""
    token = _shared.set({})
    try:
        yield
    finally:
        _shared.reset(token)


def timed(segment: Callable[[Array, HoughSettings], T], points: Array, settings: HoughSettings) -> tuple[T, float]:
    """What a function finds in points ``(N, 3)``, and its seconds; within `shared_segments`, those of its first call
    with these arguments."""
    begin, shared = time.perf_counter(), _shared.get()
    if shared is None:  # a single run needs no hash of its points
        return segment(points, settings), time.perf_counter() - begin
    key = segment, hashlib.sha256(np.ascontiguousarray(points).data).digest(), settings
    if key not in shared:
        begin = time.perf_counter()
        shared[key] = segment(points, settings), time.perf_counter() - begin
    found: tuple[T, float] = shared[key]
    return found
