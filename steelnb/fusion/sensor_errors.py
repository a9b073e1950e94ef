"""Self-calibration: errors of the sensor's range, mount and clock as unknowns of an adjustment (`fusion.bundle`).

Bars alone know neither metres nor seconds, nor where the drone's axes are: the increments of the drifting prior tell
the scale of the range, and its rotation how the sensor is mounted. What a flight does not tell keeps the standard
deviation that it had before. Source: Furgale, Rehder, Siegwart, "Unified temporal and spatial calibration for
multi-sensor systems" (IROS 2013), here with the structure as the target.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion.poses import prior_errors
from steelnb.points.ranges import true_points
from steelnb.settings import CalibrationSettings
from steelnb.types import Array, Flight, Scan, SensorErrors

RANGE, SCALE, TIME = 2, 1, 8
"""Of the nine errors the first two are those of the range, the second of which is its scale; all others move the
drifting poses of the sensor, the last one by time."""
KNOWN_SIGMA = 1e-9
"""Standard deviation of an error that is known."""
STEP = 1e-5
"""Step of the differences that stand for derivatives."""


class SensorEquations(NamedTuple):
    """Normal equations of C errors of a sensor: ``block (C, C)``, ``right (C,)``, and between them and the poses
    ``poses (K, D, C)`` and the bars ``bars (6 B, C)``."""

    poses: Array
    bars: Array
    block: Array
    right: Array


def unknown_errors(settings: CalibrationSettings) -> SensorErrors:
    """No error, with the standard deviations of the settings."""
    s = settings
    sigma = np.array(
        [s.range_offset_sigma_m, s.range_scale_sigma, *3 * [s.mount_sigma_m], *3 * [s.mount_sigma_rad], s.time_sigma_s]
    )
    return SensorErrors(np.zeros(len(sigma)), np.diag(sigma**2), sigma)


def true_poses(errors: SensorErrors, prior: Array, stamp_s: Array) -> Array:
    """The drifting poses of the true sensor when it took its scans, ``(K, 4, 4)``, from those of the assumed one at the
    stamps ``(K,)``, between which it moves evenly."""
    scan = np.arange(len(prior))
    before, after = np.maximum(scan - 1, 0), np.minimum(scan + 1, len(prior) - 1)
    share = (errors.value[TIME] / np.maximum(stamp_s[after] - stamp_s[before], 1e-6))[:, None]
    turned = Rotation.from_matrix(prior[after, :3, :3] @ prior[before, :3, :3].transpose(0, 2, 1)).as_rotvec()
    result = prior.copy()
    result[:, :3, :3] = Rotation.from_rotvec(share * turned).as_matrix() @ prior[:, :3, :3]
    result[:, :3, 3] += share * (prior[after, :3, 3] - prior[before, :3, 3])
    return result @ errors.T_assumed_true


def derivative(errors: SensorErrors, of: Callable[[Array], Array], prior: Array, stamp_s: Array) -> Array:
    """The derivatives ``(…, C)`` by the errors of a function ``(…)`` of the drifting poses of the true sensor."""
    steps = STEP * np.eye(len(errors.value))
    ahead, behind = (
        np.array([of(true_poses(replace(errors, value=errors.value + sign * step), prior, stamp_s)) for step in steps])
        for sign in (1, -1)
    )
    return np.asarray(np.moveaxis(ahead - behind, 0, -1) / (2 * STEP))


def with_prior(
    of_range: SensorEquations,
    errors: SensorErrors,
    T: Array,
    prior: Array,
    stamp_s: Array,
    tilt_sigma_rad: float,
    upright: bool = True,
) -> SensorEquations:
    """The normal equations of all errors: of the range by points, as they are given; of mount and clock by the
    ``prior (K, 4, 4)`` of the poses ``T``; and what was known before."""
    error, weight, before = prior_errors(T, true_poses(errors, prior, stamp_s), stamp_s, tilt_sigma_rad, upright)
    by = derivative(errors, lambda at: prior_errors(T, at, stamp_s, tilt_sigma_rad, upright).error, prior, stamp_s)
    weighed, known = weight[:, :, None] * by, np.maximum(errors.prior_sigma, KNOWN_SIGMA) ** -2.0
    poses, bars = weighed.copy(), np.zeros((len(of_range.bars), len(known)))
    poses[:-1] += before.transpose(0, 2, 1) @ weighed[1:]
    block = np.einsum("kdc,kde->ce", by, weighed) + np.diag(known)
    right = -np.einsum("kdc,kd->c", weighed, error) - known * errors.value
    poses[:, :, :RANGE] += of_range.poses
    bars[:, :RANGE] = of_range.bars
    block[:RANGE, :RANGE] += of_range.block
    right[:RANGE] += of_range.right
    return SensorEquations(poses, bars, block, right)


@dataclass(frozen=True)
class TrueScans(Sequence[Scan]):
    """Scans without an offset of their ranges, metres, and a relative scale; corrected when asked for."""

    scans: Sequence[Scan]
    offset_m: float
    scale: float

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return replace(self, scans=self.scans[index])
        return self._true(self.scans[index])

    def __iter__(self) -> Iterator[Scan]:
        return map(self._true, self.scans)

    def _true(self, scan: Scan) -> Scan:
        return replace(scan, points=true_points(scan.points, self.offset_m, self.scale))


def true_flight(flight: Flight, errors: SensorErrors | None) -> Flight:
    """The flight with the mount of the true sensor, and without the errors of its ranges; itself where none are known.
    Its poses stay those at the stamps."""
    if errors is None:
        return flight
    scans = TrueScans(flight.scans, *errors.value[:RANGE])
    return replace(flight, scans=scans, T_drone_sensor=flight.T_drone_sensor @ errors.T_assumed_true)
