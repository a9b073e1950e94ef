"""Checks of a notebook's parameters against each other: what cannot be flown or drawn is refused before any flight.

Every check is bound to the name of a parameter and sees the values of all. Libraries that take a second to import are
imported by the checks that need them, so that a refusal takes no longer than the start of a kernel.
"""

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from steelnb.core.checks import guess, quoted
from steelnb.core.errors import InputError
from steelnb.notebook.cases import (
    PLANNER_FLIGHTS,
    basin_cases,
    cloud_case,
    planner_cases,
    report_cases,
    slip_cases,
    with_earlier_runs,
    world_cases,
)
from steelnb.notebook.sources import READ_NAMES, check_source
from steelnb.settings import METHODS, TOWERS, ExperimentSettings, OrbSettings
from steelnb.settings.experiment import ARGUMENTS, check_given_once
from steelnb.settings.world import Noise, at_level

WORLD = "seed", "duration_s", "overrides", "tower"
BASIN = "trajectory", "noise", "sensor", "correspondence_m", *WORLD
"""The parameters that `world_cases` and `basin_cases` have arguments for."""
PRESET_ARGUMENTS = "trajectory", "noise", "method", "sensor", "seed", "duration_s", "overrides", "tower"
DRIFT_MIN_S = 60.0
"""Step of notebook 01's table of drifts."""
SIDE_MAX = 100
"""Largest number of steps from the middle of a basin to its edge: 40,000 starts, of half a millisecond."""
Values = Mapping[str, Any]


