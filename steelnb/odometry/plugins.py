"""A user's own odometry: a class in a module of theirs."""

import copy
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import guess
from steelnb.core.errors import InputError, SteelnbError
from steelnb.core.types import Flight
from steelnb.odometry.base import Odometry

GIVEN = ("T_drone_sensor", "imu", "images")
"""Parts of a flight that the constructor of a user's odometry may take under these names."""
BY_NAME = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
SIGNALLED = 128
"""Codes of an exit above this are those of a signal, not the user's."""


@checks_arguments
def load_odometry(name: str) -> Callable[..., Odometry]:
    """Load the class ``MODULE:CLASS`` from an installed module or from one in the working directory, or
    ``FILE.py:CLASS`` from a file.

    Raises `InputError` if module, class or its method `update` is missing, if the class is abstract, or if its
    constructor requires arguments other than `GIVEN`.
    """
    module_name, _, class_name = name.rpartition(":") if ":" in name else (name, "", "")
    folder, file = Path.cwd(), Path(module_name).resolve() if module_name.endswith(".py") else None
    if file is not None:
        if not file.is_file():
            raise InputError(f"{name}: no file {module_name}; expected FILE.py:CLASS or MODULE:CLASS")
        folder, module_name = file.parent, file.stem
    sys.path.insert(0, str(folder))
    with users_code(f"{name}: module {module_name!r}", "its program below `if __name__ == '__main__':`"):
        try:
            module = importlib.import_module(module_name)
        except Exception as fault:  # the user's module may raise anything
            raise InputError(f"{name}: module {module_name!r} cannot be imported: {fault}") from None
        finally:
            sys.path.pop(0)
    where = getattr(module, "__file__", None) or "Python itself"
    if file is not None and Path(where).resolve() != file:
        raise InputError(f"{name}: {module_name!r} is the name of another module, in {where}; rename the file")
    classes: dict[str, Any] = dict(inspect.getmembers(module, inspect.isclass))
    if class_name not in classes:
        raise InputError(f"{name}: no class {class_name!r} in {where}{guess(class_name, list(classes))}")
    kind = classes[class_name]
    if not callable(getattr(kind, "update", None)):
        raise InputError(f"{name}: no method 'update'; expected update(scan, T_world_drone_prior) -> OdometryStep")
    _check_constructor(kind, name)
    return kind  # type: ignore[no-any-return]


def make_own(own: Callable[..., Odometry], flight: Flight) -> Odometry:
    """A new odometry of a user's class, given copies of the parts of the flight that its constructor takes by name.
    Raises `InputError` if that requires others."""
    name = getattr(own, "__name__", "own")
    _check_constructor(own, name)
    names = [each.name for each in _parameters(own) if each.kind in BY_NAME]
    shared = {id(flight.images.images): flight.images.images} if flight.images else {}  # made or read on access
    given = {each: copy.deepcopy(getattr(flight, each), shared) for each in GIVEN if each in names}
    with users_code(f"{name}: its constructor"):
        return own(**given)


@contextmanager
def users_code(what: str, expected: str = "no exit") -> Iterator[None]:
    """Raise `InputError` if a user's code raises anything, with the line, or would end the process, often with the code
    of success. ``what``: that code."""
    try:
        yield
    except SteelnbError:
        raise
    except Exception as fault:  # it may raise anything
        last = traceback.extract_tb(fault.__traceback__)[-1]
        said = f"{type(fault).__name__}: {fault}".removesuffix(": ")
        raise InputError(f"{what} raises {said} ({last.filename}, line {last.lineno})") from fault
    except SystemExit as ended:
        if isinstance(ended.code, int) and ended.code > SIGNALLED:
            raise
        raise InputError(f"{what} ends the process with {ended!r}; expected {expected}") from None


def _check_constructor(own: Callable[..., Odometry], name: str) -> None:
    """Raise `InputError` if a class is abstract, or if its constructor requires arguments other than `GIVEN`."""
    if missing := getattr(own, "__abstractmethods__", ()) or ["update"] * getattr(own, "_is_protocol", False):
        raise InputError(f"{name}: an abstract class; expected one with {', '.join(sorted(missing))}")
    needed = {each for each in _parameters(own) if each.default is each.empty and "VAR" not in each.kind.name}
    if unknown := sorted(each.name for each in needed if each.name not in GIVEN or each.kind not in BY_NAME):
        raise InputError(f"{name}: its constructor needs {', '.join(unknown)}; expected {', '.join(GIVEN)}, by name")


def _parameters(own: Callable[..., Odometry]) -> Iterable[inspect.Parameter]:
    """The parameters of a constructor that is not ours, so that only Python knows them; none if it does not, as of
    compiled classes."""
    try:
        return inspect.Signature.from_callable(own).parameters.values()
    except ValueError:
        return ()
