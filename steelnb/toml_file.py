"""Reading of settings files."""

import tomllib
from pathlib import Path
from typing import Any

from steelnb.errors import FileMissingError, SettingsError


def read_toml(path: Path, expected: str = "") -> dict[str, Any]:
    """The tables of a TOML file; ``expected`` is what the message about a missing one says.

    Raises `FileMissingError` or `SettingsError`.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        raise FileMissingError(f"{path}: {fault.strerror}{'; expected ' if expected else ''}{expected}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise SettingsError(f"{path}: not a TOML file: {fault}") from None
