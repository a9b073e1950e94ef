"""All runs of the notebooks and of a study: every enumeration of settings is here.

The arguments of a function named like a notebook are that notebook's parameters: their types, and the settings that it
makes of them, say what is refused (`steelnb.notebook.parameters`). Libraries that take a second to import are imported
where they are needed, so that a refusal takes no longer than the start of a kernel.
"""

import hashlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, Field, field_validator

from steelnb.core import rng
from steelnb.core.checks import checked_choice, shown
from steelnb.core.errors import InputError
from steelnb.settings import METHODS, ExperimentSettings, Noise, OdometrySettings, OrbSettings, Settings, TrajectoryName
from steelnb.settings.base import (
    Duration,
    Finite,
    NotNegative,
    Positive,
    SeedOrReport,
    read_tables,
    seeds_of,
)
from steelnb.settings.presets import NameOrPath
from steelnb.settings.report_plots import ReportPlot, read_report_plots
from steelnb.settings.world import at_level

CASE_COLUMNS = ("trajectory", "noise", "method", "sensor", "seed")
"""The columns of `case_of`."""
RUN_COLUMNS = ("sensor", "duration_s", "trajectory", "seed", "noise", "variant", "method")
"""Columns that identify a run of a study; tables are sorted by them."""
PAIR = "max_correspondence_m"
UP = {"flight.goal": "face", "flight.height_max_m": 15.0, "flight.speed_m_s": 0.18}
PLANNER_FLIGHTS: Mapping[str, tuple[TrajectoryName, dict[str, Any]]] = {
    "zigzag": ("zigzag", {}), "wide loops": ("loops", {"flight.standoff_m": 2.4}), "loops": ("loops", {}),
    "planned": ("planned", {}), "up a face": ("planned", UP),
}  # fmt: skip
"""The flights of notebook 11: trajectory, and what differs from its preset."""
T = TypeVar("T")


def each_once(values: list[T]) -> list[T]:
    """The same list. Raises ValueError for a value that it has twice."""
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ValueError(f"{value!r} twice; expected each once")
    return values


Some = Annotated[list[T], Field(min_length=1), AfterValidator(each_once)]
Count = Annotated[int, Field(gt=0)]
Draws = Annotated[int, Field(ge=2)]
StudySeed = Annotated[int, Field(ge=0, lt=2**63)]
Share = Annotated[float, Field(gt=0, le=1)]
MethodsOfPlots = Annotated[dict[str, Some[str]], Field(min_length=1)]
"""Method of one of the report's plots → the methods that fly on its samples."""
Overrides = dict[str, Any]
Ours = Literal["zigzag", "loops"]


def case_of(settings: ExperimentSettings) -> dict[str, Any]:
    """The columns that name a run in tables."""
    return {
        "trajectory": settings.flight.trajectory,
        "noise": settings.noise_name,
        "method": settings.odometry.method,
        "sensor": settings.sensor,
        "seed": settings.seed,
    }


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


def cloud_case(tower: str, seed: rng.Seed, duration_s: float) -> ExperimentSettings:
    """The flight whose scans notebook 06 merges to a cloud of a whole tower, ground included. Raises `InputError`."""
    settings = ExperimentSettings.preset("loops", "none", "best", "starling2", seed, duration_s)
    return settings.override({"tower": tower, "preprocess.floor_m": -10.0})


def explore(
    trajectory: TrajectoryName, noise: str, level: NotNegative, sensor: NameOrPath, method: str, seed: StudySeed,
    tower: str | None, duration_s: Duration, overrides: Overrides,
) -> ExperimentSettings:  # fmt: skip
    """The first flight of the panel."""
    noise = at_level(noise, level)
    return ExperimentSettings.preset(trajectory, noise, method, sensor, seed, duration_s, overrides, tower)


def world_and_noise(
    noise: Some[str], seed: SeedOrReport, seeds: Count, duration_s: Duration | None, drift_s: Duration,
    tower: str | None, overrides: Overrides,
) -> dict[str, ExperimentSettings]:  # fmt: skip
    """The report's two flights, by name."""
    for each in noise:
        Noise.parse(each)
    given: dict[str, Any] = {"sensor": "report", "seed": seed, "duration_s": duration_s, "tower": tower}
    names: tuple[TrajectoryName, ...] = ("vertical", "orbit")
    return {name: ExperimentSettings.preset(name, overrides=overrides, **given) for name in names}


