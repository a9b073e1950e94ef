"""Ranges of a calibrated camera: the driver's, corrected by the scale and offset that its owner measured.

Neither shows in the scans of a flight, where map and path grow by the same share. Against known distances they show in
minutes (`steelnb.simulation.tof`, docs/settings.md).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from steelnb.core.types import Array, Flight, Floats, RangeScans, Scan
from steelnb.settings import TofSettings


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
