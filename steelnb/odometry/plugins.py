"""A user's own odometry: a class in a module of theirs."""

import importlib
import inspect
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import guess
from steelnb.core.errors import InputError
from steelnb.core.types import Flight
from steelnb.odometry.base import Odometry

GIVEN = ("T_drone_sensor", "imu", "images")
"""Parts of a flight that the constructor of a user's odometry may take under these names."""


@checks_arguments
def load_odometry(name: str) -> Callable[..., Odometry]:
    """Load the class ``MODULE:CLASS`` from an installed module, or from one in the working directory.

    Raises `InputError` if module, class or its method `update` is missing, or if its constructor requires arguments
    other than `GIVEN`.
    """
    module_name, _, class_name = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except Exception as fault:  # the user's module may raise anything
        raise InputError(f"{name}: module {module_name!r} cannot be imported: {fault}") from None
    finally:
        sys.path.pop(0)
    classes: dict[str, Any] = dict(inspect.getmembers(module, inspect.isclass))
    if class_name not in classes:
        raise InputError(f"{name}: no class {class_name!r} in {module.__file__}{guess(class_name, list(classes))}")
    kind = classes[class_name]
    if not callable(getattr(kind, "update", None)):
        raise InputError(f"{name}: no method 'update'; expected update(scan, T_world_drone_prior) -> OdometryStep")
    _check_constructor(kind, name)
    return kind  # type: ignore[no-any-return]


def make_own(own: Callable[..., Odometry], flight: Flight) -> Odometry:
    """A new odometry of a user's class, given the parts of the flight that its constructor takes by name. Raises
    `InputError` if that requires others."""
    _check_constructor(own, getattr(own, "__name__", "own"))
    names = [each.name for each in _parameters(own)]
    return own(**{name: getattr(flight, name) for name in GIVEN if name in names})


def _check_constructor(own: Callable[..., Odometry], name: str) -> None:
    """Raise `InputError` if a constructor requires arguments other than `GIVEN`."""
    needed = {each.name for each in _parameters(own) if each.default is each.empty and "VAR" not in each.kind.name}
    if unknown := needed - set(GIVEN):
        raise InputError(f"{name}: its constructor needs {', '.join(sorted(unknown))}; expected {', '.join(GIVEN)}")


def _parameters(own: Callable[..., Odometry]) -> Iterable[inspect.Parameter]:
    """The parameters of a constructor that is not ours, so that only Python knows them."""
    return inspect.Signature.from_callable(own).parameters.values()
