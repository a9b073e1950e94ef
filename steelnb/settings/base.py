"""Frozen settings: unknown keys, wrong types and values out of range are errors."""

import ast
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from steelnb.core import rng
from steelnb.core.checks import checked_kind, guess, shown
from steelnb.core.errors import InputError
from steelnb.settings.presets import read_toml


def _usable(value: float) -> float:
    """Refuse numbers whose squares, or the inverses of these, are infinite."""
    if value and not 1e-30 < abs(value) < 1e30:
        raise ValueError("expected a size between 1e-30 and 1e30")
    return value


Finite = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_usable)]
Positive = Annotated[Finite, Field(gt=0)]
NotNegative = Annotated[Finite, Field(ge=0)]
VoxelEdge = Annotated[Finite, Field(ge=1e-4)]
"""Edge of voxels, metres. With smaller ones a flight of 100 m has more voxels a side than an index counts."""
DURATION_MAX_S = 14_400.0
"""Four hours. A flight is limited because its poses and IMU samples are held in memory."""
Duration = Annotated[Finite, Field(gt=0, le=DURATION_MAX_S)]
Probability = Annotated[float, Field(ge=0, le=1)]


def _checked_seed(value: Any) -> rng.Seed:
    """Accept a seed of at most 63 bits, as in the tables of studies. Pydantic's own message has several lines."""
    if value == "report" or (type(value) is int and 0 <= value < 2**63):
        return value  # type: ignore[no-any-return]
    raise ValueError("expected a whole number from 0 to 2**63 - 1, or 'report'")


SeedOrReport = Annotated[rng.Seed, BeforeValidator(_checked_seed)]


def seeds_of(value: Any) -> list[Any]:
    """The seeds of a range such as ``"101-130"``, or the value itself as the only one."""
    if not isinstance(value, str) or value == "report":
        return [value]
    found = re.fullmatch(r"(\d+)-(\d+)", value.replace(" ", ""))
    if not found or not 0 <= int(found[2]) - int(found[1]) < 100_000:
        raise ValueError("expected a list, or a range such as '101-130' of at most 100,000 seeds")
    return list(range(int(found[1]), int(found[2]) + 1))


class Settings(BaseModel):
    """Base of all settings: frozen, strict, without unknown keys. Bad values raise a one-line `InputError`."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)
    of_preset: ClassVar[tuple[str, ...]] = ()
    """Settings that `override` does not change, since a preset derives others from them."""
    lists_as: ClassVar[type] = list
    """What lists, as in JSON and TOML, and arrays become: tuples where the settings are tuples."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**as_plain(values, self.lists_as))
        except ValidationError as fault:
            raise InputError(describe_fault(type(self), fault)) from None

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(f"{type(self).__name__}.{name}: settings do not change; replace({name}=...) returns a copy")

    def __delattr__(self, name: str) -> None:
        raise InputError(f"{type(self).__name__}.{name}: settings cannot be deleted")

    def replace(self, **changes: Any) -> Self:
        """A copy with some values changed and all values validated."""
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})

    def override(self, overrides: dict[str, Any]) -> Self:
        """A copy with single settings changed together, each named ``setting`` or ``table.setting``. A whole table,
        such as ``imu``, may be given as a dict, or as None if it is optional. Raises `InputError`."""
        checked_kind(overrides, "overrides", dict)
        changes: dict[str, Any] = {}
        inner: dict[str, dict[str, Any]] = {}
        for path, value in overrides.items():
            checked_kind(path, "a name in overrides", str)
            name, _, rest = path.partition(".")
            known = name in type(self).model_fields
            old = getattr(self, name) if known else None
            if path in self.of_preset and not (isinstance(value, str) and value == old):
                raise InputError(f"{path} = {shown(value)}: this is {old!r}; choose it by its preset")
            if rest and isinstance(old, Settings):
                inner.setdefault(name, {})[rest] = value
            elif rest and known and old is None and name not in overrides and _may_be_table(type(self), name):
                raise InputError(f"{path} = {shown(value)}: {name} is None; expected all of it, as {name} = {{...}}")
            else:
                changes[path] = value
        changed = self.replace(**changes) if changes.keys() & inner.keys() else self
        tables = {name: getattr(changed, name).override(some) for name, some in inner.items()}
        return changed.replace(**{**changes, **tables})


S = TypeVar("S", bound=Settings)