def check_names(parameter: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise `InputError` for the first of the names in a parameter that is not ``known``."""
    for name in names:
        if name not in known:
            expected = f"one of {quoted(known)}" if known else "none"
            raise InputError(f"{parameter} = {name!r}{guess(name, known)}: expected {expected}")


def check_combinations(values: Values) -> None:
    """Raise `InputError` for the first parameter that the others contradict, or that names nothing."""
    for name in values:
        if name in CHECKS:
            CHECKS[name](values)
    for given in _combinations(values):  # titles and names of files say the parameters
        check_given_once(given.get("overrides", {}), {name: given[name] for name in ARGUMENTS if name in given})
    _experiments(values)


def _all(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _combinations(values: Values) -> Iterator[dict[str, Any]]:
    """The arguments of `ExperimentSettings.preset` for every combination of the values in lists."""
    named = {name: _all(values[name]) for name in PRESET_ARGUMENTS if name in values}
    if isinstance(values.get("seeds"), list):
        named["seed"] = values["seeds"]
    for combination in itertools.product(*named.values()) if named else ():
        given = dict(zip(named, combination, strict=True))
        if "level" in values:
            given["noise"] = at_level(given["noise"], values["level"])
        yield given


def _given(values: Values, *names: str) -> dict[str, Any]:
    """The parameters of these names that a notebook has."""
    return {name: values[name] for name in names if name in values}


def _experiments(values: Values) -> None:
    """Make the settings of all experiments of the notebook that has these parameters."""
    if "drift_s" in values:
        world_cases(**_given(values, *WORLD))
    elif "correspondence_m" in values:
        basin_cases(**_given(values, *BASIN))
        slip_cases(**_given(values, *BASIN, "blind_s"))
    elif "cloud_s" in values:
        _check_clouds(values)
    elif "flights" in values:
        planner_cases(**_given(values, "flights", "noise", "method", "sensor", "seed", "duration_s", "overrides"))
    elif methods := _flown(values):
        given = _given(values, "noise", "sensor", *WORLD)
        for case in with_earlier_runs(report_cases(_all(values["trajectory"]), methods=methods, **given)):
            if "draws" in values:
                case.check_draws()
    else:
        for each in _combinations(values):
            ExperimentSettings.preset(**each)


def _check_level(values: Values) -> None:
    if values["seed"] == "report":
        raise InputError("seed = 'report': expected a number, since a slider moves it")


def _flown(values: Values) -> dict[str, list[str]]:
    """The methods that fly on the samples of each of the report's plots; empty if none do."""
    if "correction" in values:
        return {"average": ["none", *values["correction"]]}
    methods = values.get("methods")
    return methods if isinstance(methods, dict) else {}


def _check_trajectory(values: Values) -> None:
    if "study_folder" in values or "seeds" in values:  # 07 has goals for these two, 09 and 10 the runs of a study
        check_names("trajectory", [values["trajectory"]], ["loops", "zigzag"])


def _check_correction(values: Values) -> None:
    check_names("correction", values["correction"], [name for name in METHODS if name != "none"])


def _check_methods(values: Values) -> None:
    methods = values["methods"]
    if isinstance(methods, dict):
        check_once("methods", [name for names in methods.values() for name in names])
    elif "slow" in values:
        _check_finders(values)
    else:
        check_names("methods", methods, METHODS)


def _check_finders(values: Values) -> None:
    from steelnb.hough.alternatives.methods import FINDERS, LISTS, OPTIONS

    check_names("methods", values["methods"], FINDERS)
    check_names("slow", values["slow"], FINDERS)
    check_names("options", values["options"], FINDERS)
    for method, options in values["options"].items():
        if not isinstance(options, dict):
            raise InputError(f"options.{method} = {options!r}: expected a table of options")
        check_names(f"options.{method}", options, OPTIONS.get(method, ()))
        for name, value in options.items():
            many = name in LISTS
            if isinstance(value, list | tuple) != many or not value or not all(_is_count(each) for each in _all(value)):
                kind = "a list of whole numbers above 0" if many else "a whole number above 0"
                raise InputError(f"options.{method}.{name} = {value!r}: expected {kind}")


def _is_count(value: Any) -> bool:
    return all(map(_is_count, value)) if isinstance(value, tuple) else type(value) is int and value > 0


def _check_shown(name: str) -> Callable[[Values], None]:
    """The check of a parameter that names some of the methods flown."""
    return lambda values: check_names(name, values[name], [each for some in _flown(values).values() for each in some])


def _check_blind(values: Values) -> None:
    for gap in values["blind_s"]:
        if len(gap) != 2 or not 0 <= gap[0] < gap[1]:
            raise InputError(f"blind_s: {gap}: expected the first and last second of a gap, such as [60.0, 75.0]")
        if gap[1] >= values["duration_s"]:
            flown = f"blind_s: {gap} with duration_s = {values['duration_s']:g}"
            raise InputError(f"{flown}: expected a gap that ends before the flight does")


def _check_step(values: Values) -> None:
    reach_m, step_m = values["reach_m"], values["step_m"]
    if not reach_m / SIDE_MAX <= step_m <= reach_m:
        raise InputError(
            f"step_m = {step_m:g} with reach_m = {reach_m:g}: expected from {reach_m / SIDE_MAX:g} to {reach_m:g} m"
        )


def _check_cloud_seeds(values: Values) -> None:
    check_names("cloud_seeds", values["cloud_seeds"], TOWERS)
    clouds = {f"cloud_seeds.{tower}": seeds for tower, seeds in values["cloud_seeds"].items()}
    for name, seeds in {"seeds": values["seeds"], **clouds}.items():
        if "report" in seeds:
            raise InputError(f"{name} = {seeds}: expected numbers, since the report's seed has no single frames")


def _check_clouds(values: Values) -> None:
    for tower, seeds in values["cloud_seeds"].items():
        try:
            cloud_case(tower, seeds[0], values["cloud_s"])
        except InputError as fault:
            raise InputError(f"cloud_s = {values['cloud_s']:g}: {fault}") from None


def _check_poor_starts(values: Values) -> None:
    from steelnb.notebook.basin import MAP_EVERY

    case = next(iter(basin_cases(**_given(values, *BASIN)).values()))
    scans = (case.flight.duration_s - case.tof.start_s) * case.tof.rate_hz
    most = len(range(MAP_EVERY // 2, math.ceil(scans), MAP_EVERY))
    if values["poor_starts"] > most:
        flown = f"poor_starts = {values['poor_starts']} with duration_s = {values['duration_s']:g}"
        raise InputError(f"{flown}: expected at most {most}, as many as scans that are not in the map")


def _check_drift(values: Values) -> None:
    if values["drift_s"] < DRIFT_MIN_S:
        raise InputError(f"drift_s = {values['drift_s']:g}: expected at least {DRIFT_MIN_S:g}, the step of the table")
    for name in values["noise"]:
        if replace(Noise.parse(name), tilt_rad=0.0) == Noise():
            raise InputError(f"noise = {name!r}: expected a drift of the position or heading, such as 'random-walk'")


def _check_recording(values: Values) -> None:
    odometry = ExperimentSettings.preset(method=values["method"], sensor=values["sensor"]).odometry
    odometry.preprocess.check_range(values["range_max_m"])
    if isinstance(odometry, OrbSettings):
        raise InputError(
            f"method = {values['method']!r}: expected one that needs no images, since recordings have none"
        )
    if values["recording"] and not Path(values["recording"]).exists():
        raise InputError(f"recording = {values['recording']!r}: no such file or folder below {Path.cwd()}")


def check_once(name: str, value: list[Any]) -> None:
    """Raise `InputError` for an element that a list has twice."""
    for k, each in enumerate(value):
        if each in value[:k]:
            raise InputError(f"{name} = {value}: {each!r} twice; expected each once")


CHECKS: Mapping[str, Callable[[Values], None]] = {
    "level": _check_level,
    "trajectory": _check_trajectory,
    "correction": _check_correction,
    "methods": _check_methods,
    "drawn": _check_shown("drawn"),
    "mapped": _check_shown("mapped"),
    "blind_s": _check_blind,
    "step_m": _check_step,
    "poor_starts": _check_poor_starts,
    "drift_s": _check_drift,
    "flights": lambda values: check_names("flights", values["flights"], PLANNER_FLIGHTS),
    "cloud_seeds": _check_cloud_seeds,
    "recording": _check_recording,
    **{name: partial(check_source, name) for name in READ_NAMES},
}
"""Parameter → its check."""
