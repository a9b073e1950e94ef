"""Simulated flights kept on disk, so that one that several notebooks need is flown once."""

from collections.abc import Callable

import numpy as np

from steelnb.cache import kept
from steelnb.keys import file_digest
from steelnb.settings import ExperimentSettings
from steelnb.settings.presets import members_file
from steelnb.simulation.flight import Pilot, fly
from steelnb.simulation.scene import rays
from steelnb.simulation.tof import scan_flight
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import Visibility
from steelnb.types import Imu, RangeScans, Trajectory


def fly_and_scan(
    settings: ExperimentSettings, tower: Tower, pilot: Callable[[], Pilot] | None = None
) -> tuple[Trajectory, Imu, RangeScans, Visibility]:
    """True trajectory and IMU of `fly`, scans and visibility of `scan_flight`, `kept` between notebooks.

    ``pilot`` makes the one who steers, by which a flight depends on all settings and on the pilot's code. Ranges are
    float32, as flown, so that both ways give the same bits. Raises `CollisionError`.
    """
    tof, seed = settings.tof, settings.seed

    def simulated():  # type: ignore[no-untyped-def]
        trajectory, imu = fly(tower, settings.flight, seed, pilot() if pilot else None)
        scans, visibility = scan_flight(tower, trajectory, tof.T_drone_sensor, tof, seed)
        seen = np.isfinite(scans.range_m)  # kept alone: most rays pass the tower by
        readings = np.hstack([imu.specific_force, imu.angular_rate])
        return trajectory, readings, scans.stamp_s, np.packbits(seen), seen.shape, scans.range_m[seen], visibility

    members = settings.tower.members  # what is in the file may change
    parts = None if pilot else {"tower", "flight", "tof", "seed"}
    key = [settings.model_dump(mode="json", include=parts), members and file_digest(members_file(members))]
    modules = [__name__, "steelnb.closed_loop"] if pilot else [__name__]
    trajectory, readings, stamp_s, seen, shape, finite_m, visibility = kept("flights", lambda: key, modules, simulated)
    range_m = np.full(shape, np.nan, np.float32)
    range_m[np.unpackbits(seen, count=range_m.size).reshape(shape).astype(bool)] = finite_m
    imu = Imu(trajectory.stamp_s, readings[:, :3], readings[:, 3:])  # views, as those of `fly`
    return trajectory, imu, RangeScans(stamp_s, range_m, rays(tof)), visibility
