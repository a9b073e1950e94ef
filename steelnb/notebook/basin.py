"""The basin of convergence of a registration: the starts from which a scan finds its true pose."""

import copy
from collections.abc import Callable

import numpy as np
import pandas as pd

from steelnb.core.types import Array, Flight
from steelnb.odometry import CloudOdometry
from steelnb.points import preprocess_scan
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Truth

RIGHT_M = 0.1
"""Maximum error of a right result: the edge of the report's voxel."""
MAP_EVERY = 4


def find_basin(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    frame: int,
    offset_m: Array,
    on_progress: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Register scan ``frame`` from starts that are off its true pose by ``offset_m (N, 3)``, one row per start. The map
    holds every `MAP_EVERY`-th scan at its true pose, without ``frame``.

    ``x_m``, ``y_m``, ``z_m``: the offset of the start; ``error_m``: position error of the result; ``refused``: the
    odometry did not use the scan. Other results are ``right`` within `RIGHT_M` of the truth, else ``wrong``. A wrong
    result has either ``stayed`` within `RIGHT_M` of its start, since the registration trusts its prior, or ``locked``
    onto something else. Raises `InputError` for an odometry without clouds.
    """
    odometry = CloudOdometry(settings.odometry, flight.T_drone_sensor)
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    for k in range(0, len(flight.scans), MAP_EVERY):
        if k != frame:
            points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, settings.odometry.preprocess)
            odometry.insert(points, true[k])
    ends, used = [], []
    for k, offset in enumerate(offset_m):
        start = true[frame].copy()
        start[:3, 3] += offset
        step = copy.deepcopy(odometry).update(flight.scans[frame], start)
        ends.append(step.T_world_drone[:3, 3] - true[frame][:3, 3])
        used.append(bool(step.used))
        if on_progress:
            on_progress((k + 1) / len(offset_m))
    error, moved = np.linalg.norm(ends, axis=1), np.linalg.norm(np.array(ends) - offset_m, axis=1)
    taken, close = np.array(used), error <= RIGHT_M
    wrong, still = taken & ~close, moved <= RIGHT_M
    basin = pd.DataFrame(offset_m, columns=["x_m", "y_m", "z_m"])
    return basin.assign(
        error_m=error, right=taken & close, wrong=wrong, stayed=wrong & still, locked=wrong & ~still, refused=~taken
    )
