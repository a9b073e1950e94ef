"""The report's plots of error against sample number, with the flight, the noise and the sample times of each."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from steelnb.errors import InputError
from steelnb.settings.presets import PRESETS, read_toml
from steelnb.settings.world import TrajectoryName
from steelnb.types import Array

STEP_S = 0.008
"""The original's simulator step."""
NOISES = {"3.2": "constant-drift", "3.3": "constant-drift", "3.5": "random-walk", "3.6": "constant-drift"}


@dataclass(frozen=True, kw_only=True)
class ReportPlot:
    """One of the plots of ``presets/report-plots.toml``, named as in ``notebooks/report-curves.csv``.

    Sample k was taken at the simulator's step ``first_step + k * steps_per_sample``. The plot shows ``samples`` samples
    after ``earlier_samples`` from another run. ``flight``: the flight's preset, if its name is not the trajectory's.
    """

    figure: str
    trajectory: TrajectoryName
    method: str
    flight: TrajectoryName | None = None
    first_step: int
    steps_per_sample: float
    samples: int
    earlier_samples: int = 0

    @property
    def noise(self) -> str:
        """The noise of the figure."""
        return NOISES[self.figure]

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return 1 / (self.steps_per_sample * STEP_S)

    @property
    def start_s(self) -> float:
        """Time of the first sample."""
        return self.first_step * STEP_S

    @property
    def duration_s(self) -> float:
        """Duration of the flight, which ends just after the last sample."""
        return STEP_S * float(np.ceil(self.first_step + (self.samples - 1) * self.steps_per_sample) + 1)

    def step_at(self, sample: Array) -> Array:
        """Simulator steps ``(N,)`` at positions ``sample (N,)`` on the plot's axis; not valid for the earlier run."""
        return np.asarray(self.first_step + (sample - self.earlier_samples) * self.steps_per_sample)

    @classmethod
    def find(cls, figure: str, trajectory: str, method: str) -> "ReportPlot":
        """The plot of a figure, trajectory and method. Raises `InputError`."""
        plots = {(str(each.figure), str(each.trajectory), each.method): each for each in read_report_plots()}
        if (figure, trajectory, method) not in plots:
            known = "; ".join(" ".join(names) for names in plots)
            raise InputError(f"plot {figure} {trajectory} {method}: expected one of {known}")
        return plots[figure, trajectory, method]


@cache
def read_report_plots() -> tuple[ReportPlot, ...]:
    """All plots of ``presets/report-plots.toml``."""
    return tuple(ReportPlot(**values) for values in read_toml(PRESETS / "report-plots.toml")["plot"])
