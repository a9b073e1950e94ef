"""Checks of the arguments of public functions, by their annotations."""

import collections.abc
import functools
import inspect
import numbers
import os
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

from steelnb.core.checks import quoted, shown
from steelnb.core.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


class Demand(NamedTuple):
    """What an annotation asks for: a test of values, words for the message, and the conversion of accepted values."""

    accepts: Callable[[Any], bool]
    words: str
    make: Callable[[Any], Any] = lambda value: value


MAKERS = {
    "Estimate": "odometry.correct", "ExperimentSettings": "ExperimentSettings.preset", "Flight": "read_flight",
    "FlightSettings": "FlightSettings.preset", "Lines": "detect_lines", "OdometrySettings": "OdometrySettings.preset",
    "Structure": "reconstruct", "Tower": "build_tower", "Truth": "experiment.simulate",
}  # fmt: skip
"""Class → what returns one, for the message."""
SIMPLE: dict[Any, Demand] = {
    bool: Demand(lambda value: isinstance(value, bool | np.bool_), "True or False", bool),
    int: Demand(lambda value: isinstance(value, numbers.Integral) and not isinstance(value, bool), "an integer", int),
    float: Demand(lambda value: isinstance(value, numbers.Real) and not isinstance(value, bool), "a number", float),
    str: Demand(lambda value: isinstance(value, str), "a text"),
    Path: Demand(lambda value: isinstance(value, os.PathLike), "a path"),
    type(None): Demand(lambda value: value is None, "None"),
}
UNCHECKED = Demand(lambda value: True, "")


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that are not of the kinds in its annotations, with an `InputError`.

    Classes, their unions, literals, functions, tables, texts, paths, flags, numbers, sequences and arrays of numbers
    are checked. Ranges, the shapes of arrays and the items of sequences are not: the function checks these itself
    (`checks`). Objects with a method ``checked`` become what that returns. Numbers become those of Python, since a
    kernel is compiled for each type that it meets. The checks take about 1 µs a call.
    """
    named = inspect.getfullargspec(inspect.unwrap(function))
    parameters = [*named.args, *named.kwonlyargs]
    kinds: dict[str, Demand] = {}  # filled by the first call, when all modules are loaded

    def as_annotated(name: str, value: Any) -> Any:
        kind = kinds.get(name, UNCHECKED)
        if kind.accepts(value):
            return kind.make(value)
        by = MAKERS.get(kind.words.partition(" ")[0])
        of = f" of {value.dtype}" if "array" in kind.words and hasattr(value, "dtype") else ""
        hint = f", as from {by}" if by else ""
        raise InputError(f"{name} = {shown(value)}{of}: expected {kind.words}{hint}")

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if not kinds:
            hints = typing.get_type_hints(function)
            kinds.update({name: _demand_of(hints.get(name, Any)) for name in parameters})
        by_place = [as_annotated(name, value) for name, value in zip(parameters, args, strict=False)]
        by_name = {name: as_annotated(name, value) for name, value in kwargs.items()}
        return function(*by_place, *args[len(parameters) :], **by_name)  # type: ignore[arg-type]

    return checked


def _is_series(values: Any) -> bool:
    return isinstance(values, collections.abc.Iterable) and not isinstance(values, str | bytes | dict)


def _demand_of(hint: Any) -> Demand:
    """What an annotation asks for. If it is not checked, all values are accepted, and there are no words."""
    origin, of = typing.get_origin(hint), typing.get_args(hint)
    if hint in SIMPLE or hint is Any:
        return SIMPLE.get(hint, UNCHECKED)
    if origin in (typing.Union, types.UnionType):
        kinds = [_demand_of(each) for each in of]
        if all(kind.words for kind in kinds):
            return Demand(
                lambda value: any(kind.accepts(value) for kind in kinds),
                " or ".join(kind.words for kind in kinds),
                lambda value: next(kind for kind in kinds if kind.accepts(value)).make(value),
            )
    elif origin is Literal:
        return Demand(lambda value: isinstance(value, str | int) and value in of, quoted(of))
    elif origin is collections.abc.Callable:
        return Demand(callable, "a function")
    elif origin in (collections.abc.Iterable, collections.abc.Sequence):
        return Demand(_is_series, "a sequence")
    elif origin in (dict, collections.abc.Mapping):
        return Demand(lambda value: isinstance(value, origin), "a table")
    elif inspect.isclass(hint) and origin is None and not getattr(hint, "_is_protocol", False):
        return Demand(lambda value: isinstance(value, hint), hint.__name__)
    return UNCHECKED
