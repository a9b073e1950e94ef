"""Small flights that several tests replay."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, Scan, Trajectory
from steelnb.recordings.recording import Recording
from steelnb.replay.simulated import HeldScans

NOISE = "random-walk:0.002"


def settings(method: str = "best", seed: int = 3, duration_s: float = 8.0, **more) -> ExperimentSettings:  # type: ignore[no-untyped-def]
    """A short vertical flight with a quarter of the pixels."""
    given = {"tof.columns": 90, "tof.rows": 120, **more}
    return ExperimentSettings.preset(
        "vertical", NOISE, sensor="starling2", method=method, seed=seed, duration_s=duration_s, overrides=given
    )  # type: ignore[arg-type]


def straight(stamp_s: Array, speed_m_s: float = 0.25) -> Trajectory:
    """Level flight along x, 2 m above the ground."""
    T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    T[:, 0, 3], T[:, 2, 3] = speed_m_s * stamp_s, 2.0
    return Trajectory(stamp_s, T)


def made(points: Callable[[int], Array], scans: int = 8, **more) -> Recording:  # type: ignore[no-untyped-def]
    """A recording of ``points(k)`` at 5 Hz on a straight flight, without truth."""
    stamp_s = 0.2 * np.arange(scans)
    held = HeldScans([Scan(float(s), np.asarray(points(k), dtype=float)) for k, s in enumerate(stamp_s)], stamp_s)
    given = {"poses": straight(stamp_s), "skipped": Counter(), **more}
    return Recording(Path("made.bag"), held, T_drone_sensor=np.eye(4), **given)


def lattice(rng: np.random.Generator, x_m: float = 2.5) -> Array:
    """Points ``(N, 3)`` on a few bars ahead of the sensor, with 1 cm of noise."""
    along = np.linspace(-1.2, 1.2, 150)
    zero, x = np.zeros_like(along), np.full_like(along, x_m)
    bars = [np.c_[x, along, zero + h] for h in (-0.6, 0.5)] + [np.c_[x, zero + y, along] for y in (-0.8, 0.7)]
    bars.append(np.c_[x + 0.3 * along, along, along])
    return np.concatenate(bars) + 0.01 * rng.standard_normal((5 * len(along), 3))
