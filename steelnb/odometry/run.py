"""The loop that runs an odometry over a flight."""

import time
from collections.abc import Callable

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.types import Flight, Scan, Segments, Trajectory
from steelnb.odometry.base import Odometry

OnStep = Callable[[int, Scan, OdometryStep], None]


def run(flight: Flight, odometry: Odometry, on_step: OnStep | None = None, before: Flight | None = None) -> Estimate:
    """Correct a flight scan by scan; one scan is in memory at a time.

    Parameters
    ----------
    flight : the scans, the drifting prior at their stamps, and the mount of the sensor.
    odometry : a new one; afterwards it holds the map.
    on_step : called after every scan with its number, the scan and its `OdometryStep`; its time is not measured.
    before : another flight, which the odometry corrects first; its steps are dropped, and what it has learnt stays.

    Raises `InputError` if fewer scans can be read than the flight has poses, or if an update returns no `OdometryStep`.
    """
    if before is not None:
        run(before, odometry)
    steps: list[OdometryStep] = []
    reason, update_s = [], np.zeros(len(flight))
    for k, scan in enumerate(flight.scans):
        begin = time.perf_counter()
        step = odometry.update(scan, flight.prior.T_world_drone[k])
        update_s[k] = time.perf_counter() - begin
        if not isinstance(step, OdometryStep):
            raise InputError(f"{type(odometry).__name__}.update gave {step!r:.80}; expected an OdometryStep")
        steps.append(step)
        reason.append("" if step.used else scan.fault or step.reason)
        if on_step:
            on_step(k, scan, step)
    if len(steps) < len(flight):
        raise InputError(f"{flight.name}: {len(steps)} scans could be read; expected {len(flight)}, one per pose")
    stages = steps[0].seconds if steps else ()
    return Estimate(
        prior=flight.prior,
        corrected=Trajectory(flight.prior.stamp_s, np.array([s.T_world_drone for s in steps]).reshape(-1, 4, 4)),
        points=odometry.map_points() if hasattr(odometry, "map_points") else np.zeros((0, 3)),
        segments=odometry.map_segments() if hasattr(odometry, "map_segments") else Segments.empty(),
        matches=np.array([s.matches for s in steps], dtype=np.int64),
        reason=tuple(reason),
        seconds={stage: np.array([s.seconds[stage] for s in steps]) for stage in stages},
        update_s=update_s,
        unobserved=np.array([s.unobserved for s in steps], dtype=np.int64),
    )
