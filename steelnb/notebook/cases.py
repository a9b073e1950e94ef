"""The experiments behind the report's plots."""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any

from steelnb.core import rng
from steelnb.core.errors import InputError
from steelnb.settings import ExperimentSettings, TowerSettings
from steelnb.settings.report_plots import ReportPlot, read_report_plots


def plot_of(settings: ExperimentSettings) -> ReportPlot | None:
    """The report's plot whose samples an experiment has, if it has its tower, flight and noise as well, or
    None."""
    name = settings.tof.samples
    plot = ReportPlot.named(name) if isinstance(name, str) else None
    if settings.tower != TowerSettings.preset("report"):
        return None
    if plot is None or plot.noise != settings.noise_name:
        return None
    return plot if (plot.flight or plot.trajectory) == settings.flight.trajectory else None


def report_cases(
    trajectory: Iterable[str],
    noise: str,
    methods: Mapping[str, Iterable[str]],
    sensor: str = "report",
    seed: rng.Seed = "report",
    duration_s: float | None = None,
    overrides: dict[str, Any] | None = None,
    tower: str | None = None,
) -> list[ExperimentSettings]:
    """Settings of the report's own experiments. ``methods`` maps the method of a plot to the methods that are run with
    the sampling of that plot. If no plot of a flight has the ``noise``, the sampling is that of its other plot.

    ``duration_s``: default, the duration of the plot. A plot's earlier run is left out. Raises `InputError`.
    """
    cases = []
    shown_runs = [plot for plot in read_report_plots() if not plot.run]
    for flight, shown in itertools.product(dict.fromkeys(trajectory), methods):
        plots = [plot for plot in shown_runs if (plot.trajectory, plot.method) == (flight, shown)]
        if not plots:
            known = "; ".join(sorted({f"{plot.method!r} on {plot.trajectory!r}" for plot in shown_runs}))
            raise InputError(f"no plot of the report shows {shown!r} on the flight {flight!r}; expected one of {known}")
        plot = next((plot for plot in plots if plot.noise == noise), plots[0])
        cases += [
            ExperimentSettings.report(
                plot.figure, flight, shown, method, overrides, "", noise, sensor, seed, duration_s, tower
            )
            for method in dict.fromkeys(methods[shown])
        ]  # fmt: skip
    return cases


def with_earlier_runs(cases: Iterable[ExperimentSettings]) -> list[ExperimentSettings]:
    """The cases, each after the earlier run that the report's plot of it shows, if there is one."""
    earlier = {f"{plot.figure} {plot.trajectory} {plot.method}": plot for plot in read_report_plots() if plot.run}
    found = []
    for case in cases:
        plot = plot_of(case)
        if plot and plot.name in earlier:
            own = case.override({"tof.samples": earlier[plot.name].name})
            found.append(
                own.override({"flight.duration_s": min(earlier[plot.name].duration_s, case.flight.duration_s)})
            )
        found.append(case)
    return found
