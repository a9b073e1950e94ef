"""`make check`: everything runs again into a scratch folder, and is compared with the committed results."""

import csv
import fnmatch
import io
import json
import math
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from pydantic import Field

from steelnb.errors import InputError
from steelnb.results import EXPERIMENTS_FILE
from steelnb.settings import Positive, Settings, read_toml

ABSOLUTE_FLOOR = 1e-12
Values = dict[str, str]


class CheckSettings(Settings):
    """The table ``[check]`` of `runs.toml`: tolerance, and glob of ``<id>.<metric or column>`` → reason why that
    may differ."""

    relative_tolerance: Positive = 1e-6
    exceptions: dict[str, str] = Field(default_factory=dict)


def read_check_settings(root: Path) -> CheckSettings:
    """How the project below ``root`` compares. Raises `InputError`."""
    return CheckSettings(**read_toml(root / EXPERIMENTS_FILE).get("check", {}))


def read_results(folder: Path, ids: Iterable[str]) -> Values:
    """Every number and text of the results ``<folder>/<id>/``: ``<id>.<metric>``, ``<id>.<column> row <k>``."""
    return _values(ids, lambda id, name: _read(folder / id / name))


def read_committed(root: Path, folder: str, ids: Iterable[str]) -> Values:
    """The same of the last commit; of the tree where there is no git, or no commit of it."""
    return _values(ids, lambda id, name: _committed(root, f"{folder}/{id}/{name}"))


def _committed(root: Path, path: str) -> str:
    shown = subprocess.run(["git", "show", f"HEAD:./{path}"], cwd=root, capture_output=True)
    return _read(root / path) if shown.returncode else shown.stdout.decode()


def _values(ids, read) -> Values:  # type: ignore[no-untyped-def]
    found: Values = {}
    for id in ids:
        found |= {f"{id}.{name}": repr(value) for name, value in json.loads(read(id, "metrics.json")).items()}
        for k, row in enumerate(csv.DictReader(io.StringIO(read(id, "table.csv"), newline="")), start=1):
            found |= {f"{id}.{column} row {k}": cell for column, cell in row.items()}
    return found


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        raise InputError(f"{path}: nothing to compare; run `make reproduce` first") from None


def differences(committed: Values, now: Values, settings: CheckSettings) -> Iterator[tuple[str, str]]:
    """A line for each difference, and the reason that excuses it or "".

    Numbers agree within the settings' tolerance, relative (1e-12 absolute), texts if they are equal; a value that only
    one side has is a difference.
    """
    for name in dict.fromkeys([*committed, *now]):
        old, new = committed.get(name, "missing"), now.get(name, "missing")
        if not agree(old, new, settings.relative_tolerance):
            metric = name.partition(" row ")[0]
            reasons = (why for pattern, why in settings.exceptions.items() if fnmatch.fnmatchcase(metric, pattern))
            yield f"{name}: committed {old}, now {new}", next(reasons, "")


def agree(old: str, new: str, tolerance: float) -> bool:
    try:
        return old == new or math.isclose(float(old), float(new), rel_tol=tolerance, abs_tol=ABSOLUTE_FLOOR)
    except ValueError:
        return False


def say(found: Iterable[tuple[str, str]], committed: Mapping[str, str], settings: CheckSettings) -> bool:
    """Print exceptions, differences and a last line; whether everything agrees that has no excuse."""
    for pattern, reason in settings.exceptions.items():
        print(f"exception: {pattern}: {reason}")
    count = 0
    for line, reason in found:
        print(f"excused ({reason}): {line}" if reason else f"DIFFERS: {line}")
        count += not reason
    agreed = f"{len(committed)} metrics and cells of tables agree to {settings.relative_tolerance:g} relative"
    print(f"{count} differences" if count else agreed)
    return not count
