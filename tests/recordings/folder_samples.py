"""A made-up flight with a pinhole camera, for the tests of folders."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.config import TofSettings
from steelnb.datatypes import Imu, RangeScans, Scan, Trajectory
from steelnb.recordings.recording import Picture, Recording
from steelnb.simulation.tof import rays
from tests.recordings.bag_samples import Listed

ROWS, COLUMNS = 12, 16


def flown(count: int, period_s: float, begin_s: float = 0.0, seed: int = 0) -> Trajectory:
    """Poses that move and turn a little from each to the next."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.normal(scale=0.02, size=(count, 3)), axis=0)
    T[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.01, size=(count, 3)), axis=0)).as_matrix()
    return Trajectory(begin_s + period_s * np.arange(count), T)


def pinhole(scans: int = 5, begin_s: float = 0.0, pictures: bool = False) -> Recording:
    """Range images at 5 Hz with a third of the pixels empty, poses at 50 Hz, a mount that turns, IMU, another truth."""
    rng = np.random.default_rng(4)
    settings = TofSettings(columns=COLUMNS, rows=ROWS)
    range_m = rng.uniform(0.4, 5.0, (scans, ROWS, COLUMNS)).astype(np.float32)
    range_m[rng.uniform(size=range_m.shape) < 0.3] = np.nan
    stamp_s = begin_s + 0.2 * np.arange(scans)
    images = RangeScans(stamp_s, range_m, rays(settings))
    time = begin_s + 0.008 * np.arange(100)
    imu = Imu(time, rng.normal(size=(100, 3)), rng.normal(size=(100, 3)))
    shots = [Picture(float(t), rng.integers(0, 255, (8, 10, 3), np.uint8)) for t in stamp_s]
    T_drone_sensor = np.eye(4)
    T_drone_sensor[:3, :3] = Rotation.from_euler("xyz", (0.1, -0.2, 0.3)).as_matrix()
    T_drone_sensor[:3, 3] = 0.06, -0.01, 0.02
    return Recording(
        Path("made-up"), Listed([Scan(float(t), images[k].points) for k, t in enumerate(stamp_s)]),
        flown(10 * scans, 0.02, begin_s), T_drone_sensor, imu, flown(10 * scans, 0.02, begin_s, seed=1),
        Listed(shots) if pictures else None,
    )  # fmt: skip


def finite(points: np.ndarray) -> np.ndarray:
    """The valid points ``(M, 3)`` of a scan."""
    flat = points.reshape(-1, 3)
    return flat[np.isfinite(flat).all(axis=1)]
