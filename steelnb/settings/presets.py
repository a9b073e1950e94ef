"""Presets: TOML files in ``steelnb/settings/presets``, as tables. A user can copy one, change it and pass its path.

The settings classes validate what is read here.
"""

import os
import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from steelnb.core.checks import guess, quoted, shown
from steelnb.core.errors import InputError
from steelnb.core.files import reading

PRESETS = Path(__file__).parent / "presets"
SENSORS = tuple(sorted(path.stem for path in (PRESETS / "sensors").glob("*.toml")))


def read_toml(path: Path | str, expected: str = "") -> dict[str, Any]:
    """The tables of a TOML file; ``expected`` describes its content in messages. Raises `InputError`."""
    path, expected = Path(path), expected or "a TOML file"
    with reading(path, expected):
        try:
            text = path.read_bytes().decode("utf-8-sig")  # editors of Windows write a byte order mark
        except UnicodeDecodeError:
            raise InputError(f"{path}: text that is not UTF-8; expected {expected}, saved as UTF-8") from None
        return tomllib.loads(text)


def name_or_path(given: Any) -> Any:
    """The name of a preset, or of a file that may be given as its path."""
    return os.fspath(given) if isinstance(given, os.PathLike) else given


NameOrPath = Annotated[str, BeforeValidator(name_or_path)]


def sensor_tables(sensor: str | Path) -> dict[str, Any]:
    """The tables of a sensor's preset, or of a file ``FILE.toml``, with those that it is ``based_on``. Raises
    `InputError`."""
    sensor = name_or_path(sensor)
    if isinstance(sensor, str) and sensor.endswith(".toml"):
        own = read_toml(sensor, "a sensor's preset")
    elif isinstance(sensor, str) and sensor in SENSORS:
        own = dict(_preset(f"sensors/{sensor}"))
    else:
        near = guess(sensor, SENSORS)
        raise InputError(f"sensor = {shown(sensor)}{near}; expected one of {quoted(SENSORS)}, or a file FILE.toml")
    base = own.pop("based_on", None)
    if base is not None and base not in SENSORS:
        raise InputError(f"{sensor}: based_on = {base!r}: expected one of {quoted(SENSORS)}")
    return own if base is None else merged(sensor_tables(base), own)


def preset_table(file: str, kind: str, name: str) -> dict[str, Any]:
    """The settings of a named preset that differ from the defaults. ``file``: ``flights``, ``towers`` or ``methods``;
    ``kind``: what messages call the name. Raises `InputError`."""
    if not isinstance(name, str) or name not in _preset(file):
        known = _preset(file)
        raise InputError(f"{kind} = {shown(name)}{guess(name, known)}; expected one of {quoted(known)}")
    return dict(_preset(file)[name])


def method_table(method: str, of_sensor: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The settings of a method, with those of the method that it is ``based_on``. ``of_sensor``: a sensor's changes, by
    method. Raises `InputError`."""
    own = preset_table("methods", "method", method)
    base = own.pop("based_on", None)
    own = merged(own, of_sensor.get(method, {}))
    return merged(method_table(base, of_sensor), own) if base else own


def members_file(members: str) -> Path:
    """Path of a list of members, given by the name of a preset or as ``FILE.csv``. Raises `InputError`."""
    path = Path(members) if members.endswith(".csv") else PRESETS / f"{members}.csv"
    if not path.is_file():
        names = quoted(sorted(known.stem for known in PRESETS.glob("*.csv")))
        raise InputError(f"tower.members = {members!r}: no such list; expected one of {names}, or a file FILE.csv")
    return path


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Tables of settings with some values replaced, recursively."""
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        result[name] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


@cache
def _preset(name: str) -> dict[str, Any]:
    return read_toml(PRESETS / f"{name}.toml")


METHODS, TOWERS = (tuple(_preset(file)) for file in ("methods", "towers"))
