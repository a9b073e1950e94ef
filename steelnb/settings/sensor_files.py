"""The check of a sensor's file, whatever the method that it is read for."""

from typing import Any

from steelnb.core.checks import guess, shown
from steelnb.core.errors import InputError
from steelnb.settings.base import Settings
from steelnb.settings.odometry import of_method
from steelnb.settings.presets import METHODS
from steelnb.settings.sensors import ImuSettings, TofSettings
from steelnb.settings.stages import FusionSettings, HoughSettings, PreprocessSettings

TABLES: dict[str, type[Settings]] = {
    "tof": TofSettings, "imu": ImuSettings, "preprocess.clouds": PreprocessSettings,
    "preprocess.segments": PreprocessSettings, "hough": HoughSettings, "fusion": FusionSettings,
}  # fmt: skip
"""Table → its settings. A table ``methods.NAME`` has those of a method."""


def check_sensor(path: str, tables: dict[str, Any]) -> None:
    """Raise `InputError` for a table that no sensor has, and for a bad setting in one."""
    named: dict[str, Any] = {}
    for name, table in tables.items():
        inner = name in ("preprocess", "methods") and isinstance(table, dict)
        named |= {f"{name}.{each}": value for each, value in table.items()} if inner else {name: table}
    of_methods = {f"methods.{method}": method for method in METHODS}
    for name, table in named.items():
        if name not in TABLES and name not in of_methods:
            settings = [f"{known}.{setting}" for known, kind in TABLES.items() for setting in kind.model_fields]
            near = guess(name, [*TABLES, *of_methods, *settings])
            expected = f"expected one of the tables {', '.join(TABLES)}, methods.NAME"
            raise InputError(f"{path}: {name} = {shown(table)}: unknown{near}; {expected}")
        if not isinstance(table, dict):
            raise InputError(f"{path}: {name} = {shown(table)}: expected a table, [{name}]")
        try:
            if name in TABLES:
                TABLES[name](**table)
            else:
                kind, values = of_method(of_methods[name], tables["methods"])
                kind(**values)
        except InputError as fault:
            raise InputError(f"{path}: [{name}]: {fault}") from None
        except RecursionError:
            raise InputError(f"{path}: [{name}]: based_on leads back to it; expected another method") from None
