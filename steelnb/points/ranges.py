"""Ranges: their noise, the sigma filter that reduces it, and their correction by a calibration.

A calibration is the scale and offset that the camera's owner measured. Neither shows in the scans of a flight, where
map and path grow by the same share. Against known distances they show in minutes (`steelnb.simulation.tof`,
docs/settings.md).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numba.extending import register_jitable

from steelnb.core.checks import checked_cloud, checked_integer
from steelnb.core.kernels import njit
from steelnb.core.types import Array, Flight, Floats, RangeScans, Scan
from steelnb.settings import TofSettings

SIGMA_M, SIGMA_SHARE = 0.01, 0.01
"""Standard deviation of a range that every estimator assumes: 1 cm up to 1 m, 1 % beyond, as in data sheets of
Time-of-Flight cameras such as that of the Starling 2."""
GATE_SIGMAS = 4.0
"""Gate on the difference of two ranges of one surface, in standard deviations of a single range. The
standard deviation of the difference is √2 times as large."""
STEP_M = 0.15
"""Neighbours in a scan that are farther apart than this, in range or in space, are on different surfaces."""


@register_jitable
def range_sigma_m(range_m: Any) -> Any:
    """Standard deviation of a range, or of an array of them, metres; NaN without a range."""
    return np.maximum(SIGMA_M, SIGMA_SHARE * range_m)


@njit(cache=True)
def ranges_ahead(image):  # type: ignore[no-untyped-def]
    """Ranges ``(H, W)`` of an organised scan ``(H, W, 3)``, sensor frame, metres; NaN where there is no return.

    Points that are not in front of the sensor count as no return, for which many drivers write zeros.
    """
    rows, columns = image.shape[0], image.shape[1]
    distance = np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):
            x, y, z = image[r, c, 0], image[r, c, 1], image[r, c, 2]
            distance[r, c] = np.sqrt(x * x + y * y + z * z) if x > 0.0 else np.nan
    return distance


def smooth_ranges(points: Array, radius_px: int = 1) -> Array:
    """Organised scan ``(H, W, 3)``, sensor frame, metres, with denoised ranges: each point moves along its ray.

    The new range is the mean of all ranges within ``radius_px`` pixels that differ from the old one by at most
    `GATE_SIGMAS` standard deviations, so a bar is not blurred with its background. NaN stays NaN. A cloud ``(N, 3)`` is
    returned unchanged. Raises `InputError` for any other shape. Source: Lee, "Digital image smoothing and the sigma
    filter" (1983).
    """
    points, radius_px = checked_cloud(points), checked_integer(radius_px, "radius_px", 0)
    if points.ndim == 2:
        return points
    return np.asarray(_sigma_filter(np.ascontiguousarray(points), min(radius_px, max(points.shape[:2]))))


@njit(cache=True)
def _sigma_filter(points, radius):
    rows, columns, _ = points.shape
    # A border of NaN replaces checks of the bounds: NaN fails every comparison.
    distance = np.full((rows + 2 * radius, columns + 2 * radius), np.nan)
    for i in range(rows):
        for j in range(columns):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            distance[i + radius, j + radius] = np.sqrt(x * x + y * y + z * z)
    smooth = np.empty_like(points)
    for i in range(rows):
        for j in range(columns):
            own = distance[i + radius, j + radius]
            if not 0.0 < own < np.inf:
                smooth[i, j, :] = points[i, j]
                continue
            bound = GATE_SIGMAS * range_sigma_m(own)
            total, count = 0.0, 0.0
            for a in range(2 * radius + 1):
                for b in range(2 * radius + 1):
                    difference = distance[i + a, j + b] - own
                    if abs(difference) <= bound:
                        total += difference
                        count += 1.0
            scale = 1.0 + total / count / own
            for k in range(3):
                smooth[i, j, k] = points[i, j, k] * scale
    return smooth


def calibrated(flight: Flight, tof: TofSettings) -> Flight:
    """The flight with corrected ranges ``(r − tof.range_offset_m) / tof.range_scale``, metres, and with the standard
    deviations that these leave; the same object without a calibration. Ranges that are not positive become NaN."""
    sigmas = tof.range_scale_sigma, tof.range_offset_sigma_m
    if not corrects(tof.range_scale, tof.range_offset_m):
        return replace(flight, range_sigmas=sigmas) if any(sigmas) else flight
    scans: Sequence[Scan] = CalibratedScans(flight.scans, tof.range_scale, tof.range_offset_m)
    if isinstance(flight.scans, RangeScans):
        range_m = corrected_ranges(flight.scans.range_m, tof.range_scale, tof.range_offset_m).astype(np.float32)
        scans = RangeScans(flight.scans.stamp_s, range_m, flight.scans.ray)
    return replace(flight, scans=scans, range_sigmas=sigmas)


def corrects(scale: float, offset_m: float) -> bool:
    """Whether this calibration changes ranges."""
    return scale != 1.0 or offset_m != 0.0


def corrected_ranges(range_m: Array | Floats, scale: float, offset_m: float) -> Array:
    """Corrected ranges ``(...)``, metres, NaN where none is left. Zeros stay: they stand for no return."""
    with np.errstate(invalid="ignore"):
        corrected = (range_m - offset_m) / scale
        return np.where(range_m == 0, range_m, np.where(corrected > 0, corrected, np.nan))


def calibrated_scan(scan: Scan, scale: float, offset_m: float) -> Scan:
    """One scan with corrected ranges; the same object without a calibration."""
    if not corrects(scale, offset_m):
        return scan
    range_m = np.linalg.norm(scan.points, axis=-1, keepdims=True)
    share = corrected_ranges(range_m, scale, offset_m) / np.where(range_m > 0, range_m, 1.0)
    return Scan(scan.stamp_s, scan.points * share, scan.fault)


class CalibratedScans(Sequence[Scan]):
    """The ``scans`` of a recording, corrected on access."""

    def __init__(self, scans: Sequence[Scan], scale: float, offset_m: float) -> None:
        self.scans, self.scale, self.offset_m = scans, scale, offset_m
        if hasattr(scans, "stamp_s"):  # known without reading the scans
            self.stamp_s = scans.stamp_s

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return CalibratedScans(self.scans[index], self.scale, self.offset_m)
        return calibrated_scan(self.scans[index], self.scale, self.offset_m)
