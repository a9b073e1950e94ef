"""From where a registration comes home, and when a flight slips to a wrong bar."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    CloudSettings,
    ExperimentSettings,
)
from steelnb.datatypes import Array, Flight
from steelnb.metrics import basin_radius_m, largest_slip, position_error_m
from steelnb.odometry import CloudOdometry
from steelnb.preprocess import preprocess_scan
from steelnb.simulation import Truth
from steelnb.study.runs import case_of


@dataclass(frozen=True)
class Basin:
    """Where one scan ends that starts beside its true pose.

    ``settings`` of the registration; ``offset_m (N, 3)`` of the starts from the truth; ``error_m (N,)`` of the end;
    ``used (N,)``, whether the odometry took the result or refused it; ``cloud (M, 3)``, the map built at true poses;
    ``scan (P, 3)`` in the drone frame, its true pose and the poses ``(N, 4, 4)`` it ended at.
    """

    settings: ExperimentSettings
    offset_m: Array
    error_m: Array
    used: np.ndarray
    cloud: Array
    scan: Array
    T_world_drone_true: Array
    T_world_drone_end: Array

    @property
    def wrong(self) -> np.ndarray:
        """Starts ``(N,)`` that ended elsewhere without the odometry's noticing: false convergence."""
        return self.used & (self.error_m > RIGHT_M)

    @property
    def stayed(self) -> np.ndarray:
        """Those of the wrong ones ``(N,)`` that hardly left their start, since the registration trusts its prior."""
        end = self.T_world_drone_end[:, :3, 3] - self.T_world_drone_true[:3, 3]
        return self.wrong & (np.linalg.norm(end - self.offset_m, axis=1) <= RIGHT_M)

    @property
    def right(self) -> np.ndarray:
        """Starts ``(N,)`` that came home."""
        return self.used & (self.error_m <= RIGHT_M)


RIGHT_M = 0.1
"""An end within this distance of the truth is right: the edge of the report's voxel."""


def find_basin(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    frame: int,
    offset_m: Array,
    every: int = 4,
    on_progress: Callable[[float], None] | None = None,
) -> Basin:
    """Register scan ``frame`` from starts ``offset_m (N, 3)`` beside its true pose to a map of the other scans.

    The map takes every so many scans, placed at their true poses.
    """
    if not isinstance(settings.odometry, CloudSettings):
        raise ValueError(f"method {settings.odometry.method!r}: expected an odometry by clouds")
    odometry = CloudOdometry(settings.odometry, settings.preprocess, flight.T_drone_sensor)
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    for k in range(0, len(flight.scans), every):
        if k != frame:
            points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, settings.preprocess)
            odometry.insert(points, true[k])
    ends, used = [], []
    for k, offset in enumerate(offset_m):
        start = true[frame].copy()
        start[:3, 3] += offset
        step = copy.deepcopy(odometry).update(flight.scans[frame], start)
        ends.append(step.T_world_drone)
        used.append(step.used)
        if on_progress:
            on_progress((k + 1) / len(offset_m))
    end = np.array(ends)
    return Basin(
        settings=settings,
        offset_m=offset_m,
        error_m=np.linalg.norm(end[:, :3, 3] - true[frame][:3, 3], axis=1),
        used=np.array(used),
        cloud=odometry.map_points(),
        scan=preprocess_scan(flight.scans[frame], true[frame], flight.T_drone_sensor, settings.preprocess),
        T_world_drone_true=true[frame],
        T_world_drone_end=end,
    )


def basin_table(basins: dict[str, Basin]) -> pd.DataFrame:
    """One row a registration: the radius within which all starts come home, and how many came home at all, ended
    wrong (hardly left their start, or locked onto something else), or were refused."""
    rows = {
        label: {
            "radius_m": basin_radius_m(basin.offset_m, basin.right),
            "right_share": basin.right.mean(),
            "wrong_share": basin.wrong.mean(),
            "stayed_share": basin.stayed.mean(),
            "locked_share": (basin.wrong & ~basin.stayed).mean(),
            "refused_share": (~basin.used).mean(),
        }
        for label, basin in basins.items()
    }
    return pd.DataFrame(rows).T


def offset_grid(reach_m: float, step_m: float) -> Array:
    """Offsets ``(N, 3)`` along x and z from −``reach_m`` to ``reach_m``, rows of z, in steps of about ``step_m``."""
    side = np.linspace(-reach_m, reach_m, 2 * round(reach_m / step_m) + 1)
    x, z = np.meshgrid(side, side)
    return np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])


def find_slips(results: Sequence[experiment.Result], wrong_m: float = 0.25, within_s: float = 1.0) -> pd.DataFrame:
    """Where translation-only ICP, or any method, locks onto a wrong bar: a row a run.

    ``wrong_share`` of the scans that had pairs ended farther than ``wrong_m`` from the truth; ``slip_m`` is the largest
    growth of the error ``within_s`` over such scans, at ``slip_s``.
    """
    rows = []
    for result in results:
        settings = result.settings
        error = position_error_m(result.corrected, result.truth.trajectory)
        paired = result.matches > 0
        scan, slip = largest_slip(error, max(1, round(within_s * settings.tof.rate_hz)))
        rows.append(
            {
                **case_of(settings),
                "max_correspondence_m": getattr(settings.odometry, "max_correspondence_m", np.nan),
                "blind_s": sum(last - first for first, last in settings.tof.blind_s),
                "ate_rmse_m": result.metrics["ate_rmse_m"],
                "error_final_m": result.metrics["error_final_m"],
                "wrong_share": float((error[paired] > wrong_m).mean()) if paired.any() else 0.0,
                "slip_m": slip,
                "slip_s": float(result.corrected.stamp_s[scan]),
            }
        )
    return pd.DataFrame(rows)
