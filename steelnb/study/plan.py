"""Which runs a study is made of: its settings, every combination of their axes, and the key of each run."""

import ast
import functools
import hashlib
import io
import itertools
import json
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import Field, field_validator

import steelnb
from steelnb.config import METHODS, ExperimentSettings, MethodName, Positive, SensorName, Settings, TrajectoryName
from steelnb.errors import SettingsError
from steelnb.toml_file import read_toml

ROOTS = ("steelnb.experiment", "steelnb.study.row")
"""What a run executes. Whatever these import, directly or not, is part of its key; reports on runs are not."""
APART = ("steelnb.errors",)
"""Behind every run, and without a say in what one that goes well comes to."""
CASE = ("sensor", "duration_s", "blind", "trajectory", "seed", "noise", "variant", "method")
"""What names a run in tables, in the order in which tables are sorted: runs of one flight stand together."""


class Block(Settings):
    """One table of the study's file: a run for each combination of the values on its axes.

    ``seeds`` may be a range such as ``"101-130"``, both ends included. ``blind_s`` are intervals (from, to) in which
    nothing returns, in all flights of the block; each of ``overrides`` changes single settings, as elsewhere.
    """

    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    trajectories: Annotated[list[TrajectoryName], Field(min_length=1)]
    noises: Annotated[list[str], Field(min_length=1)]
    sensors: Annotated[list[SensorName], Field(min_length=1)]
    methods: Annotated[list[str], Field(min_length=1)]
    duration_s: Positive = 200.0
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
        return list(range(int(found[1]), int(found[2]) + 1))

    @field_validator("methods")
    @classmethod
    def _known(cls, value: list[str]) -> list[str]:
        unknown = [name for name in value if name not in METHODS]
        if unknown:
            raise ValueError(f"unknown method {unknown[0]!r}; expected one of {', '.join(map(repr, METHODS))}")
        return value

    def settings(self) -> Iterable[tuple[ExperimentSettings, str]]:
        """The settings of each run and, as text, what overrides them. Raises `SettingsError`."""
        axes = (self.sensors, self.trajectories, self.seeds, self.noises, self.overrides, self.methods)
        for sensor, trajectory, seed, noise, changes, method in itertools.product(*axes):
            given = {**changes, **({"tof.blind_s": self.blind_s} if self.blind_s else {})}
            settings = ExperimentSettings.preset(
                trajectory, noise, sensor=sensor, seed=seed, duration_s=self.duration_s, overrides=given,
                method=cast(MethodName, method),
            )  # fmt: skip
            yield settings, ", ".join(f"{name}={value}" for name, value in sorted(changes.items()))


@dataclass(frozen=True)
class Run:
    """One run. ``variant`` says which settings differ from the presets, as text; ``key`` is the hash of all the run
    depends on, ``flight`` that of what its flight and scans depend on, which runs share."""

    settings: ExperimentSettings
    variant: str
    key: str
    flight: str

    @property
    def case(self) -> dict[str, Any]:
        """The values of `CASE`."""
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
        """The run in a line."""
        return " ".join(str(value) for value in self.case.values() if value != "")


def read_blocks(path: Path) -> dict[str, Block]:
    """The blocks of a study's file, by name. Raises `FileMissingError` or `SettingsError`."""
    tables = read_toml(path, "the settings of a study")
    blocks = {}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise SettingsError(f"{path}: {name} = {table!r}: expected a table of axes, [{name}]")
        unknown = [key for key in table if key not in Block.model_fields]
        if unknown:
            known = ", ".join(Block.model_fields)
            raise SettingsError(f"{path}: [{name}]: unknown axis {unknown[0]!r}; expected one of {known}")
        try:
            blocks[name] = Block(**table)
        except SettingsError as fault:
            raise SettingsError(f"{path}: [{name}]: {fault}") from None
    if not blocks:
        raise SettingsError(f"{path}: no table; expected at least one, such as [report]")
    return blocks