def segment_odometry(
    trajectory: str, sensor: NameOrPath, noise: str, correction: Some[str], draws: Draws, seed: SeedOrReport,
    duration_s: Duration | None, tower: str | None, overrides: Overrides,
) -> list[ExperimentSettings]:  # fmt: skip
    """The flight without correction and with each, on the samples of the report's plot."""
    methods = {"average": ["none", *correction]}
    _check_shown(methods)
    cases = report_cases([trajectory], noise, methods, sensor, seed, duration_s, overrides, tower)
    for case in cases:
        case.check_draws()
    return cases


def icp_odometry(
    noise: str, sensor: NameOrPath, trajectory: Some[str], methods: MethodsOfPlots, drawn: Some[str], draws: Draws,
    seed: SeedOrReport, duration_s: Duration | None, tower: str | None, overrides: Overrides,
) -> list[ExperimentSettings]:  # fmt: skip
    """Each method on the samples of its plot, and each flight."""
    _check_shown(methods, drawn=drawn)
    cases = report_cases(trajectory, noise, methods, sensor, seed, duration_s, overrides, tower)
    for case in with_earlier_runs(cases):
        case.check_draws()
    return cases


def false_convergence(
    sensor: NameOrPath, trajectory: Some[TrajectoryName], noise: Some[str], seed: Some[SeedOrReport],
    duration_s: Duration, correspondence_m: Some[Positive], blind_s: list[list[Finite]], reach_m: Positive,
    step_m: Positive, poor_starts: Count, tower: str | None, overrides: Overrides,
) -> tuple[dict[str, ExperimentSettings], list[ExperimentSettings]]:  # fmt: skip
    """The registrations on the first flight whose basins are mapped, by name; and flights without gaps in sight and, if
    there are any, with them, of the 3-DoF registrations."""
    near: list[tuple[str, dict[str, Any]]] = [("icp-3dof", {PAIR: each}) for each in correspondence_m]
    basins = {f"3-DoF ICP, {each:g} m": case for each, case in zip(correspondence_m, near, strict=True)}
    basins |= {"GICP, 0.3 m": ("gicp", {}), "best": ("best", {})}
    sights: list[dict[str, Any]] = [{}, {"tof.blind_s": blind_s}] if blind_s else [{}]
    axes = seed, sights, trajectory, noise, [*near, ("report-icp-3dof", {})]
    return {
        key: ExperimentSettings.preset(
            trajectory[0], noise[0], name, sensor, seed[0], duration_s, joined(changes, overrides, key), tower
        )
        for key, (name, changes) in basins.items()
    }, [
        ExperimentSettings.preset(
            way, drift, name, sensor, start, duration_s, joined(sight | changes, overrides, name), tower
        )
        for start, sight, way, drift, (name, changes) in itertools.product(*axes)
    ]


def yaw_drift(
    noise: str, sensor: NameOrPath, trajectory: str, methods: MethodsOfPlots, mapped: Some[str], drawn: Some[str],
    seed: SeedOrReport, duration_s: Duration, tower: str | None, overrides: Overrides,
) -> list[ExperimentSettings]:  # fmt: skip
    """Each method on the samples of its plot."""
    _check_shown(methods, mapped=mapped, drawn=drawn)
    return report_cases([trajectory], noise, methods, sensor, seed, duration_s, overrides, tower)


def finding_bars(
    seeds: Some[StudySeed], views: Count, slow_views: Count, methods: Some[str], slow: list[str],
    options: dict[str, dict[str, Any]], noise_m: Some[NotNegative], clutter: Some[Annotated[float, Field(ge=0, lt=1)]],
    kept: Some[Share], condition_views: Count, map_dx_m: Some[Positive],
    map_min_votes: Some[Annotated[int, Field(ge=2)]], cloud_seeds: dict[str, Some[StudySeed]], cloud_s: Duration,
) -> dict[tuple[str, int], ExperimentSettings]:  # fmt: skip
    """The flights of the clouds of whole towers, by tower and seed."""
    from steelnb.hough.alternatives import FINDERS, OPTIONS

    for name, some in {"methods": methods, "slow": slow, "options": options}.items():
        for method in some:
            checked_choice(method, name, FINDERS)
    for method in options:
        for option in options[method]:
            checked_choice(option, f"options.{method}", OPTIONS.get(method, ()))
    return {(tower, seed): cloud_case(tower, seed, cloud_s) for tower, some in cloud_seeds.items() for seed in some}


