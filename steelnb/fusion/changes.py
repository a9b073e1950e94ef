"""Changes of a known structure, bar by bar, from the scans of a new flight that was localised in it.

A bar is missing where rays went through its place, and stands where they ended there; what is hidden by others or out
of sight tells nothing. It has moved or is bent where the front faces and the outline of its points lie beside the
mapped ones by more than both flights' errors. Bars that no mapped one explains are new.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from steelnb.errors import InputError
from steelnb.fusion.displacement import BENT, SIGMA_BOW_M, displaced
from steelnb.fusion.known import KnownBars
from steelnb.fusion.reconstruct import reconstruct, sensor_poses
from steelnb.fusion.structure import Structure
from steelnb.fusion.views import Views, pinhole
from steelnb.settings import StructureSettings
from steelnb.types import Array, IntArray, Scan, Segments

SIGNIFICANCE = 0.05
"""A bar has changed if its p-value, corrected for the number of bars, is smaller."""
SCANS_ALIKE, VIEWS_MIN, THROUGH_SHARE, GONE_SHARE = 5, 2, 0.03, 0.25
"""So many scans that see a bar count as one view; fewer views tell nothing; of a bar that stands, at most this share of
the views goes through it, of one that is missing more than the last, and of one that has moved something between. All
settings were chosen on the development seeds 11 and 12."""
KINDS = ("same", "missing", "moved", "bent", "not seen", "new")


@dataclass(frozen=True)
class Changes:
    """The bars of a map in a later flight.

    ``kind``: for each of the B bars of the map "same", "missing", "moved", "bent" or "not seen", then "new" for each
    bar of ``new``, which the map does not hold. ``offset_m``: mean offset across a bar, of a bent one that of its
    middle, of a new one the distance of its middle from the nearest bar of the map; ``sigma_m`` its standard deviation;
    both NaN where a bar is missing or not measured. ``significance``: p-value of the hypothesis that the bar is as it
    was, corrected for the number of bars; NaN where it was not seen. All ``(B + new,)``.
    """

    known: Structure
    new: Structure
    kind: tuple[str, ...]
    offset_m: Array
    sigma_m: Array
    significance: Array

    def of(self, kind: str) -> IntArray:
        """The bars of a kind, counted through the map and then the new ones."""
        return np.flatnonzero(np.array(self.kind) == kind)

    @property
    def segments(self) -> Segments:
        """The axes of the map's bars and then of the new ones."""
        return Segments.joined((self.known.segments, self.new.segments))


def find_changes(
    known: Structure,
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Changes:
    """Compare a known structure with the scans of a later flight.

    Parameters
    ----------
    known: the map; world frame, metres. Raises `InputError` for one without bars.
    scans: K scans, points in the sensor frame, NaN for no return. That a bar is missing can be told from images
        ``(H, W, 3)`` of a pinhole camera alone, since the rays without a return must be known.
    T_world_drone: ``(K, 4, 4)``, poses in the frame of the map, as `KnownStructureOdometry` gives them. Raises
        `InputError` for poses that do not fit the scans or are not finite.
    T_drone_sensor: ``(4, 4)``, the sensor's mount; by default the drone frame itself.
    settings: the floor and the range; what a new bar is.
    """
    settings, bars = settings or StructureSettings(), KnownBars.of(known)
    T = sensor_poses(T_world_drone, T_drone_sensor, len(scans))
    views = Views(bars, settings)
    camera = pinhole(scans)
    for k, scan in enumerate(scans):
        views.add(scan, T[k], camera)
    kind, p = np.full(len(bars), "same", dtype=object), np.ones(len(bars))
    offset_m, sigma_m, p_moved, p_bent = displaced(views.histogram, bars)
    through, seen = views.looks.T // SCANS_ALIKE
    p_missing = np.where(seen >= VIEWS_MIN, stats.binom.sf(through - 1, seen, THROUGH_SHARE), 1.0)
    gone = through > GONE_SHARE * seen
    measured = np.isfinite(p_moved) & ~gone
    p = np.where(gone, p_missing, np.where(measured, p_moved, 1.0))
    told = measured | (seen >= VIEWS_MIN)
    p[told] = holm(p[told])
    kind[(p < SIGNIFICANCE) & measured] = "moved"
    kind[(p < SIGNIFICANCE) & measured & (p_bent < BENT)] = "bent"
    kind[(p < SIGNIFICANCE) & gone] = "missing"
    kind[~told] = "not seen"
    p[~told] = np.nan
    offset_m, sigma_m = (np.where(measured, each, np.nan) for each in (offset_m, sigma_m))
    new = _new_bars(scans, T, bars, settings)
    beside, beside_sigma = _beside(new, known)
    return Changes(
        known, new, (*kind.tolist(), *["new"] * len(new)), np.append(offset_m, beside),
        np.append(sigma_m, beside_sigma), np.append(p, holm(stats.chi2.sf((beside / beside_sigma) ** 2, 2))),
    )  # fmt: skip


def holm(p_values: Sequence[float] | Array) -> list[float]:
    """P-values adjusted for being many (Holm, Scand. J. Statist. 6, 1979), in the order given."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted.tolist()


class _Unexplained(Sequence[Scan]):
    """Scans without the points near bars of the map."""

    def __init__(self, scans: Sequence[Scan], T_world_sensor: Array, bars: KnownBars) -> None:
        self.scans, self.T_world_sensor, self.bars = scans, T_world_sensor, bars

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        for k, scan in enumerate(self.scans):
            yield self._without(scan, k)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return _Unexplained(self.scans[index], self.T_world_sensor[index], self.bars)
        return self._without(self.scans[index], index)

    def _without(self, scan: Scan, k: int) -> Scan:
        R, t = self.T_world_sensor[k, :3, :3], self.T_world_sensor[k, :3, 3]
        points = np.array(scan.points, dtype=np.float64)
        flat = points.reshape(-1, 3)
        seen = np.flatnonzero(np.isfinite(flat).all(axis=1))
        flat[seen[self.bars.voxels.near(flat[seen] @ R.T + t)]] = np.nan
        return replace(scan, points=points)


def _new_bars(scans: Sequence[Scan], T_world_sensor: Array, bars: KnownBars, settings: StructureSettings) -> Structure:
    """The bars that `reconstruct` finds in the points that lie near no bar of the map."""
    left = _Unexplained(scans, T_world_sensor, bars)
    try:
        return reconstruct(left, T_world_sensor, settings=settings.replace(adjust=False))
    except InputError as fault:
        return Structure.empty(str(fault))


def _beside(new: Structure, known: Structure) -> tuple[Array, Array]:
    """Distance of the middle of each new bar from the nearest one of the map, and its standard deviation, metres."""
    s = known.segments
    apart = new.segments.middle[:, None] - s.start
    along = np.clip((apart * s.direction).sum(axis=2), 0, s.length)
    distance = np.linalg.norm(apart - along[..., None] * s.direction, axis=2)
    nearest = distance.argmin(axis=1)
    sigma = np.hypot(new.sigma_m, np.nan_to_num(known.sigma_m)[nearest])
    return distance.min(axis=1), np.maximum(sigma, SIGMA_BOW_M)
