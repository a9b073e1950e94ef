"""The loop that runs an odometry over a flight."""

import copy
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import SAME_S, checked_kind, checked_points, checked_pose, shown
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.types import Flight, Scan, Segments, Trajectory
from steelnb.odometry.base import Odometry
from steelnb.odometry.plugins import users_code

OnStep = Callable[[int, Scan, OdometryStep], None]


@checks_arguments
def run(flight: Flight, odometry: Odometry, on_step: OnStep | None = None, before: Flight | None = None) -> Estimate:
    """Correct a flight scan by scan; one scan is in memory at a time.

    Parameters
    ----------
    flight : the scans, the drifting prior at their stamps, and the mount of the sensor. A class that is not of this
        package gets copies of the scans.
    odometry : a new one; afterwards it holds the map.
    on_step : called after every scan with its number, the scan and its `OdometryStep`; its time is not measured.
    before : another flight, which the odometry corrects first; its steps are dropped, and what it has learnt stays.

    Raises `InputError` if other scans are read than the flight has poses for, by number or by stamp, and if an update
    returns no `OdometryStep`, one of another stamp or one that is not valid; the message names the class and the scan.
    """
    if isinstance(odometry, type) or not callable(getattr(odometry, "update", None)):
        raise InputError(f"odometry = {shown(odometry)}: expected an object with a method update, as of make_odometry")
    if before is not None:
        run(before, odometry)
    steps: list[OdometryStep] = []
    reason, update_s = [], np.zeros(len(flight))
    T_world_drone, is_ours = flight.prior.T_world_drone.copy(), type(odometry).__module__.startswith("steelnb.")
    for k, scan in enumerate(flight.scans):
        if k == len(flight):
            raise InputError(f"{flight.name}: more than {k} scans could be read; expected {k}, one per pose")
        checked_kind(scan, f"{flight.name}, scan {k}", Scan)
        _check_stamp(scan.stamp_s, f"{flight.name}, scan {k}", float(flight.prior.stamp_s[k]), "its pose")
        given = (scan if is_ours else copy.deepcopy(scan)), flight.prior.T_world_drone[k].copy()  # which it may change
        begin = time.perf_counter()
        try:
            with nullcontext() if is_ours else users_code("it", "an OdometryStep"):
                step = odometry.update(*given)
            update_s[k] = time.perf_counter() - begin
            # Checked again, as the odometry may have changed the array since.
            T_world_drone[k] = checked_pose(checked_kind(step, "its result", OdometryStep).T_world_drone, "its pose")
            _check_stamp(step.stamp_s, "its result", scan.stamp_s, "its scan")
        except InputError as fault:
            raise InputError(f"{type(odometry).__name__}.update, scan {k}: {fault}") from fault.__cause__
        steps.append(step)
        # On one line, as it is printed.
        reason.append("" if step.used else " ".join((scan.fault or step.reason).split()) or "not used")
        if on_step:
            on_step(k, scan, step)
    if len(steps) < len(flight):
        raise InputError(f"{flight.name}: {len(steps)} scans could be read; expected {len(flight)}, one per pose")
    stages = dict.fromkeys(stage for step in steps for stage in step.seconds)
    covariances = [step.covariance for step in steps if step.covariance is not None]
    return Estimate(
        prior=flight.prior,
        corrected=Trajectory(flight.prior.stamp_s, T_world_drone),
        points=_map_of(odometry, "map_points", np.zeros((0, 3))),
        segments=_map_of(odometry, "map_segments", Segments.empty()),
        matches=np.array([s.matches for s in steps], dtype=np.int64),
        reason=tuple(reason),
        seconds={stage: np.array([s.seconds.get(stage, 0.0) for s in steps]) for stage in stages},
        update_s=update_s,
        unobserved=np.array([s.unobserved for s in steps], dtype=np.int64),
        pose_covariance=np.array(covariances) if steps and len(covariances) == len(steps) else None,
    )


def _check_stamp(stamp_s: float, name: str, due_s: float, of: str) -> None:
    """Raise `InputError` unless a stamp is that of something else, to within `SAME_S`."""
    if not abs(stamp_s - due_s) <= SAME_S:
        raise InputError(f"{name}: at {stamp_s!r} s, {stamp_s - due_s:.6g} s after {of}; expected the same stamp")


def _map_of(odometry: Odometry, method: str, default: Any) -> Any:
    """What a method of the odometry returns, or the default if it has none of this name. Raises `InputError`."""
    found, name = getattr(odometry, method, None), f"{type(odometry).__name__}.{method}()"
    if not callable(found):
        return default
    with users_code(name):
        value = found()
    if not isinstance(default, Segments):
        return checked_points(value, name)
    checked_kind(value, name, Segments)
    try:
        return value.checked()
    except InputError as fault:
        raise InputError(f"{name}: {fault}") from None