def structure(
    trajectory: Ours, noise: str, sensor: NameOrPath, method: str, tower: Some[str], seeds: Some[SeedOrReport],
    duration_s: Duration, overrides: Overrides,
) -> dict[tuple[str, rng.Seed], ExperimentSettings]:  # fmt: skip
    """The flights, by tower and seed."""
    return {
        (name, seed): ExperimentSettings.preset(
            trajectory, noise, method, sensor, seed, duration_s, overrides, name
        )
        for name in tower for seed in seeds
    }  # fmt: skip


def accuracy(study_folder: str, method: Some[str], noise: Some[str]) -> None:
    """It flies nothing."""


def honest_sensors(
    trajectory: Ours, seed: SeedOrReport, duration_s: Duration, study_folder: str, mount_rows: str, mount_belief: str
) -> dict[str, ExperimentSettings]:
    """One flight with each fault of a sensor, by the name of the fault, and one without any."""
    exact = {"tof.sigma_floor_m": 0.0, "tof.sigma_relative": 0.0}
    alone = {"footprint: mixed pixels": "footprint", "exposure during motion": "exposure", "multipath": "multipath"}
    alone |= {"wiggling": "wiggle", "offset and scale of a camera": "calibration"}
    flown: dict[str, tuple[str, dict[str, Any]]] = {"range noise of the data sheet": ("starling2", {})}
    flown["noise by amplitude, dropout"] = ("starling2-honest", {"tof.faults": ["amplitude"]})
    flown |= {name: ("starling2-honest", {"tof.faults": [fault], **exact}) for name, fault in alone.items()}
    flown |= {"all together": ("starling2-honest", {}), "exact": ("starling2", exact)}
    given: dict[str, Any] = {"trajectory": trajectory, "noise": "none", "seed": seed, "duration_s": duration_s}
    return {
        name: ExperimentSettings.preset(sensor=sensor, overrides={"flight.still_s": 0.0, **changes}, **given)
        for name, (sensor, changes) in flown.items()
    }


def literature(
    methods: Some[str], trajectory: Ours, seed: SeedOrReport, duration_s: Duration, study_folder: str
) -> ExperimentSettings:
    """The flight whose features are shown."""
    for each in methods:
        checked_choice(each, "methods", METHODS)
    return ExperimentSettings.preset(trajectory, "random-walk", "orb", "starling2", seed, duration_s)


def planner(
    sensor: NameOrPath, noise: str, method: str, flights: Some[str], seed: SeedOrReport, duration_s: Duration,
    overrides: Overrides,
) -> dict[str, ExperimentSettings]:  # fmt: skip
    """Some of `PLANNER_FLIGHTS`, by name."""
    cases = {}
    for name in flights:
        trajectory, changes = PLANNER_FLIGHTS[checked_choice(name, "flights", PLANNER_FLIGHTS)]
        own = joined(changes, overrides, name)
        cases[name] = ExperimentSettings.preset(trajectory, noise, method, sensor, seed, duration_s, own)
    return cases


def claims(study_folder: str, frames_folder: str, starts_folder: str, claims_file: str) -> None:
    """It flies nothing."""


def your_own_recording(
    recording: str, method: str, range_max_m: Positive | None, trajectory: TrajectoryName, noise: str,
    sensor: NameOrPath, seed: SeedOrReport, duration_s: Duration,
) -> ExperimentSettings:  # fmt: skip
    """The flight that is simulated without a recording."""
    odometry = OdometrySettings.preset(method, sensor)
    odometry.preprocess.check_range(range_max_m)
    if isinstance(odometry, OrbSettings):
        raise InputError(f"method = {method!r}: expected one that needs no images, since recordings have none")
    if recording and not Path(recording).exists():
        raise InputError(f"recording = {recording!r}: no such file or folder below {Path.cwd()}")
    return ExperimentSettings.preset(trajectory, noise, sensor=sensor, seed=seed, duration_s=duration_s)


def _check_shown(methods: Mapping[str, Sequence[str]], **chosen: Sequence[str]) -> None:
    """Raise `InputError` for a method that flies twice, and for one that is to be shown and does not fly."""
    flown = [name for some in methods.values() for name in some]
    if twice := [name for name in flown if flown.count(name) > 1]:
        raise InputError(f"methods = {dict(methods)}: {twice[0]!r} twice; expected each once")
    for parameter, names in chosen.items():
        for name in names:
            checked_choice(name, parameter, flown)


