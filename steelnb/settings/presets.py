"""Presets: TOML files in ``steelnb/presets``, which a user can copy, change and name by their path."""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from steelnb.errors import SettingsError
from steelnb.files import reading
from steelnb.settings.base import S, as_tuples, quoted

TOML_BYTES_MAX = 1 << 22
PRESETS = Path(__file__).parent.parent / "presets"


def read_toml(path: Path, expected: str = "") -> dict[str, Any]:
    """The tables of a TOML file; ``expected`` is what messages call its content.

    Raises `FileMissingError` or `SettingsError`.
    """
    form = expected or "a TOML file"
    with reading(path, form), path.open("rb") as file:
        text = file.read(TOML_BYTES_MAX + 1)
    with reading(path, "a TOML file", content=SettingsError):
        if len(text) > TOML_BYTES_MAX:
            raise SettingsError(f"{path}: more than {TOML_BYTES_MAX} bytes; expected {form}")
        tables = tomllib.loads(text.decode())
        repr(tables)  # so that no table is nested deeper than messages about it can be
        return tables


def read_tables(path: Path, kind: type[S], expected: str) -> dict[str, S]:
    """The tables of a TOML file, each as settings of one ``kind``, by name. Raises what `read_toml` raises."""
    found = {}
    for name, table in read_toml(path, expected).items():
        if not isinstance(table, dict):
            raise SettingsError(f"{path}: [{name}]: {table!r}: expected a table")
        try:
            found[name] = kind(**table)
        except SettingsError as fault:
            raise SettingsError(f"{path}: [{name}]: {fault}") from None
    return found


def sensor_names() -> tuple[str, ...]:
    """The sensors that have a preset."""
    return tuple(sorted(path.stem for path in (PRESETS / "sensors").glob("*.toml")))


def sensor_preset(sensor: str) -> dict[str, Any]:
    """The tables of a sensor's preset, or of a file whose name ends in ``.toml``; what it does not say is said by the
    preset that it is ``based_on``. Raises `SettingsError`."""
    if isinstance(sensor, str) and sensor.endswith(".toml"):
        own = _values(read_toml(Path(sensor), "a sensor's preset"))
    elif sensor in sensor_names():
        own = dict(_preset(f"sensors/{sensor}"))
    else:
        raise SettingsError(f"sensor = {sensor!r}: expected one of {quoted(sensor_names())}, or a file FILE.toml")
    base = own.pop("based_on", None)
    if base is None:
        return own
    if base not in sensor_names():
        raise SettingsError(f"{sensor}: based_on = {base!r}: expected one of {quoted(sensor_names())}")
    return merged(sensor_preset(base), own)


def preset_table(file: str, kind: str, name: str) -> dict[str, Any]:
    """The settings, where they differ from the defaults, of one of the ``flights``, ``towers``, ``cameras`` or
    ``methods``: the ``file`` of its ``kind``. Raises `SettingsError`."""
    if name not in _preset(file):
        raise SettingsError(f"{kind} = {name!r}: expected one of {quoted(_preset(file))}")
    return _preset(file)[name]


def members_file(members: str) -> Path:
    """The list of a tower's members: by its name, or a file whose name ends in ``.csv``. Raises `SettingsError`."""
    path = Path(members) if members.endswith(".csv") else PRESETS / f"{members}.csv"
    if not path.is_file():
        names = quoted(sorted(known.stem for known in PRESETS.glob("*.csv")))
        raise SettingsError(f"tower.members = {members!r}: no such list; expected one of {names}, or a file FILE.csv")
    return path


def method_names() -> tuple[str, ...]:
    """The methods that have a preset."""
    return tuple(_preset("methods"))


def method_preset(method: str, of_sensor: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The settings of a method, those that it is ``based_on`` included, each with what a sensor's preset adds to it
    (``of_sensor``, by method). Raises `SettingsError`."""
    own = merged(preset_table("methods", "method", method), of_sensor.get(method, {}))
    base = own.pop("based_on", None)
    return merged(method_preset(base, of_sensor), own) if base else own


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Tables of settings with some values replaced, table by table."""
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        result[name] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


@cache
def _preset(name: str) -> dict[str, Any]:
    return _values(read_toml(PRESETS / f"{name}.toml"))


def _values(table: Any) -> Any:
    """Tables with lists as the tuples of settings."""
    return {name: _values(value) for name, value in table.items()} if isinstance(table, dict) else as_tuples(table)
