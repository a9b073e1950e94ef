"""Drift added to a recorded flight, and the truth at its scans."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.errors import RecordingError
from steelnb.io.scans import subset
from steelnb.io.transforms import interpolate
from steelnb.noise import drifting
from steelnb.settings import NoiseSettings
from steelnb.types import Flight, Trajectory

STEP_S = 1 / 125
"""Step of the simulator; drift is added at every step, so the same noise means the same for every recording."""
STEPS_MAX = 1_800_000
"""Four hours of steps, half a gigabyte."""
APART_M, APART_RAD = 0.5, math.radians(5)
"""Poses and truth that differ by more than this at the first scan are in different frames."""


def with_drift(
    flight: Flight, truth: Trajectory | None, noise: NoiseSettings, seed: int, gap_max_s: float
) -> tuple[Flight, Trajectory]:
    """The flight with a prior that drifts from the truth, or without one from its poses, taken as true; and that truth.

    Scans that the truth does not cover are left out. Raises `RecordingError` for no scan, or for more than four hours.
    """
    true = flight.prior if truth is None else truth
    prior, known = interpolate(drifted(true, noise, seed), flight.prior.stamp_s, math.inf)
    if truth is not None:
        known = interpolate(truth, flight.prior.stamp_s, gap_max_s)[1]
    if not known.any():
        raise RecordingError(
            f"{flight.name}: the truth covers none of {len(flight)} scans; expected some to add noise to"
        )
    if not known.all():
        left_out = {"no true pose within the gap": int((~known).sum())}
        flight = replace(flight, scans=subset(flight.scans, known), skipped={**flight.skipped, **left_out})
    return replace(flight, prior=Trajectory(flight.prior.stamp_s[known], prior[known])), true


def drifted(true: Trajectory, noise: NoiseSettings, seed: int) -> Trajectory:
    """A trajectory that drifts at 125 Hz, as the simulator's does. Raises `RecordingError` beyond four hours."""
    stamp_s = true.stamp_s
    if len(stamp_s) > 1 and np.abs(np.diff(stamp_s) - STEP_S).max() < 1e-4:  # the simulator's own: stays to the bit
        return drifting(true, noise, seed)
    steps = (stamp_s[-1] - stamp_s[0]) / STEP_S
    if not steps < STEPS_MAX:
        raise RecordingError(f"poses over {steps * STEP_S:.0f} s; expected less than four hours to add drift to")
    # Stamps since 1970 resolve a quarter of a microsecond: a last step shorter than that would be none.
    fine_s = stamp_s[0] + STEP_S * np.arange(math.ceil(steps - 1e-3) + 1)
    fine_s[-1] = stamp_s[-1]
    return drifting(Trajectory(fine_s, interpolate(true, fine_s, math.inf)[0]), noise, seed)


def truth_at_scans(
    flight: Flight, truth: Trajectory | None, gap_max_s: float
) -> tuple[Trajectory | None, tuple[str, ...]]:
    """True poses at those scans that have one, in the frame of the prior; and remarks for the user.

    None where fewer than two scans have one. A truth in another frame is moved so that the first poses agree.
    """
    if truth is None:
        return None, ("no truth: nothing is said of errors",)
    T_world_drone, known = interpolate(truth, flight.prior.stamp_s, gap_max_s)
    if np.count_nonzero(known) < 2:
        return None, (f"the truth covers {np.count_nonzero(known)} scans: nothing is said of errors",)
    notes = []
    if not known.all():
        notes.append(f"the truth covers {np.count_nonzero(known)} of {len(known)} scans; errors are those there")
    true = Trajectory(flight.prior.stamp_s[known], T_world_drone[known])
    first = int(np.argmax(known))
    T_first = flight.prior.T_world_drone[first] @ np.linalg.inv(true.T_world_drone[0])
    apart_m = float(np.linalg.norm(flight.prior.position[first] - true.position[0]))
    apart_rad = float(Rotation.from_matrix(T_first[:3, :3]).magnitude())
    if apart_m > APART_M or apart_rad > APART_RAD:
        notes.append(
            f"poses and truth are in different frames, {apart_m:.2f} m and {math.degrees(apart_rad):.1f}° apart at the "
            "first scan: the truth was moved onto the first pose"
        )
        true = Trajectory(true.stamp_s, T_first @ true.T_world_drone)
    return true, tuple(notes)