NOTEBOOKS: dict[str, Callable[..., Any]] = {
    "00_explore": explore, "01_world_and_noise": world_and_noise, "02_segment_odometry": segment_odometry,
    "03_icp_odometry": icp_odometry, "04_false_convergence": false_convergence, "05_yaw_drift": yaw_drift,
    "06_finding_bars": finding_bars, "07_structure": structure, "08_accuracy": accuracy,
    "09_honest_sensors": honest_sensors, "10_literature": literature, "11_planner": planner, "12_claims": claims,
    "13_your_own_recording": your_own_recording,
}  # fmt: skip
"""Notebook → the function that makes its runs."""


class Run(NamedTuple):
    """The settings of one run of a study, and the name of its variant."""

    settings: ExperimentSettings
    variant: str = ""

    @property
    def case(self) -> dict[str, Any]:
        """Values of the columns `RUN_COLUMNS`."""
        values = {**case_of(self.settings), "duration_s": self.settings.flight.duration_s, "variant": self.variant}
        return {name: values[name] for name in RUN_COLUMNS}

    @property
    def key(self) -> str:
        """Identifies the run: a hash of its variant and its settings."""
        return hashlib.sha256(f"{self.variant} {self.settings.model_dump_json()}".encode()).hexdigest()[:32]


class Grid(Settings):
    """Values to combine; one table of a study's file.

    ``seeds``: a list, or a range such as ``"101-130"``, which includes both ends; a list may hold ranges. ``variants``:
    name of the variant in tables → changed settings. ``calibrated``: the scale and offset of each seed's camera are
    measured before its flight, and its ranges corrected (`measure_calibration`). A single value is a list of one, and
    repeated values count once.
    """

    seeds: Annotated[list[SeedOrReport], Field(min_length=1)]
    trajectories: Annotated[list[TrajectoryName], Field(min_length=1)]
    noises: Annotated[list[str], Field(min_length=1)]
    sensors: Annotated[list[NameOrPath], Field(min_length=1)]
    methods: Annotated[list[str], Field(min_length=1)]
    duration_s: Duration = 200.0
    variants: Annotated[dict[str, dict[str, Any]], Field(min_length=1)] = {"": {}}  # noqa: RUF012
    calibrated: bool = False

    @field_validator("seeds", mode="before")
    @classmethod
    def _ranges(cls, value: Any) -> Any:
        many = isinstance(value, list | tuple | set | range)
        return [seed for each in (value if many else [value]) for seed in seeds_of(each)]

    @field_validator("trajectories", "noises", "sensors", "methods", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value

    @field_validator("seeds", "trajectories", "noises", "sensors", "methods")
    @classmethod
    def _once(cls, value: list[Any]) -> list[Any]:
        return list(dict.fromkeys(value))

    def runs(self) -> list[Run]:
        """One run per combination. Raises `InputError`."""
        axes = self.sensors, self.trajectories, self.seeds, self.noises, self.variants.items(), self.methods
        runs = []
        for sensor, trajectory, seed, noise, (variant, changes), method in itertools.product(*axes):
            settings = ExperimentSettings.preset(trajectory, noise, method, sensor, seed, self.duration_s, changes)
            if self.calibrated:
                from steelnb.simulation.tof import measure_calibration

                settings = settings.override(measure_calibration(settings.tof, seed))
            runs.append(Run(settings, variant))
        return runs


def grid(**axes: Any) -> list[Run]:
    """One run per combination of the values of a `Grid`. Raises `InputError`."""
    return Grid(**axes).runs()


def read_grids(path: Path | str) -> list[Run]:
    """The runs of a study's TOML file, whose tables are `Grid`s, without duplicates. Raises `InputError`."""
    grids = read_tables(Path(path), Grid, "the settings of a study")
    if not grids:
        raise InputError(f"{path}: no table; expected at least one, such as [report]")
    runs: list[Run] = []
    for name, each in grids.items():
        try:
            runs += each.runs()
        except InputError as fault:
            raise InputError(f"{path}: [{name}]: {fault}") from None
    return distinct(runs)


def distinct(runs: Iterable[Run]) -> list[Run]:
    """The runs, equal ones once."""
    return list({run.key: run for run in runs}.values())
