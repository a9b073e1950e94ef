"""Simulated flights kept on disk, so that one that several notebooks need is flown once."""

import contextlib
import os
import zipfile
from pathlib import Path

import numpy as np

from steelnb.keys import code_digest, digest, environment_digest
from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation.flight import fly
from steelnb.simulation.tof import rays, scan_flight
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import Visibility
from steelnb.types import Array, Imu, RangeScans, Trajectory

CACHE_VARIABLE = "STEELNB_CACHE"
BYTES_MAX = 2_000_000_000
"""Size of the cache: beyond it, the flights that were used longest ago go."""

Flown = tuple[Trajectory, Imu, RangeScans, Visibility]


def fly_and_scan(tower: Tower, flight: FlightSettings, tof: TofSettings, seed: int) -> Flown:
    """True trajectory and IMU of `fly`, scans and visibility of `scan_flight`.

    Where ``STEELNB_CACHE`` names a folder (the workflow sets it to ``.cache`` of the project), they are read from
    ``flights/`` in it if they are there, else kept. Files belong to the settings, the code of the simulation and the
    versions of the libraries; ranges are float32, as flown, so that both ways give the same bits. Several processes
    may read and write at once. Raises `CollisionError`.
    """
    folder = os.environ.get(CACHE_VARIABLE)
    if not folder:
        return _simulate(tower, flight, tof, seed)
    settings = [each.model_dump(mode="json") for each in (tower.settings, flight, tof)]
    depends_on = code_digest([__name__]), environment_digest(Path(folder).parent)
    path = Path(folder, "flights", f"{digest(settings, seed, *depends_on)}.npz")
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # not there, or broken
        flown = _read(path, rays(tof))
        os.utime(path)
        return flown
    flown = _simulate(tower, flight, tof, seed)
    with contextlib.suppress(OSError):  # a full disk costs time, nothing else
        _write(path, flown)
        _trim(path.parent)
    return flown


def _simulate(tower: Tower, flight: FlightSettings, tof: TofSettings, seed: int) -> Flown:
    trajectory, imu = fly(tower, flight, seed)
    return trajectory, imu, *scan_flight(tower, trajectory, tof.T_drone_sensor, tof, seed)


def _write(path: Path, flown: Flown) -> None:
    """Keep the finite ranges alone: most rays pass the tower by."""
    trajectory, imu, scans, visibility = flown
    seen = np.isfinite(scans.range_m)
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{os.getpid()}.new")
    try:
        with fresh.open("wb") as file:
            np.savez(
                file,
                stamp_s=trajectory.stamp_s,
                T_world_drone=trajectory.T_world_drone,
                imu=np.hstack([imu.specific_force, imu.angular_rate]),
                scan_stamp_s=scans.stamp_s,
                seen=np.packbits(seen),
                shape=seen.shape,
                range_m=scans.range_m[seen],
                slices=np.concatenate(visibility.slices),
                slice_end=np.cumsum([len(part) for part in visibility.slices]),
            )
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)


def _read(path: Path, ray: Array) -> Flown:
    with np.load(path) as kept:
        shape = tuple(kept["shape"])
        range_m = np.full(shape, np.nan, np.float32)
        range_m[np.unpackbits(kept["seen"], count=range_m.size).reshape(shape).astype(bool)] = kept["range_m"]
        stamp_s, imu = kept["stamp_s"], kept["imu"]
        return (
            Trajectory(stamp_s, kept["T_world_drone"]),
            Imu(stamp_s, imu[:, :3], imu[:, 3:]),  # views, as those of `fly`
            RangeScans(kept["scan_stamp_s"], range_m, ray),
            Visibility(tuple(np.split(kept["slices"], kept["slice_end"][:-1]))),
        )


def _trim(folder: Path) -> None:
    """Remove files used longest ago, until the folder is small enough; files of a killed process go the same way."""
    files = []
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            status = path.stat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= BYTES_MAX:
            return
        path.unlink(missing_ok=True)
        total -= size
