"""Simulated flights kept on disk, so that one that several notebooks need is flown once."""

from collections.abc import Callable

import numpy as np

from steelnb.cache import Arrays, kept
from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation.flight import Pilot, fly
from steelnb.simulation.scene import rays
from steelnb.simulation.tof import scan_flight
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import Visibility
from steelnb.types import Array, Imu, RangeScans, Trajectory

Flown = tuple[Trajectory, Imu, RangeScans, Visibility]


def fly_and_scan(
    tower: Tower,
    flight: FlightSettings,
    tof: TofSettings,
    seed: int,
    pilot: Callable[[], Pilot] | None = None,
    depends_on: tuple[object, str] | None = None,
) -> Flown:
    """True trajectory and IMU of `fly`, scans and visibility of `scan_flight`, `kept` between notebooks.

    A flight that a new ``pilot`` steers ``depends_on`` more: what JSON can hold, and the pilot's module. Ranges are
    float32, as flown, so that both ways give the same bits. Raises `CollisionError`.
    """

    def simulated() -> Flown:
        trajectory, imu = fly(tower, flight, seed, pilot() if pilot else None)
        return trajectory, imu, *scan_flight(tower, trajectory, tof.T_drone_sensor, tof, seed)

    settings = [each.model_dump(mode="json") for each in (tower.settings, flight, tof)]
    more, module = depends_on or (None, __name__)
    key = [settings, seed] if depends_on is None else [settings, seed, more]
    return kept("flights", lambda: key, [__name__, module], simulated, _pack, lambda each: _unpack(each, rays(tof)))


def _pack(flown: Flown) -> Arrays:
    """Keep the finite ranges alone: most rays pass the tower by."""
    trajectory, imu, scans, visibility = flown
    seen = np.isfinite(scans.range_m)
    return {
        "stamp_s": trajectory.stamp_s,
        "T_world_drone": trajectory.T_world_drone,
        "imu": np.hstack([imu.specific_force, imu.angular_rate]),
        "scan_stamp_s": scans.stamp_s,
        "seen": np.packbits(seen),
        "shape": seen.shape,
        "range_m": scans.range_m[seen],
        "slices": np.concatenate(visibility.slices),
        "slice_end": np.cumsum([len(part) for part in visibility.slices]),
    }


def _unpack(arrays: Arrays, ray: Array) -> Flown:
    shape = tuple(arrays["shape"])
    range_m = np.full(shape, np.nan, np.float32)
    range_m[np.unpackbits(arrays["seen"], count=range_m.size).reshape(shape).astype(bool)] = arrays["range_m"]
    stamp_s, imu = arrays["stamp_s"], arrays["imu"]
    return (
        Trajectory(stamp_s, arrays["T_world_drone"]),
        Imu(stamp_s, imu[:, :3], imu[:, 3:]),  # views, as those of `fly`
        RangeScans(arrays["scan_stamp_s"], range_m, ray),
        Visibility(tuple(np.split(arrays["slices"], arrays["slice_end"][:-1]))),
    )
