"""The report's plots of error against sample number, with the flight, the noise and the sample times of each."""

import csv
import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from steelnb.core.checks import checked_kind
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.types import Array, IntArray
from steelnb.settings.base import as_plain
from steelnb.settings.presets import PRESETS, read_toml

STEP_S = 0.008
"""Step of the simulation, as in the original."""
SENSOR_STEPS = 26
"""The original's sensor takes a scan every 26 steps."""
NOISES = {"3.2": "constant-drift", "3.3": "constant-drift", "3.5": "random-walk", "3.6": "constant-drift"}
SAMPLES = PRESETS / "report-samples.csv"
"""Steps of the samples of the slow programs, which are not evenly spaced: figure, trajectory, method, sample, step."""


@dataclass(frozen=True, kw_only=True)
class ReportPlot:
    """One of the plots of ``presets/report-plots.toml``, named as in ``notebooks/report-curves.csv``.

    Samples ``first_sample``, ``first_sample + 1``, … of the plot's axis, ``samples`` of them, belong to this ``run``;
    one plot begins with an ``earlier`` run. If they are evenly spaced, sample ``first_sample + k`` was taken at the
    simulator's step ``first_step + k * steps_per_sample``, rounded; else `SAMPLES` has the steps. ``flight``: the
    flight's preset, if its name is not the trajectory's. ``still_s``: seconds at rest before the
    flight, if not those of the preset. ``broken_off_s``: first and last second of an unlogged run before, whose map and
    correction the program kept; empty for none.
    """

    figure: str
    trajectory: str
    method: str
    run: str = ""
    flight: str = ""
    samples: int
    first_sample: int = 0
    first_step: int = 0
    steps_per_sample: float = 0.0
    still_s: float | None = None
    broken_off_s: tuple[float, float] | tuple[()] = ()

    @property
    def name(self) -> str:
        """Figure, trajectory, method and, if it is an earlier one, the run, separated by spaces."""
        return " ".join(filter(None, (self.figure, self.trajectory, self.method, self.run)))

    @property
    def noise(self) -> str:
        """The noise of the figure."""
        return NOISES[self.figure]

    @property
    def steps(self) -> IntArray:
        """The simulator's steps ``(samples,)`` at which the samples were taken."""
        if self.steps_per_sample:
            return np.round(self.first_step + np.arange(self.samples) * self.steps_per_sample).astype(np.int64)
        return _uneven_steps()[self.figure, self.trajectory, self.method]

    @property
    def scans(self) -> IntArray:
        """The steps at which the program used a scan. The first scan of a program for clouds becomes its map, and is
        not logged; if the map was kept, there is no such scan."""
        steps, logs_all = self.steps, self.method == "average" or self.broken_off_s
        return steps if logs_all else np.append(steps[0] - SENSOR_STEPS, steps)

    @property
    def duration_s(self) -> float:
        """Duration of the flight, which ends just after the last sample."""
        return STEP_S * float(self.steps[-1] + 2)

    def time_at(self, sample: Array) -> Array:
        """Times ``(N,)``, s, at positions ``sample (N,)`` on the plot's axis; NaN outside this run."""
        number = self.first_sample + np.arange(self.samples)
        return np.asarray(STEP_S * np.interp(sample, number, self.steps, left=np.nan, right=np.nan))

    def sample_at(self, time_s: Array) -> Array:
        """Positions ``(N,)`` on the plot's axis at times ``time_s (N,)``; NaN outside this run."""
        number = self.first_sample + np.arange(self.samples)
        return np.asarray(np.interp(time_s, STEP_S * self.steps, number, left=np.nan, right=np.nan))

    @classmethod
    def find(cls, figure: str, trajectory: str, method: str, run: str = "") -> "ReportPlot":
        """The plot of a figure, trajectory and method. Raises `InputError`."""
        for name, part in (("figure", figure), ("trajectory", trajectory), ("method", method), ("run", run)):
            checked_kind(part, name, str)
        return cls.named(" ".join(filter(None, (figure, trajectory, method, run))))

    @classmethod
    def named(cls, name: str) -> "ReportPlot":
        """The plot of a `name`. Raises `InputError`."""
        plots = {each.name: each for each in read_report_plots()}
        if name not in plots:
            raise InputError(f"plot {name}: expected one of {'; '.join(plots)}")
        return plots[name]


@cache
def read_report_plots() -> tuple[ReportPlot, ...]:
    """All plots of ``presets/report-plots.toml``; an earlier run is a plot of its own, before the one that it is in."""
    return tuple(ReportPlot(**as_plain(values)) for values in read_toml(PRESETS / "report-plots.toml")["plot"])


@cache
def _uneven_steps() -> dict[tuple[str, str, str], IntArray]:
    """The steps in `SAMPLES` by figure, trajectory and method. Raises `InputError`."""
    with reading(SAMPLES, "the steps of the report's samples"), SAMPLES.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
        key = ("figure", "trajectory", "method")
        grouped = itertools.groupby(rows, lambda row: tuple(row[name] for name in key))
        return {
            (figure, trajectory, method): checked_steps(np.array([int(row["step"]) for row in some]))
            for (figure, trajectory, method), some in grouped
        }


def checked_steps(steps: IntArray) -> IntArray:
    """The same ``steps (N,)``. Raises `InputError` if they do not increase from 0 or more."""
    fault = np.flatnonzero(np.diff(steps, prepend=-1) <= 0)
    if len(fault):
        k = int(fault[0])
        before = f"step {steps[k - 1]} before it" if k else "no step below 0"
        raise InputError(f"scan {k} at step {steps[k]}, {before}: expected steps that increase")
    return steps
