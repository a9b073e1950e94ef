"""Rerun's own window on one file: with nobody's settings, reporting to nobody, and listening to this machine alone."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from steelnb.errors import SettingsError
from steelnb.viewer.web import LOCALHOST

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
DROPPED = ("NO_PROXY", "FORCE_RERUN_ANALYTICS", "RERUN")


def need_display() -> None:
    """Raise `SettingsError` where no window can be opened."""
    if sys.platform not in ("darwin", "win32") and not any(map(os.environ.get, DISPLAYS)):
        raise SettingsError(f"no display, neither {' nor '.join(DISPLAYS)} is set; expected one, or --web")


def window_command(rrd: Path) -> list[str]:
    """What opens the window."""
    viewer = [sys.executable, "-m", "rerun_cli", str(rrd)]
    return [*viewer, "--bind", LOCALHOST, "--port", "auto", "--hide-welcome-screen"]


def quiet_environment(home: Path) -> dict[str, str]:
    """The user's environment for a rerun that reports nothing and writes nothing but into the folder ``home``.

    Rerun reads from a file whether it may report; it also reports nothing where it believes to be tested (``CI``),
    which holds where that file is looked for elsewhere, as on macOS and Windows. It also asks GitHub for its newest
    version; whatever it asks of the internet goes to a proxy where nobody listens.
    """
    config = home / "config" / "rerun"
    config.mkdir(parents=True)
    data = home / "data" / "rerun"
    settings = {
        "analytics_enabled": False,
        "analytics_id": "none",
        "metadata": {},
        "config_file_path": str(config / "analytics.json"),
        "data_dir_path": str(data / "analytics"),
    }
    (config / "analytics.json").write_text(json.dumps(settings), encoding="utf-8")
    nowhere = dict.fromkeys((*PROXIES, *map(str.lower, PROXIES)), "http://127.0.0.1:9")
    quiet = {"XDG_CONFIG_HOME": str(config.parent), "XDG_DATA_HOME": str(data.parent), "CI": "true"}
    kept = {name: value for name, value in os.environ.items() if name.upper() not in DROPPED}
    return kept | quiet | nowhere


def show(rrd: Path) -> None:
    """Open a window on an .rrd file, and wait until it is closed. Raises `SettingsError` where the viewer fails."""
    with tempfile.TemporaryDirectory(prefix="steelnb-view-") as home:
        code = subprocess.run(window_command(rrd), env=quiet_environment(Path(home)), check=False).returncode
    if code:
        raise SettingsError(f"rerun's viewer ended with code {code}; expected a display that it can draw to, or --web")
