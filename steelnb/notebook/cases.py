"""The experiments of each notebook, which its parameters are checked by."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from steelnb.core import rng
from steelnb.core.checks import shown
from steelnb.core.errors import InputError
from steelnb.settings import ExperimentSettings, TrajectoryName
from steelnb.settings.report_plots import ReportPlot, read_report_plots

PAIR = "max_correspondence_m"
UP = {"flight.goal": "face", "flight.height_max_m": 15.0, "flight.speed_m_s": 0.18}
PLANNER_FLIGHTS: Mapping[str, tuple[TrajectoryName, dict[str, Any]]] = {
    "zigzag": ("zigzag", {}), "wide loops": ("loops", {"flight.standoff_m": 2.4}), "loops": ("loops", {}),
    "planned": ("planned", {}), "up a face": ("planned", UP),
}  # fmt: skip
"""The flights of notebook 11: trajectory, and what differs from its preset."""


def joined(changes: Mapping[str, Any], overrides: Mapping[str, Any], case: str) -> dict[str, Any]:
    """The changes that make a case what its name says, with a reader's ``overrides``. Raises `InputError` for an
    override of one of these."""
    for name, value in changes.items():
        if name in overrides:
            own = f"overrides: {name} = {shown(overrides[name])}"
            raise InputError(f"{own}: {case!r} sets it to {shown(value)}; leave out one of them")
    return {**changes, **overrides}


def plot_of(settings: ExperimentSettings) -> ReportPlot | None:
    """The report's plot whose samples an experiment has, if it has its tower, flight and noise as well, or
    None."""
    if not isinstance(settings.tof.samples, str):
        return None
    plot = ReportPlot.named(settings.tof.samples)
    own = ExperimentSettings.report(plot.figure, plot.trajectory, plot.method, run=plot.run)
    theirs = own.flight.model_copy(update={"duration_s": settings.flight.duration_s})
    same = (own.tower, own.noise_name, theirs) == (settings.tower, settings.noise_name, settings.flight)
    return plot if same else None


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
    for flight, program in itertools.product(dict.fromkeys(trajectory), methods):
        plots = [plot for plot in shown_runs if (plot.trajectory, plot.method) == (flight, program)]
        if not plots:
            known = "; ".join(sorted({f"{plot.method!r} on {plot.trajectory!r}" for plot in shown_runs}))
            raise InputError(
                f"no plot of the report shows {program!r} on the flight {flight!r}; expected one of {known}"
            )
        plot = next((plot for plot in plots if plot.noise == noise), plots[0])
        cases += [
            ExperimentSettings.report(
                plot.figure, flight, program, method, overrides, "", noise, sensor, seed, duration_s, tower
            )
            for method in dict.fromkeys(methods[program])
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


def world_cases(
    seed: rng.Seed, duration_s: float | None, overrides: Mapping[str, Any], tower: str | None
) -> dict[str, ExperimentSettings]:
    """The report's two flights, by name: notebook 01. Raises `InputError`."""
    given = {"sensor": "report", "seed": seed, "duration_s": duration_s, "overrides": overrides, "tower": tower}
    return {name: ExperimentSettings.preset(name, **given) for name in ("vertical", "orbit")}  # type: ignore[arg-type]


def basin_cases(
    trajectory: Sequence[str], noise: Sequence[str], sensor: str, seed: Sequence[rng.Seed], duration_s: float,
    correspondence_m: Iterable[float], overrides: Mapping[str, Any], tower: str | None,
) -> dict[str, ExperimentSettings]:  # fmt: skip
    """The registrations on the first flight whose basins notebook 04 maps, by name. Raises `InputError`."""
    narrow = {f"3-DoF ICP, {each:g} m": ("icp-3dof", {PAIR: each}) for each in correspondence_m}
    given = sensor, seed[0], duration_s
    return {
        key: ExperimentSettings.preset(trajectory[0], noise[0], name, *given, joined(changes, overrides, key), tower)  # type: ignore[arg-type]
        for key, (name, changes) in {**narrow, "GICP, 0.3 m": ("gicp", {}), "best": ("best", {})}.items()
    }


def slip_cases(
    trajectory: Sequence[str], noise: Sequence[str], sensor: str, seed: Sequence[rng.Seed], duration_s: float,
    correspondence_m: Iterable[float], blind_s: Sequence[Sequence[float]], overrides: Mapping[str, Any],
    tower: str | None,
) -> list[ExperimentSettings]:  # fmt: skip
    """Flights without gaps in sight and, if there are any, with them, of the 3-DoF registrations of notebook 04. Raises
    `InputError`."""
    methods = [*(("icp-3dof", {PAIR: each}) for each in correspondence_m), ("report-icp-3dof", {})]
    sights: list[dict[str, Any]] = [{}, {"tof.blind_s": blind_s}] if blind_s else [{}]
    axes = seed, sights, trajectory, noise, methods
    return [
        ExperimentSettings.preset(
            way, drift, name, sensor, start, duration_s, joined(sight | changes, overrides, name), tower  # type: ignore[arg-type]
        )
        for start, sight, way, drift, (name, changes) in itertools.product(*axes)
    ]  # fmt: skip


def cloud_case(tower: str, seed: rng.Seed, duration_s: float) -> ExperimentSettings:
    """The flight whose scans notebook 06 merges to a cloud of a whole tower, ground included. Raises `InputError`."""
    settings = ExperimentSettings.preset("loops", "none", "best", "starling2", seed, duration_s)
    return settings.override({"tower": tower, "preprocess.floor_m": -10.0})


def planner_cases(
    flights: Iterable[str], noise: str, method: str, sensor: str, seed: rng.Seed, duration_s: float,
    overrides: Mapping[str, Any],
) -> dict[str, ExperimentSettings]:  # fmt: skip
    """Some of `PLANNER_FLIGHTS`, by name: notebook 11. Raises `InputError`."""
    cases = {}
    for name in flights:
        trajectory, changes = PLANNER_FLIGHTS[name]
        own = joined(changes, overrides, name)
        cases[name] = ExperimentSettings.preset(trajectory, noise, method, sensor, seed, duration_s, own)
    return cases
