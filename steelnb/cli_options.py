"""Options that commands share. Names that one takes are listed in its help, completed by the shell, and checked."""

import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from steelnb.errors import SettingsError
from steelnb.report.words import guess


def _tables(name: str) -> tuple[str, ...]:
    """The tables of a file of presets. `steelnb.settings` has the same names, and takes too long to load for a Tab."""
    return tuple(tomllib.loads((PRESETS / f"{name}.toml").read_text(encoding="utf-8")))


PRESETS = Path(__file__).parent / "presets"
METHODS = (*_tables("methods"), "segments")
TRAJECTORIES = _tables("flights")
CAMERAS = _tables("cameras")
GOALS = ("around", "face")
SENSORS = tuple(sorted(path.stem for path in (PRESETS / "sensors").glob("*.toml")))
NOISES = ("none", "random-walk", "constant-drift", "constant-drift-per-axis", "yaw-random-walk", "tilt")


def one_of(
    names: Sequence[str],
    about: str,
    named: Callable[[str], Iterable[str]] = lambda value: [value],
    also: str = "",
    **more: Any,
) -> Any:
    """An option that takes one of some names, which replace ``{names}`` in its help.

    ``named`` gives the names in a value, where that may hold others than one. The check raises `SettingsError` with the
    nearest name and all of them; ``also`` says there what else is taken. ``more`` is for `typer.Option`.
    """

    def check(option: typer.CallbackParam, value: str | list[str] | None) -> str | list[str] | None:
        for given in [value] if isinstance(value, str) else value or []:
            for name in named(given):
                if name not in names:
                    quoted = ", ".join(map(repr, names))
                    near = guess(name, names)
                    raise SettingsError(f"{option.opts[0]}: unknown {name!r}{near}; expected one of {quoted}{also}")
        return value

    def complete(incomplete: str) -> list[str]:
        before = "".join(incomplete.rpartition("+")[:2])  # a noise may be a sum
        return [before + name for name in names]

    text = about.format(names=", ".join(names))
    return typer.Option(help=text, callback=check, autocompletion=complete, **{"metavar": "NAME", **more})


def noise_option(about: str) -> Any:
    """Names of noises, with or without a level, and sums of them."""
    return one_of(
        NOISES,
        f"{about}, such as random-walk:0.002: {{names}}, or a sum with +.",
        lambda value: [part.strip().partition(":")[0] for part in value.split("+")],
        metavar="NOISE",
    )


def examples(*lines: str, codes: str = "0 done; 2 bad input, nothing written; 130 interrupted.") -> str:
    """The end of a command's help: calls to copy, and the exit codes."""
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in lines), "", f"Exit codes: {codes}"))


def output_option(about: str, default: str | bool = True) -> Any:
    """The folder that a command writes to, by one name everywhere; ``default`` says which where that is computed."""
    return typer.Option("-o", "--output", metavar="FOLDER", help=about, show_default=default)


def overrides_of(changed: Iterable[str] | None) -> dict[str, Any]:
    """Settings by name from the texts NAME=VALUE of ``--set``. Raises `SettingsError`."""
    from steelnb.settings import parse_parameter

    for text in changed or []:
        if "=" not in text:
            raise SettingsError(f"--set {text}: expected MODULE.NAME=VALUE, such as preprocess.voxel_leaf_m=0.1")
    return dict(map(parse_parameter, changed or []))


Sensor = Annotated[
    str,
    one_of(
        SENSORS,
        "Whose settings to take: {names}, or FILE.toml.",
        lambda value: [] if value.endswith(".toml") else [value],
        ", or a file FILE.toml",
    ),
]


def _seed(text: Any) -> Any:
    """A whole number, or ``report``: settings check the rest."""
    try:
        return text if text == "report" else int(text)
    except ValueError:
        raise SettingsError(f"--seed: {text!r}: expected a whole number, or 'report'") from None


Seed = Annotated[
    Any,
    typer.Option(parser=_seed, metavar="N", help="Of drift, sensor noise and gusts; report: drift as in the report."),
]
