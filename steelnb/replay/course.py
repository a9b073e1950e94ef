"""What is replayed: a recording's flight, with drift added where it is asked for, and the truth to judge it by."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.config import NoiseSettings
from steelnb.datatypes import Flight, Scan, Trajectory
from steelnb.errors import RecordingError, SettingsError
from steelnb.noise import drifting
from steelnb.recordings.recording import GAP_MAX_S, Recording, interpolate

STEP_S = 1 / 125
"""Of the simulator; drift is added at every step, so the same noise means the same for every recording."""
STEPS_MAX = 1_800_000
"""Four hours of them, in half a gigabyte."""
APART_M, APART_RAD = 0.5, math.radians(5)
"""Poses and truth that differ by more than this at the first scan are in different frames."""


@dataclass(frozen=True)
class Course:
    """A flight as an odometry gets it; the true poses at those of its scans that have one; and remarks for the user.

    ``truth`` is None where there is none, and only for judging.
    """

    flight: Flight
    truth: Trajectory | None
    notes: tuple[str, ...]


def course_of(
    recording: Recording, noise: NoiseSettings | None = None, seed: int = 1, gap_max_s: float = GAP_MAX_S
) -> Course:
    """The flight of a recording, its poses drifting as recorded or, with ``noise``, as drawn from ``seed``.

    Noise is added to the truth, or where there is none to the poses, taken as true. Raises `RecordingError` where no
    scan has a pose, and `SettingsError` for a gap that is not positive.
    """
    check_gap(gap_max_s)
    notes, truth = [], recording.truth
    if noise is not None:
        if truth is None:
            truth = recording.poses
            notes.append("the recorded poses are taken as true: errors are those of the drift added to them")
        recording = replace(recording, poses=with_drift(truth, noise, seed, gap_max_s))
    elif recording.facts.get("poses", "").startswith("true poses"):
        notes.append("the recorded poses are true ones: nothing drifts; --noise random-walk:0.002 adds drift")
    flight = recording.flight(gap_max_s)
    flight = replace(flight, scans=Returns(flight.scans))
    if truth is None:
        return Course(flight, None, ("no truth: nothing is said of errors",))
    T_world_drone, known = interpolate(truth, flight.prior.stamp_s, gap_max_s)
    if np.count_nonzero(known) < 2:
        return Course(flight, None, (f"the truth covers {np.count_nonzero(known)} scans: nothing is said of errors",))
    if not known.all():
        notes.append(f"the truth covers {np.count_nonzero(known)} of {len(known)} scans; errors are those there")
    true = Trajectory(flight.prior.stamp_s[known], T_world_drone[known])
    T_first = flight.prior.T_world_drone[np.argmax(known)] @ np.linalg.inv(true.T_world_drone[0])
    apart_m = float(np.linalg.norm(flight.prior.position[np.argmax(known)] - true.position[0]))
    apart_rad = float(Rotation.from_matrix(T_first[:3, :3]).magnitude())
    if apart_m > APART_M or apart_rad > APART_RAD:
        notes.append(
            f"poses and truth are in different frames, {apart_m:.2f} m and {math.degrees(apart_rad):.1f}° apart at the "
            "first scan: the truth was moved onto the first pose"
        )
        true = Trajectory(true.stamp_s, T_first @ true.T_world_drone)
    return Course(flight, true, tuple(notes))


def check_gap(gap_max_s: float) -> None:
    """Raise `SettingsError` for a bound on gaps that bounds nothing."""
    if not 0 < gap_max_s < math.inf:
        raise SettingsError(f"gap = {gap_max_s}: expected a positive number of seconds")


class Returns(Sequence[Scan]):
    """Scans without the points that are none: those at the sensor's own place, by which many drivers mark no return."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        self._scans = scans

    def __len__(self) -> int:
        return len(self._scans)

    def __iter__(self) -> Iterator[Scan]:
        return map(without_zeros, self._scans)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        found = self._scans[index]
        return Returns(found) if isinstance(index, slice) else without_zeros(found)


def without_zeros(scan: Scan) -> Scan:
    """The same scan, or one without points at the sensor; see `Returns`."""
    zero = (scan.points == 0).all(axis=-1)
    if not zero.any():
        return scan
    points = scan.points.copy()
    points[zero] = np.nan
    return Scan(scan.stamp_s, points)


def with_drift(true: Trajectory, noise: NoiseSettings, seed: int, gap_max_s: float) -> Trajectory:
    """A trajectory that drifts as one of the simulator's would, with poses at 125 Hz where ``true`` has no gap.

    Raises `RecordingError` for one longer than four hours.
    """
    stamp_s = true.stamp_s
    if len(stamp_s) > 1 and np.abs(np.diff(stamp_s) - STEP_S).max() < 1e-4:  # the simulator's own: stays to the bit
        return drifting(true, noise, seed)
    steps = (stamp_s[-1] - stamp_s[0]) / STEP_S
    if not steps < STEPS_MAX:
        span_s = stamp_s[-1] - stamp_s[0]
        raise RecordingError(f"poses over {span_s:.0f} s; expected less than four hours to add drift to")
    fine_s = stamp_s[0] + STEP_S * np.arange(math.ceil(steps - 1e-6) + 1)
    fine_s[-1] = stamp_s[-1]
    T_world_drone, _ = interpolate(true, fine_s, math.inf)
    _, covered = interpolate(true, fine_s, gap_max_s)
    drifted = drifting(Trajectory(fine_s, T_world_drone), noise, seed)
    return Trajectory(fine_s[covered], drifted.T_world_drone[covered])
