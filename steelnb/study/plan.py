"""Runs of a study: the combinations of values that its file lists, each with the key of all it depends on."""

import functools
import importlib.metadata
import itertools
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from steelnb.errors import InputError
from steelnb.keys import code_digest, digest
from steelnb.settings import ExperimentSettings, Settings, TrajectoryName, read_tables
from steelnb.settings.base import Duration, Seed

RUNS_MAX = 100_000
"""Largest study: its plan and table fit into 2 GB."""
CODE = ("steelnb.study.row", "steelnb.pins")
"""Modules that a run executes; those that they import count too, and reports on runs do not."""
LIBRARIES = ("evo", "numba", "numpy", "open3d", "open3d-cpu", "pybullet", "scipy")
"""Libraries whose version can change a run's numbers."""
CASE = ("sensor", "duration_s", "blind", "trajectory", "seed", "noise", "variant", "method")
"""Columns that name a run, in the order by which tables are sorted."""


class Block(Settings):
    """One table of a study's file: a run for each combination of the values on its axes.

    ``seeds`` may be a range such as ``"101-130"``, both ends included. ``blind_s`` are intervals (from, to) in seconds
    without any return, in all flights of the block; each of ``overrides`` changes single settings.
    """

    seeds: Annotated[list[Seed], Field(min_length=1)]
    trajectories: Annotated[list[TrajectoryName], Field(min_length=1)]
    noises: Annotated[list[str], Field(min_length=1)]
    sensors: Annotated[list[str], Field(min_length=1)]
    methods: Annotated[list[str], Field(min_length=1)]
    duration_s: Duration = 200.0
    blind_s: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(default_factory=list)
    overrides: Annotated[list[dict[str, Any]], Field(min_length=1)] = [{}]  # noqa: RUF012

    @field_validator("seeds", mode="before")
    @classmethod
    def _range(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        found = re.fullmatch(r"(\d+)-(\d+)", value.replace(" ", ""))
        if not found or int(found[1]) > int(found[2]):
            raise ValueError("expected a list of whole numbers or a range such as '101-130'")
        seeds = range(int(found[1]), int(found[2]) + 1)
        if len(seeds[: RUNS_MAX + 1]) > RUNS_MAX:
            raise ValueError(f"expected at most {RUNS_MAX:,} seeds")
        return list(seeds)

    @property
    def axes(self) -> tuple[list[Any], ...]:
        """Values to combine: sensors, trajectories, seeds, noises, overrides and methods."""
        return self.sensors, self.trajectories, self.seeds, self.noises, self.overrides, self.methods

    def settings(self) -> Iterator[tuple[ExperimentSettings, str]]:
        """Settings of each run and, as text, its overrides. Raises `InputError`."""
        for sensor, trajectory, seed, noise, changes, method in itertools.product(*self.axes):
            given = {**changes, **({"tof.blind_s": self.blind_s} if self.blind_s else {})}
            settings = ExperimentSettings.preset(
                trajectory, noise, sensor=sensor, seed=seed, duration_s=self.duration_s, overrides=given,
                method=method,
            )  # fmt: skip
            yield settings, ", ".join(f"{name}={value}" for name, value in sorted(changes.items()))


@dataclass(frozen=True)
class Run:
    """Settings of one run, its overrides as text, and the digests of all that it and its flight depend on.

    ``key`` covers settings, code and versions of libraries; ``flight``, equal for all runs on one flight, covers the
    settings of tower, flight, sensor and seed, code and versions.
    """

    settings: ExperimentSettings
    variant: str
    key: str
    flight: str

    @property
    def case(self) -> dict[str, Any]:
        """Values of the columns `CASE`."""
        s = self.settings
        return {
            "sensor": s.sensor,
            "duration_s": s.flight.duration_s,
            "blind": ", ".join(f"{first:g}-{last:g} s" for first, last in s.tof.blind_s),
            "trajectory": s.flight.trajectory,
            "seed": s.seed,
            "noise": s.noise_name,
            "variant": self.variant,
            "method": s.odometry.method,
        }

    @property
    def label(self) -> str:
        """Name of the run in a line."""
        return " ".join(str(value) for value in self.case.values() if value != "")


def read_plan(path: Path) -> list[Run]:
    """Runs of a study's TOML file, each once; those of one flight follow each other.

    Raises `InputError`, for unknown axes or values and for more than `RUNS_MAX` runs, too.
    """
    blocks = read_tables(path, Block, "the settings of a study")
    if not blocks:
        raise InputError(f"{path}: no table; expected at least one, such as [report]")
    count = sum(math.prod(map(len, block.axes)) for block in blocks.values())
    if count > RUNS_MAX:
        raise InputError(f"{path}: {count:,} runs; expected at most {RUNS_MAX:,} in a study")
    runs: dict[str, Run] = {}
    for name, block in blocks.items():
        try:
            made = [make_run(settings, variant) for settings, variant in block.settings()]
        except InputError as fault:
            raise InputError(f"{path}: [{name}]: {fault}") from None
        runs.update((run.key, run) for run in made)
    return [run for flight in by_flight(runs.values()) for run in flight]


def make_run(settings: ExperimentSettings, variant: str = "", depends_on: str = "") -> Run:
    """Run with its keys; ``depends_on`` stands for code and libraries, by default `software_digest`."""
    values, depends_on = settings.model_dump(mode="json"), depends_on or software_digest()
    shared = {name: values[name] for name in ("tower", "flight", "tof", "seed")}
    if settings.flight.trajectory == "planned":  # steers by what noise and odometry make of the flight
        shared = values
    return Run(settings, variant, digest(values, variant, depends_on)[:32], digest(shared, depends_on)[:32])


@functools.cache
def software_digest() -> str:
    """Digest of the code of the modules that a run executes and of the installed versions of `LIBRARIES`."""
    installed = {each.name: each.version for each in importlib.metadata.distributions() if each.name in LIBRARIES}
    return digest(code_digest(CODE), installed)


def by_flight(runs: Iterable[Run]) -> list[list[Run]]:
    """Runs in groups that share a flight, in order of their first."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.flight, []).append(run)
    return list(groups.values())
