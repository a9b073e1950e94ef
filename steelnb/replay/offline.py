"""A flight through an odometry as fast as it goes, one scan in memory at a time."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, Flight, IntArray, OdometryStep, Scan, Segments, Trajectory
from steelnb.errors import RecordingError
from steelnb.odometry import Odometry, make_odometry

WARM_UP_SCANS = 3
"""The second scan is the first that is registered, the third finds everything loaded."""


@dataclass(frozen=True)
class Frame:
    """One scan that went through: its number among ``total``, its answer, and the wall time that took in seconds.

    ``on_time`` counts the frames so far that were done within the time to the next scan; ``began_s`` is when the first
    was begun, on the same clock as `time.perf_counter`.
    """

    index: int
    total: int
    scan: Scan
    step: OdometryStep
    seconds: float
    on_time: int
    began_s: float


Observer = Callable[[Frame, Odometry], None]


@dataclass(frozen=True)
class Replayed:
    """A flight corrected: trajectories at the K scans, what each scan gave, how long it took, and the map.

    ``matches (K,)``; ``reason``: why a scan corrected nothing, empty where it did; ``seconds (K,)``: wall time of each
    update; ``period_s (K,)``: the time from a scan to the next, which an update may take.
    """

    prior: Trajectory
    corrected: Trajectory
    matches: IntArray
    reason: tuple[str, ...]
    seconds: Array
    period_s: Array
    points: Array
    segments: Segments


def replay(flight: Flight, settings: ExperimentSettings, observers: Sequence[Observer] = ()) -> Replayed:
    """Correct a flight scan by scan, as `steelnb.experiment.estimate` does, and to the same bits.

    Observers are told of every frame; their time is not the odometry's.
    """
    odometry = make_odometry(settings, flight.T_drone_sensor)
    total, period_s = len(flight.prior), periods(flight.prior.stamp_s)
    T_world_drone, seconds = np.empty((total, 4, 4)), np.empty(total)
    matches, reason = np.empty(total, dtype=np.int64), []
    began_s, on_time = time.perf_counter(), 0
    for k, scan in enumerate(flight.scans):
        begin = time.perf_counter()
        step = odometry.update(scan, flight.prior.T_world_drone[k])
        seconds[k] = time.perf_counter() - begin
        T_world_drone[k], matches[k] = step.T_world_drone, step.matches
        reason.append("" if step.used else step.reason)
        on_time += bool(seconds[k] <= period_s[k])
        frame = Frame(k, total, scan, step, float(seconds[k]), on_time, began_s)
        for observe in observers:
            observe(frame, odometry)
    if len(reason) < total:
        raise RecordingError(f"{len(reason)} scans could be read; expected the {total} found when it was opened")
    corrected = Trajectory(flight.prior.stamp_s, T_world_drone)
    return Replayed(
        flight.prior, corrected, matches, tuple(reason), seconds, period_s, odometry.map_points(),
        odometry.map_segments(),
    )  # fmt: skip


def warm_up(flight: Flight, settings: ExperimentSettings) -> None:
    """Send the first scans through an odometry of their own, so that compiled code is loaded before time counts."""
    odometry = make_odometry(settings, flight.T_drone_sensor)
    for scan, T_world_drone_prior in zip(flight.scans[:WARM_UP_SCANS], flight.prior.T_world_drone, strict=False):
        odometry.update(scan, T_world_drone_prior)


@contextmanager
def uncounted(skipped: Counter[str]) -> Iterator[None]:
    """What is read within leaves a recording's count of what was skipped as it was."""
    before = Counter(skipped)
    try:
        yield
    finally:
        skipped.clear()
        skipped.update(before)


def periods(stamp_s: Array) -> Array:
    """Time ``(K,)`` from each stamp to the next; the last has the median, a lone one has no bound."""
    gaps = np.diff(stamp_s)
    return np.append(gaps, np.median(gaps) if len(gaps) else np.inf)
