"""What a study will take: seconds and bytes of each run, from runs that are known or else from a rule of thumb."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from steelnb.config import TofSettings
from steelnb.study.plan import Run, by_flight

if TYPE_CHECKING:
    import pyarrow as pa

FRAME_S = {"report": 0.0065, "starling2": 0.016}
"""Of no known run: seconds a frame, about the mean of the methods in the results' timing.csv."""
RAY_S = 0.25e-6
"""Of no known flight: seconds a ray, the flight itself with it (benchmarks/speed.md: 4 to 6 million rays a second)."""
WORKER_BYTES = 0.5e9
"""A worker with all modules, one tower and one map, without scans; measured, see benchmarks/study.md."""


class Costs:
    """Seconds of runs and flights, a second of flight, as the median of known ones of the same kind.

    ``rows`` are those of a store.
    """

    def __init__(self, rows: "pa.Table") -> None:
        self._runs: dict[tuple[str, ...], float] = {}
        self._flights: dict[tuple[str, ...], float] = {}
        names = ["sensor", "trajectory", "method", "duration_s", "status", "seconds", "flight_seconds"]
        if set(names) - {*rows.column_names}:
            return
        frame = rows.select(names).to_pandas()
        frame = frame[(frame["status"] == "ok") & frame["seconds"].notna()]
        for column, by, known in (
            ("seconds", ["sensor", "trajectory", "method"], self._runs),
            ("flight_seconds", ["sensor", "trajectory"], self._flights),
        ):
            rate = (frame[column] / frame["duration_s"]).groupby([frame[name] for name in by]).median()
            known.update({tuple(key): float(value) for key, value in rate.items() if np.isfinite(value)})  # type: ignore[misc, arg-type]

    def run_s(self, run: Run) -> float:
        """Expected seconds of a run on a flight that is there."""
        flight, tof = run.settings.flight, run.settings.tof
        rule = FRAME_S[run.settings.sensor] * tof.rate_hz
        return flight.duration_s * self._runs.get(
            (run.settings.sensor, flight.trajectory, run.settings.odometry.method), rule
        )

    def flight_s(self, run: Run) -> float:
        """Expected seconds of the flight and the scans of a run."""
        flight, tof = run.settings.flight, run.settings.tof
        rule = RAY_S * tof.columns * tof.rows * tof.rate_hz
        return flight.duration_s * self._flights.get((run.settings.sensor, flight.trajectory), rule)

    def total_s(self, runs: Sequence[Run]) -> float:
        """Expected seconds of runs and their flights, one after the other."""
        return sum(map(self.run_s, runs)) + sum(self.flight_s(flight[0]) for flight in by_flight(runs))


def scan_bytes(tof: TofSettings, duration_s: float) -> float:
    """Bytes of the range images of a flight."""
    return 4.0 * tof.columns * tof.rows * tof.rate_hz * duration_s


def worker_bytes(runs: Sequence[Run]) -> float:
    """Expected bytes of a worker: itself, and two of the largest flights, one of which may be waiting."""
    sizes = (scan_bytes(run.settings.tof, run.settings.flight.duration_s) for run in runs)
    return WORKER_BYTES + 2 * max(sizes, default=0.0)
