"""Simulated flights kept on disk, so that one that several notebooks need is flown once."""

from collections.abc import Callable

import numpy as np

from steelnb import rng
from steelnb.cache import kept
from steelnb.keys import file_digest
from steelnb.settings import FlightSettings, TofSettings
from steelnb.settings.presets import members_file
from steelnb.simulation.flight import Pilot, fly
from steelnb.simulation.scene import rays
from steelnb.simulation.tof import scan_flight
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import Visibility
from steelnb.types import Imu, RangeScans, Trajectory

Flown = tuple[Trajectory, Imu, RangeScans, Visibility]


def fly_and_scan(
    tower: Tower,
    flight: FlightSettings,
    tof: TofSettings,
    seed: rng.Seed,
    pilot: Callable[[], Pilot] | None = None,
    depends_on: tuple[object, str] | None = None,
) -> Flown:
    """True trajectory and IMU of `fly`, scans and visibility of `scan_flight`, `kept` between notebooks.

    A flight that a new ``pilot`` steers ``depends_on`` more: what JSON can hold, and the pilot's module. Ranges are
    float32, as flown, so that both ways give the same bits. Raises `CollisionError`.
    """

    def simulated():  # type: ignore[no-untyped-def]
        trajectory, imu = fly(tower, flight, seed, pilot() if pilot else None)
        scans, visibility = scan_flight(tower, trajectory, tof.T_drone_sensor, tof, seed)
        seen = np.isfinite(scans.range_m)  # kept alone: most rays pass the tower by
        readings = np.hstack([imu.specific_force, imu.angular_rate])
        return trajectory, readings, scans.stamp_s, np.packbits(seen), seen.shape, scans.range_m[seen], visibility

    settings = [each.model_dump(mode="json") for each in (tower.settings, flight, tof)]
    if tower.settings.members is not None:  # what is in the file may change
        settings.append({"members": file_digest(members_file(tower.settings.members))})
    more, module = depends_on or (None, __name__)
    key = [settings, seed] if depends_on is None else [settings, seed, more]
    trajectory, readings, stamp_s, seen, shape, finite_m, visibility = kept(
        "flights", lambda: key, [__name__, module], simulated
    )
    range_m = np.full(shape, np.nan, np.float32)
    range_m[np.unpackbits(seen, count=range_m.size).reshape(shape).astype(bool)] = finite_m
    imu = Imu(trajectory.stamp_s, readings[:, :3], readings[:, 3:])  # views, as those of `fly`
    return trajectory, imu, RangeScans(stamp_s, range_m, rays(tof)), visibility