def make_runs(blocks: dict[str, Block], lock: str | None) -> list[Run]:
    """The runs of all blocks, each once, in order; those of one flight follow each other.

    ``lock`` is the digest of the environment, `environment_digest`. Raises `SettingsError`.
    """
    code, runs = code_digest(), {}
    for name, block in blocks.items():
        try:
            for settings, variant in block.settings():
                run = make_run(settings, variant, code, lock)
                runs[run.key] = run
        except SettingsError as fault:
            raise SettingsError(f"[{name}]: {fault}") from None
    cases = {tuple(run.case.values()): run for run in runs.values()}
    if len(cases) < len(runs):
        twice = next(run for run in runs.values() if cases[tuple(run.case.values())] is not run)
        raise SettingsError(f"{twice.label}: two runs with other settings have the same name; name the overrides alike")
    return [run for flight in by_flight(runs.values()) for run in flight]


def make_run(settings: ExperimentSettings, variant: str, code: str, lock: str | None) -> Run:
    """A run with its keys, from the digests of code and environment."""
    values = settings.model_dump(mode="json")
    shared = {name: values[name] for name in ("tower", "flight", "tof", "seed")}
    return Run(settings, variant, digest([values, variant, code, lock]), digest([shared, code, lock]))


def by_flight(runs: Iterable[Run]) -> list[list[Run]]:
    """The runs in groups that share a flight, in order of their first."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.flight, []).append(run)
    return list(groups.values())


def digest(values: Any) -> str:
    """The first 32 hexadecimal digits of the SHA-256 of some values as JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:32]


@functools.cache
def code_digest() -> str:
    """SHA-256 of the modules behind a run: the same wherever the same code is installed."""
    return digest_modules(Path(steelnb.__file__).parent.parent, ROOTS)


def digest_modules(folder: Path, roots: Sequence[str]) -> str:
    """SHA-256 of the names and statements of `modules_behind`; comments, docstrings and line endings do not count."""
    whole = hashlib.sha256()
    for name, path in sorted(modules_behind(folder, roots).items()):
        source = statements(path.read_text(encoding="utf-8")).encode()
        whole.update(f"{name} {len(source)}\n".encode() + source)
    return whole.hexdigest()


def statements(source: str) -> str:
    """A module's source without comments, docstrings and empty lines."""
    lines = [line.encode() for line in source.splitlines()]  # ast counts columns in bytes
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][: len(token.line[:column].encode())]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and node.end_lineno:
            for row in range(node.lineno, node.end_lineno + 1):
                lines[row - 1] = b""
    return "\n".join(line.decode().rstrip() for line in lines if line.strip())


def environment_digest(lock: Path) -> str | None:
    """SHA-256 of the versions that a lock gives the libraries that the modules behind a run import; None without one.

    What only other parts of the package need may be added and updated without running a study again.
    """
    if not lock.is_file():
        return None
    from importlib.metadata import packages_distributions

    installed = packages_distributions()
    paths = modules_behind(Path(steelnb.__file__).parent.parent, ROOTS).values()
    imported = {name.partition(".")[0] for path in paths for name, _ in _imports(path)} - sys.stdlib_module_names
    wanted = {_plain(each) for name in imported for each in installed.get(name, [name])}
    versions = re.findall(r"^([\w.-]+)==([^\s;]+)", lock.read_text(encoding="utf-8"), re.MULTILINE)
    return digest(sorted([_plain(name), version] for name, version in versions if _plain(name) in wanted))


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def modules_behind(folder: Path, roots: Sequence[str]) -> dict[str, Path]:
    """The modules below ``folder`` that some modules import, directly or not, and they themselves: name → file.

    Found in the sources' import statements, without running them. A package counts where a statement names it, not
    where only a module within is named: what stands in its front page cannot change that module's results.
    """
    packages = {name.partition(".")[0] for name in roots}
    found: dict[str, Path] = {}
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        place = folder.joinpath(*name.split("."))
        path = next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)
        if name in found or path is None or name.partition(".")[0] not in packages or name in APART:
            continue
        found[name] = path
        for module, names in _imports(path):
            inside = [f"{module}.{each}" for each in names]
            modules = [each for each in inside if _is_module(folder, each)]
            waiting += modules if inside and len(modules) == len(inside) else [module, *modules]
    return found


def _imports(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The modules that a source's statements import, and the names they take from them."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, [alias.name for alias in node.names]


def _is_module(folder: Path, name: str) -> bool:
    place = folder.joinpath(*name.split("."))
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()
