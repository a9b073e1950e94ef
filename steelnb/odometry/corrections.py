"""How far the pose must move for the segments of a scan to fall on the bars of the map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from steelnb.config import OdometrySettings
from steelnb.datatypes import Array, Segments
from steelnb.errors import SettingsError
from steelnb.fusion import SegmentMap, associate


@dataclass(frozen=True)
class Correction:
    """Translation ``offset (3,)`` of the pose in the world frame, metres, and how many pairs gave it."""

    offset: Array
    matches: int


def no_correction(seen: Segments, known: SegmentMap, settings: OdometrySettings) -> Correction:
    """Leave the drift alone: what the map looks like without odometry (the report's Figure 3.4a)."""
    return Correction(np.zeros(3), 0)


def average(seen: Segments, known: SegmentMap, settings: OdometrySettings) -> Correction:
    """The report's rule: a share (``gain``) of the mean distance between matched segments, once a scan.

    Each distance is measured across its bar, and the mean counts the direction along it as zero. So it corrects too
    little as soon as the bars run in different directions.
    """
    across, _, _ = _pairs(seen, known, settings)
    if not len(across):
        return Correction(np.zeros(3), 0)
    return Correction(-settings.gain * across.mean(axis=0), len(across))


def least_squares(seen: Segments, known: SegmentMap, settings: OdometrySettings) -> Correction:
    """The translation that brings the segments onto their bars, each pair counting only across its bar.

    Minimises Σ w ‖(I − d dᵀ)(p + x − q)‖² + λ‖x‖² by iteratively reweighted least squares: d is the bar's direction,
    w the segment's share of the points times the Geman-McClure weight; pairs are chosen anew in each iteration. λ
    (``damping_pairs``, in pairs of mean weight) keeps a direction that no bar constrains where it was.
    """
    offset = np.zeros(3)
    matches = 0
    for _ in range(settings.iterations_max):
        across, direction, count = _pairs(_moved(seen, offset), known, settings)
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


CORRECTIONS: dict[str, Callable[[Segments, SegmentMap, OdometrySettings], Correction]] = {
    "none": no_correction,
    "average": average,
    "least_squares": least_squares,
}


def check_prior(T_world_drone_prior: Array) -> None:
    """Raise `SettingsError` for a pose that is not a finite ``(4, 4)`` array."""
    if np.shape(T_world_drone_prior) != (4, 4) or not np.isfinite(T_world_drone_prior).all():
        raise SettingsError(f"T_world_drone_prior = {T_world_drone_prior!r}: expected a finite (4, 4) array")


def _moved(segments: Segments, offset: Array) -> Segments:
    return Segments(segments.start + offset, segments.end + offset, segments.count, segments.radius)


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