def read_tables(path: Path, kind: type[S], expected: str) -> dict[str, S]:
    """The tables of a TOML file by name, each as settings of one ``kind``. Raises `InputError`."""
    found = {}
    for name, table in read_toml(path, expected).items():
        if not isinstance(table, dict):
            raise InputError(f"{path}: [{name}]: {shown(table)}: expected a table")
        try:
            found[name] = kind(**table)
        except InputError as fault:
            raise InputError(f"{path}: [{name}]: {fault}") from None
    return found


class FrozenDict(dict[Any, Any]):
    """A table within frozen settings: it does not change, and it can be hashed."""

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise InputError("settings do not change; override({...}) returns a copy")

    __setitem__ = __delitem__ = __ior__ = update = pop = popitem = clear = setdefault = _refuse  # type: ignore[assignment]

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[Any, ...]:  # by default, items are set one by one
        return FrozenDict, (dict(self),)


OrNone = BeforeValidator(lambda value: None if value is False else value)
"""Validator of an optional field: false stands for None, which TOML does not have."""


def describe_fault(kind: type[Settings], fault: ValidationError) -> str:
    """The first fault of a pydantic error as one line: the setting, its value, and what was expected."""
    faults = fault.errors()
    # A misspelt name is the reason why another one is missing.
    first = next((each for each in faults if each["type"] == "extra_forbidden"), faults[0])
    message = first["msg"].removeprefix("Value error, ")
    message = f"{message[:1].lower()}{message[1:]}"
    if not first["loc"]:
        return f"{kind.__name__}: {message}"
    loc = tuple(part for part in first["loc"] if not _is_annotation(part)) or first["loc"]
    if first["type"] == "missing" and isinstance(loc[-1], int):  # of the values of a tuple
        count = loc[-1] + sum(each["loc"][:-1] == loc[:-1] for each in faults)
        loc, message = loc[:-1], f"expected {count} values"
    elif isinstance(first["input"], float) and math.isnan(first["input"]):
        message = "input should be a finite number"
    elif first["type"] in ("model_type", "dict_type"):
        message = "expected a table"
    name = ".".join(str(part) for part in loc)
    if first["type"] == "extra_forbidden":
        known, family = setting_names(kind), getattr(kind, "family", None)
        has = f"the family {family!r} has" if family else "expected one of"
        message = f"unknown setting{guess(name, known)}; {has} {', '.join(known)}"
    return f"{kind.__name__}: {name} = {shown(first['input'], size=200)}: {message}"


def _is_annotation(part: str | int) -> bool:
    """Whether a part of an error's place is the kind that pydantic tried, not the name of a setting or its key."""
    return isinstance(part, str) and "[" in part and part != "[key]"


def as_plain(value: Any, lists_as: type = tuple) -> Any:
    """Convert numbers, texts and arrays of NumPy and pandas, also within tables, lists and tuples, to Python's. Lists
    and arrays become ``lists_as``."""
    if isinstance(value, dict):
        return {name: as_plain(item, lists_as) for name, item in value.items()}
    value = value.to_numpy() if hasattr(value, "to_numpy") else value  # of pandas
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(value, list | tuple):
        kind = tuple if isinstance(value, tuple) else lists_as
        return kind(as_plain(item, lists_as) for item in value)
    return value


def _may_be_table(kind: type[Settings], name: str) -> bool:
    """Whether an optional setting is a table of settings."""
    kinds = get_args(kind.model_fields[name].annotation)
    return any(isinstance(each, type) and issubclass(each, Settings) for each in kinds)


def setting_names(kind: type[Settings]) -> list[str]:
    """The names of all single settings; those of a table are prefixed by the table's name."""
    names = []
    for name, field in kind.model_fields.items():
        inner: Any = field.annotation
        is_table = isinstance(inner, type) and issubclass(inner, Settings)
        names += [f"{name}.{each}" for each in setting_names(inner)] if is_table else [name]
    return names


def parse_parameter(text: str) -> tuple[str, Any]:
    """Parse ``NAME=VALUE``: the value is a Python literal, else a TOML value, else text. Raises `InputError`."""
    name, equals, value = (piece.strip() for piece in text.partition("="))
    if not name or not equals:
        raise InputError(f"-p {text}: expected NAME=VALUE, such as trajectory=loops or tof.rate_hz=10")
    for read in (ast.literal_eval, lambda text: tomllib.loads(f"value = {text}")["value"]):
        try:
            parsed = read(value)
            json.dumps(parsed)  # raises for values that a notebook's parameter cannot have: sets, bytes, dates
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
            continue
        return name, parsed
    return name, value
