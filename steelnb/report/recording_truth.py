"""A part of a recorded flight, drift added to it, and the truth at its scans."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.errors import RecordingError, SettingsError
from steelnb.io.scans import subset
from steelnb.io.transforms import interpolate
from steelnb.noise import drifting
from steelnb.report.words import counted
from steelnb.rng import Seed
from steelnb.settings import NoiseSettings
from steelnb.types import Flight, Trajectory

STEP_S = 1 / 125
"""Step of the simulator; drift is added at every step, so the same noise means the same for every recording."""
STEPS_MAX = 1_800_000
"""Four hours of steps, half a gigabyte."""
APART_M, APART_RAD = 0.5, math.radians(5)
"""Poses and truth that differ by more than this at the first scan are in different frames."""


def part_of(
    flight: Flight, truth: Trajectory | None, part_s: tuple[float, float], gap_max_s: float | None
) -> tuple[Flight, Trajectory | None, tuple[str, ...]]:
    """The scans from one time to another, both in seconds since the first scan, the truth there, and a note.

    Scans in files stay there, and the others are not read. Poses keep their frame. They have drifted by the time the
    part begins, which no odometry can know: the truth is moved onto the first of them, so that errors begin at zero.
    Raises `SettingsError` for a part without a scan, and for one that begins before the first.
    """
    since_s, (from_s, to_s) = flight.prior.stamp_s - flight.prior.stamp_s[0], part_s
    chosen = (since_s >= from_s - 1e-6) & (since_s <= to_s + 1e-6)
    if not (from_s >= 0 and chosen.any()):
        raise SettingsError(
            f"from {from_s:g} to {to_s:g} s: no scan; expected a part of the recording, 0 to {since_s[-1]:.1f} s"
        )
    prior = Trajectory(flight.prior.stamp_s[chosen], flight.prior.T_world_drone[chosen])
    notes = [f"only the scans from {since_s[chosen][0]:.1f} to {since_s[chosen][-1]:.1f} s of {since_s[-1]:.1f} s"]
    if truth is not None:
        # With the poses just outside, between which those at the first and the last scan lie.
        first = max(int(np.searchsorted(truth.stamp_s, prior.stamp_s[0], "right")) - 1, 0)
        last = max(int(np.searchsorted(truth.stamp_s, prior.stamp_s[-1])), first) + 1
        truth = Trajectory(truth.stamp_s[first:last], truth.T_world_drone[first:last])
        T_world_drone, known = interpolate(truth, prior.stamp_s, gap_max_s)
        if known.any() and not chosen[0]:
            at = int(np.argmax(known))
            T_prior_truth = prior.T_world_drone[at] @ np.linalg.inv(T_world_drone[at])
            apart_m = float(np.linalg.norm(prior.position[at] - T_world_drone[at, :3, 3]))
            notes.append(f"the truth was moved by {apart_m:.3f} m onto the first pose: errors begin at zero there")
            truth = Trajectory(truth.stamp_s, T_prior_truth @ truth.T_world_drone)
    return replace(flight, prior=prior, scans=subset(flight.scans, chosen)), truth, tuple(notes)


def with_drift(
    flight: Flight, truth: Trajectory | None, noise: NoiseSettings, seed: Seed, gap_max_s: float | None
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


def drifted(true: Trajectory, noise: NoiseSettings, seed: Seed) -> Trajectory:
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
    flight: Flight, truth: Trajectory | None, gap_max_s: float | None
) -> tuple[Trajectory | None, tuple[str, ...]]:
    """True poses at those scans that have one, in the frame of the prior; and remarks for the user.

    None where fewer than two scans have one. A truth in another frame is moved so that the first poses agree.
    """
    if truth is None:
        return None, ("no truth: nothing is said of errors",)
    T_world_drone, known = interpolate(truth, flight.prior.stamp_s, gap_max_s)
    if np.count_nonzero(known) < 2:
        return None, (f"the truth covers {counted(int(np.count_nonzero(known)), 'scan')}: nothing is said of errors",)
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
