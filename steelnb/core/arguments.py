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
from typing import Any, Literal, ParamSpec, TypeVar

import numpy as np

from steelnb.core.checks import quoted, shown
from steelnb.core.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
Test = tuple[Callable[[Any], bool], str]
"""Whether a value is of a kind, and the kind in words."""

MAKERS = {
    "Estimate": "odometry.correct", "ExperimentSettings": "ExperimentSettings.preset", "Flight": "read_flight",
    "FlightSettings": "FlightSettings.preset", "Lines": "detect_lines", "OdometrySettings": "OdometrySettings.preset",
    "Structure": "reconstruct", "Tower": "build_tower", "Truth": "experiment.simulate",
}  # fmt: skip
"""Class → what returns one, for the message."""
SIMPLE: dict[Any, Test] = {
    bool: (lambda value: isinstance(value, bool | np.bool_), "True or False"),
    int: (lambda value: isinstance(value, numbers.Integral) and not isinstance(value, bool), "an integer"),
    float: (lambda value: isinstance(value, numbers.Real) and not isinstance(value, bool), "a number"),
    str: (lambda value: isinstance(value, str), "a text"),
    Path: (lambda value: isinstance(value, os.PathLike), "a path"),
    type(None): (lambda value: value is None, "None"),
}

UNCHECKED: Test = (lambda value: True, "")


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that are not of the kinds in its annotations, with an `InputError`.

    Classes, their unions, literals, functions, tables, texts, paths, flags and numbers are checked. Ranges, arrays and
    the items of sequences are not: the function checks these itself (`checks`). The checks take about 1 µs a call.
    """
    named = inspect.getfullargspec(inspect.unwrap(function))
    parameters = [*named.args, *named.kwonlyargs]
    tests: dict[str, Test] = {}  # filled by the first call, when all modules are loaded

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if not tests:
            hints = typing.get_type_hints(function)
            tests.update({name: _test_of(hints.get(name, Any)) for name in parameters})
        for name, value in (*zip(parameters, args, strict=False), *kwargs.items()):
            if name in tests and not tests[name][0](value):
                kind, by = tests[name][1], MAKERS.get(tests[name][1].partition(" ")[0])
                raise InputError(f"{name} = {shown(value)}: expected {kind}{f', as from {by}' if by else ''}")
        return function(*args, **kwargs)

    return checked


def _test_of(hint: Any) -> Test:
    """The test for an annotation; that of what is not checked accepts all, and has no words."""
    origin, of = typing.get_origin(hint), typing.get_args(hint)
    if hint in SIMPLE or hint is Any:
        return SIMPLE.get(hint, UNCHECKED)
    if origin in (typing.Union, types.UnionType):
        tests = [_test_of(each) for each in of]
        if all(words for _, words in tests):
            return lambda value: any(accepts(value) for accepts, _ in tests), " or ".join(words for _, words in tests)
    elif origin is Literal:
        return lambda value: isinstance(value, str | int) and value in of, quoted(of)
    elif origin is collections.abc.Callable:
        return callable, "a function"
    elif origin in (dict, collections.abc.Mapping):
        return lambda value: isinstance(value, origin), "a table"
    elif inspect.isclass(hint) and origin is None and not getattr(hint, "_is_protocol", False):
        return lambda value: isinstance(value, hint), hint.__name__
    return UNCHECKED
