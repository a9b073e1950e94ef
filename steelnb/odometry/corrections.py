"""How far the pose must move for the segments of a scan to fall on the bars of the map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from steelnb.config import OdometrySettings
from steelnb.datatypes import Array, Segments
from steelnb.fusion import SegmentMap, associate


@dataclass(frozen=True)
class Correction:
    """How the pose is to move in the world frame: by ``offset (3,)`` metres, turned by ``yaw_rad`` about itself.

    ``matches``: how many pairs gave it.
    """

    offset: Array
    matches: int
    yaw_rad: float = 0.0


def no_correction(seen: Segments, known: SegmentMap, settings: OdometrySettings, position: Array) -> Correction:
    """Leave the drift alone: what the map looks like without odometry (the report's Figure 3.4a)."""
    return Correction(np.zeros(3), 0)


def average(seen: Segments, known: SegmentMap, settings: OdometrySettings, position: Array) -> Correction:
    """The report's rule: a share (``gain``) of the mean distance between matched segments, once a scan.

    Each distance is measured across its bar, and the mean counts the direction along it as zero. So it corrects too
    little as soon as the bars run in different directions.
    """
    across, _, _ = _pairs(seen, known, settings)
    if not len(across):
        return Correction(np.zeros(3), 0)
    return Correction(-settings.gain * across.mean(axis=0), len(across))


def least_squares(seen: Segments, known: SegmentMap, settings: OdometrySettings, position: Array) -> Correction:
    """The translation that brings the segments onto their bars, each pair counting only across its bar.

    Minimises Σ w ‖(I − d dᵀ)(p + x − q)‖² + λ‖x‖² by iteratively reweighted least squares: d is the bar's direction,
    w the segment's share of the points times the Geman-McClure weight; pairs are chosen anew in each iteration. λ
    (``damping_pairs``, in pairs of mean weight) keeps a direction that no bar constrains where it was.
    """
    offset = np.zeros(3)
    matches = 0
    for _ in range(settings.iterations_max):
        across, direction, count = _pairs(moved(seen, np.append(0.0, offset), position), known, settings)
        matches = len(across)
        if not matches:
            return Correction(np.zeros(3), 0)
        robust = 1.0 / (1.0 + (across**2).sum(axis=1) / settings.robust_scale_m**2) ** 2
        weight = robust * count / count.mean()
        projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        H = (weight[:, None, None] * projector).sum(axis=0) + settings.damping_pairs * np.eye(3)
        b = (weight[:, None] * across).sum(axis=0) + settings.damping_pairs * offset
        step = -np.linalg.solve(H, b)
        offset = offset + step
        if np.linalg.norm(step) < settings.tolerance_m:
            break
    return Correction(offset, matches)


def least_squares_yaw(seen: Segments, known: SegmentMap, settings: OdometrySettings, position: Array) -> Correction:
    """Translation and yaw about ``position (3,)`` that bring the segments onto their bars: `bar_equations`, iterated.

    Gauss–Newton with pairs chosen anew in each iteration. The priors ``prior_sigma_m`` and ``prior_sigma_rad`` hold
    what no bar constrains.
    """
    prior = np.array([settings.prior_sigma_rad**-2.0] + [settings.prior_sigma_m**-2.0] * 3)
    state = np.zeros(4)
    matches = 0
    for _ in range(settings.iterations_max):
        bars = bar_equations(moved(seen, state, position), known, settings, position + state[1:])
        matches = bars.matches
        if not matches:
            return Correction(np.zeros(3), 0)
        step = -np.linalg.solve(bars.H + np.diag(prior), bars.b + prior * state)
        state = state + step
        if abs(step[0]) * TURN_ARM_M + np.linalg.norm(step[1:]) < settings.tolerance_m:
            break
    return Correction(state[1:], matches, float(state[0]))


TURN_ARM_M = 3.0
"""The distance at which a yaw is compared with a shift, metres."""


@dataclass(frozen=True)
class BarEquations:
    """Normal equations ``H (4, 4)``, ``b (4,)`` of (yaw, x, y, z), their loss, and the number of pairs."""

    H: Array
    b: Array
    loss: float
    matches: int


def bar_equations(seen: Segments, known: SegmentMap, settings: OdometrySettings, position: Array) -> BarEquations:
    """What the segments say of a yaw about ``position (3,)`` and a shift, both in the world frame.

    A pair counts with both ends of what segment and bar share along the bar, each by its distance across the bar:
    Σ w ρ(‖(I − d dᵀ)(p − q)‖), where w is half the segment's points (at most ``points_max``) over the variance of a
    point about its axis plus ``sigma_floor_m``², and ρ Geman-McClure with ``robust_scale_m``.
    """
    target = associate(seen, known.segments, known.settings)
    chosen = np.flatnonzero(target >= 0)
    chosen = chosen[known.sightings[target[chosen]] >= settings.sightings_min]
    bars, segments = known.segments.take(target[chosen]), seen.take(chosen)
    direction = bars.direction
    ends = shared_ends(segments, bars)
    apart = ends - bars.start[:, None]
    across = apart - (apart * direction[:, None]).sum(axis=2)[..., None] * direction[:, None]
    count = np.minimum(segments.count, settings.points_max)
    information = 0.5 * count / (segments.radius**2 + settings.sigma_floor_m**2)
    square = (across**2).sum(axis=2)
    robust = 1.0 / (1.0 + square / settings.robust_scale_m**2)
    weight = information[:, None] * robust**2
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    arm = ends - position
    J = np.zeros((*ends.shape, 4))  # how a step moves an end; the projector is applied to what it is multiplied with
    J[..., 0, 0], J[..., 1, 0] = -arm[..., 1], arm[..., 0]
    J[..., 1:] = np.eye(3)
    H = np.einsum("pe,peik,pij,pejl->kl", weight, J, projector, J, optimize=True)
    b = np.einsum("pe,peik,pei->k", weight, J, across)
    loss = 0.5 * float((information[:, None] * square * robust).sum())
    return BarEquations(H, b, loss, len(chosen))


def shared_ends(segments: Segments, bars: Segments) -> Array:
    """Ends ``(P, 2, 3)`` of the part of each segment that lies beside its bar; its nearest end twice if none does."""
    direction = bars.direction
    run = ((segments.end - segments.start) * direction).sum(axis=1)
    first = ((segments.start - bars.start) * direction).sum(axis=1)
    run = np.where(np.abs(run) < 1e-9, 1e-9, run)
    share = np.sort(np.clip(np.stack([-first, bars.length - first]) / run, 0.0, 1.0), axis=0).T
    return np.asarray(segments.start[:, None] + share[..., None] * (segments.end - segments.start)[:, None])


CORRECTIONS: dict[str, Callable[[Segments, SegmentMap, OdometrySettings, Array], Correction]] = {
    "none": no_correction,
    "average": average,
    "least_squares": least_squares,
    "least_squares_yaw": least_squares_yaw,
}


def moved(segments: Segments, state: Array, position: Array) -> Segments:
    """The segments after a turn by yaw ``state[0]`` about ``position (3,)`` and a shift by ``state[1:]``."""
    c, s = np.cos(state[0]), np.sin(state[0])
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = position - T[:3, :3] @ position + state[1:]
    return segments.transformed(T)


def _pairs(seen: Segments, known: SegmentMap, settings: OdometrySettings) -> tuple[Array, Array, Array]:
    """Offsets across ``(P, 3)`` from bar to segment, directions ``(P, 3)`` of the bars, counts ``(P,)``."""
    target = associate(seen, known.segments, known.settings)
    chosen = np.flatnonzero(target >= 0)
    chosen = chosen[known.sightings[target[chosen]] >= settings.sightings_min]
    bars = known.segments.take(target[chosen])
    direction = bars.direction
    apart = seen.middle[chosen] - bars.start
    across = apart - (apart * direction).sum(axis=1)[:, None] * direction
    return across, direction, seen.count[chosen].astype(np.float64)
