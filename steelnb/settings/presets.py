"""Presets: TOML files in ``steelnb/settings/presets``. A user can copy one, change it and pass its path."""

import os
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BeforeValidator

from steelnb.core.checks import guess, quoted, shown
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.settings.base import Settings, as_plain

PRESETS = Path(__file__).parent / "presets"
SENSORS = tuple(sorted(path.stem for path in (PRESETS / "sensors").glob("*.toml")))
S = TypeVar("S", bound=Settings)


def read_toml(path: Path | str, expected: str = "") -> dict[str, Any]:
    """The tables of a TOML file; ``expected`` describes its content in messages. Raises `InputError`."""
    path, expected = Path(path), expected or "a TOML file"
    with reading(path, expected):
        try:
            text = path.read_bytes().decode("utf-8-sig")  # editors of Windows write a byte order mark
        except UnicodeDecodeError:
            raise InputError(f"{path}: text that is not UTF-8; expected {expected}, saved as UTF-8") from None
        return tomllib.loads(text)


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


def name_or_path(given: Any) -> Any:
    """The name of a preset, or of a file that may be given as its path."""
    return os.fspath(given) if isinstance(given, os.PathLike) else given


NameOrPath = Annotated[str, BeforeValidator(name_or_path)]


def sensor_preset(sensor: str | Path) -> dict[str, Any]:
    """The tables of a sensor's preset or of a file ``FILE.toml``, all of them checked. Missing values come from the
    preset that ``based_on`` names; ``imu = false`` is none. Raises `InputError`."""
    sensor = name_or_path(sensor)
    if isinstance(sensor, str) and sensor.endswith(".toml"):
        own = as_plain(read_toml(Path(sensor), "a sensor's preset"))
    elif isinstance(sensor, str) and sensor in SENSORS:
        own = dict(_preset(f"sensors/{sensor}"))
    else:
        near = guess(sensor, SENSORS)
        raise InputError(f"sensor = {shown(sensor)}{near}; expected one of {quoted(SENSORS)}, or a file FILE.toml")
    base = own.pop("based_on", None)
    if base is not None and base not in SENSORS:
        raise InputError(f"{sensor}: based_on = {base!r}: expected one of {quoted(SENSORS)}")
    tables = own if base is None else merged(sensor_preset(base), own)
    if tables.get("imu") is False:
        del tables["imu"]
    if sensor not in SENSORS:
        from steelnb.settings.sensor_files import check_sensor  # imports this module

        check_sensor(sensor, tables)
    return tables


def preset_table(file: str, kind: str, name: str) -> dict[str, Any]:
    """The settings of a named preset that differ from the defaults. ``file``: ``flights``, ``towers`` or ``methods``;
    ``kind``: what messages call the name. Raises `InputError`."""
    if not isinstance(name, str) or name not in _preset(file):
        known = _preset(file)
        raise InputError(f"{kind} = {shown(name)}{guess(name, known)}; expected one of {quoted(known)}")
    return _preset(file)[name]


def members_file(members: str) -> Path:
    """Path of a list of members, given by the name of a preset or as ``FILE.csv``. Raises `InputError`."""
    path = Path(members) if members.endswith(".csv") else PRESETS / f"{members}.csv"
    if not path.is_file():
        names = quoted(sorted(known.stem for known in PRESETS.glob("*.csv")))
        raise InputError(f"tower.members = {members!r}: no such list; expected one of {names}, or a file FILE.csv")
    return path


def method_preset(method: str, of_sensor: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The settings of a method, including the method that it is ``based_on``. ``of_sensor``: the sensor preset's
    additions, by method. Raises `InputError`."""
    own = merged(preset_table("methods", "method", method), of_sensor.get(method, {}))
    base = own.pop("based_on", None)
    return merged(method_preset(base, of_sensor), own) if base else own


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Tables of settings with some values replaced, recursively."""
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        result[name] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


@cache
def _preset(name: str) -> dict[str, Any]:
    return dict(as_plain(read_toml(PRESETS / f"{name}.toml")))


METHODS, TOWERS = (tuple(_preset(file)) for file in ("methods", "towers"))
