"""An odometry of the user's own, from a Python module that is installed or lies in the working directory."""

import importlib
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from steelnb.errors import InputError
from steelnb.odometry.base import Odometry
from steelnb.settings.base import guess
from steelnb.types import Flight

GIVEN = ("T_drone_sensor", "imu", "images")
"""Parts of a flight that a constructor may ask for by these names."""


def load_odometry(name: str) -> Callable[..., Odometry]:
    """The class that ``MODULE:CLASS`` names. Raises `InputError` if module, class or its method `update` is missing, or
    if its constructor needs anything but `GIVEN`."""
    module_name, _, class_name = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except Exception as fault:
        raise InputError(f"{name}: module {module_name!r} cannot be imported: {fault}") from None
    finally:
        sys.path.pop(0)
    classes = [each for each, value in vars(module).items() if inspect.isclass(value)]
    if class_name not in classes:
        raise InputError(f"{name}: no class {class_name!r} in {module.__file__}{guess(class_name, classes)}")
    kind: Any = getattr(module, class_name)
    if not callable(getattr(kind, "update", None)):
        raise InputError(f"{name}: no method 'update'; expected update(scan, T_world_drone_prior) -> OdometryStep")
    parameters = inspect.signature(kind).parameters.values()
    needed = {each.name for each in parameters if each.default is each.empty and "VAR" not in each.kind.name}
    if unknown := needed - set(GIVEN):
        raise InputError(f"{name}: its constructor needs {', '.join(sorted(unknown))}; expected {', '.join(GIVEN)}")
    return kind  # type: ignore[no-any-return]


def own_odometry(kind: Callable[..., Odometry], flight: Flight) -> Odometry:
    """A new odometry of a user's class, given those parts of the flight that its constructor asks for."""
    wanted = inspect.signature(kind).parameters
    return kind(**{name: getattr(flight, name) for name in GIVEN if name in wanted})
