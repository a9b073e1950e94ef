"""Reader of folders of clouds with a trajectory, as other programs write and name them."""

import re
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name
from steelnb.core.types import Array, Trajectory
from steelnb.io.clouds import READERS, read_points
from steelnb.io.trajectories import SECONDS, read_trajectory, unit_of_stamps

if TYPE_CHECKING:
    from steelnb.io.recordings import Walk, _Parts

TRUE = ("groundtruth.tum", "groundtruth.txt", "groundtruth.csv")
TRAJECTORIES = (".tum", ".txt", ".csv")
"""Suffixes of files that may be trajectories."""
STRAY_SHARE = 0.1
"""Clouds with names of another form are no scans if they are fewer than this share of the scans, or a single one."""
STEP_S = 1e-3, 60.0
"""Bounds of the median interval of scans, by which the unit of small stamps is recognised."""
OVERLAP_MIN, NS_DIGITS = 0.5, 16
"""Minimum overlap of small stamps with the poses, by which their unit is recognised; integers with so many digits are
nanoseconds."""
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def open_clouds(path: Path, scans: str | None, poses: str | None) -> "_Parts":
    """Open a folder of clouds with a trajectory: the parts of a `Flight` (`steelnb.io.recordings`).

    The stamps are numbers in the names, or those of the poses if there is one pose a cloud. Raises `InputError`.
    """
    skipped = Counter[str]()
    folder = path / scans if scans else path
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected clouds in it")
    files, strays = _scans(folder)
    trajectory = _trajectory_file(path, poses, files)
    prior = read_trajectory(trajectory, skipped)
    stamp_s, source = _stamps(files, prior)
    if stamp_s is None:
        stamp_s, source = prior.stamp_s, "in the order of their names"
        if len(prior) != len(files):
            raise InputError(
                f"{path}: {len(files)} clouds, no stamps in their names, and {len(prior)} poses in {trajectory.name}; "
                f"expected one pose per cloud, or stamps in the names, unlike {files[0].name}"
            )
    strays = [file for file in strays if file != trajectory and file.name not in TRUE]
    if strays:
        named = ", ".join(map(display_name, strays[:3])) + (", …" if len(strays) > 3 else "")
        skipped[f"cloud beside the scans ({named})"] += len(strays)
    facts = {"scans": f"{len(files)} files, {source}", "poses": display_name(trajectory), "mount": "identity assumed"}
    walk: Walk = lambda number: (partial(read_points, files[k]) for k in number.tolist())  # noqa: E731
    return stamp_s, walk, prior, np.eye(4), facts, None, skipped


def named_file(path: Path, name: str) -> Path:
    """A file by its name, relative to the working directory or to ``path``. Raises `InputError`."""
    for file in (Path(name), path / name):
        if file.is_file():
            return file
    raise InputError(f"{name}: no such file, here or in {path}; expected a trajectory")


def _scans(folder: Path) -> tuple[list[Path], list[Path]]:
    """The clouds in a folder that are scans, sorted by the numbers in their names, 9 before 10, and the other clouds.

    The names of scans differ in their numbers alone. Raises `InputError`.
    """
    suffixes = [suffix for suffix in READERS if suffix != ".txt"]
    files = sorted(file for file in folder.glob("[!.]*") if file.suffix.lower() in suffixes and file.is_file())
    forms: dict[str, list[Path]] = {}
    for file in files:
        forms.setdefault(NUMBER.sub("#", file.stem) + file.suffix.lower(), []).append(file)
    no_tables = [file for file in files if file.suffix.lower() != ".csv"]
    if not no_tables and max(map(len, forms.values()), default=0) < 2:
        held = ", ".join(sorted({file.suffix or file.name for file in folder.glob("[!.]*")})[:8]) or "nothing"
        raise InputError(f"{folder}: no clouds in it, but {held}; expected files with suffix {', '.join(suffixes)}")
    chosen = max(forms.values(), key=len)
    others = [each for each in forms.values() if each is not chosen]
    if len(chosen) == 1:  # the names have no numbers
        chosen, others = no_tables or files, []
    for each in others:
        if len(each) > max(1, STRAY_SHARE * len(chosen)):
            raise InputError(
                f"{folder}: {len(chosen)} clouds such as {chosen[0].name}, and {len(each)} such as {each[0].name}; "
                "expected names that differ in numbers alone, or one kind a folder"
            )
    scans = sorted(chosen, key=lambda file: ([float(number) for number in NUMBER.findall(file.stem)], file.stem))
    return scans, sorted(set(files) - set(scans))


def _trajectory_file(path: Path, poses: str | None, scans: Sequence[Path]) -> Path:
    """The file of the drone's poses: the one of this name, or the only one in the folder. Raises `InputError`."""
    if poses:
        return named_file(path, poses)
    files = [file for file in sorted(path.glob("[!.]*")) if file.suffix.lower() in TRAJECTORIES and file.is_file()]
    found = [file for file in files if file.name not in TRUE and file not in {*scans}]
    if len(found) > 1:  # notes and tables of other things are no trajectories
        found = [file for file in found if _is_trajectory(file)] or found
    if len(found) != 1:
        listed = ", ".join(file.name for file in found) or "no trajectory"
        raise InputError(f"{path}: {listed}; expected one TUM file (.tum, .txt, .csv), or the name of one (--poses)")
    return found[0]


def _is_trajectory(file: Path) -> bool:
    try:
        return len(read_trajectory(file)) > 0
    except InputError:
        return False


def _stamps(files: Sequence[Path], prior: Trajectory) -> tuple[Array | None, str]:
    """Stamps ``(K,)`` in seconds from the names, and what they are; None if the names hold no stamps of rising order.

    They are the last number, as seconds with a decimal point, or as an integer in a unit that fits the poses; or the
    last two numbers, as seconds and a fraction of nine, six or three digits.
    """
    numbers = [NUMBER.findall(file.stem) for file in files]
    if not all(numbers):
        return None, ""
    last = [each[-1] for each in numbers]
    for values, source in _readings(numbers, last, prior):
        if len(values) == 1 or ((np.diff(values) >= 0).all() and STEP_S[0] <= np.median(np.diff(values)) <= STEP_S[1]):
            return values, source
    return None, ""


def _readings(numbers: list[list[str]], last: list[str], prior: Trajectory) -> list[tuple[Array, str]]:
    """What the numbers in the names may mean, the likelier first: stamps in seconds, and a text."""
    if any("." in number for number in last):
        return [(np.array([float(number) for number in last]), "stamped by the seconds in their names")]
    found = []
    if all(len(each) > 1 for each in numbers):
        first = np.array([float(each[-2]) for each in numbers])
        width = max(map(len, last))
        is_unix = unit_of_stamps(first) == "s"
        if width <= 9 and (is_unix or {*map(len, last)} == {9}):
            digits = 3 * -(-width // 3)
            fraction = np.array([int(number) for number in last]) / 10**digits
            found.append((first + fraction, f"stamped by the seconds and 1e-{digits} s in their names"))
    whole = [int(number) for number in last]
    unit = unit_of_stamps(np.array(whole, dtype=np.float64)) or ("ns" if min(map(len, last)) >= NS_DIGITS else None)
    units = [unit] if unit else ["ns", "us", "ms"]
    for each in units:
        per_second = round(1 / SECONDS[each])
        stamp_s = np.array([number // per_second + number % per_second / per_second for number in whole])
        if unit or _overlap(stamp_s, prior.stamp_s) > OVERLAP_MIN:
            found.append((stamp_s, f"stamped by the {each.replace('us', 'µs')} in their names"))
    return found


def _overlap(one_s: Array, other_s: Array) -> float:
    """Share that two intervals have in common, of the longer one."""
    both = min(one_s[-1], other_s[-1]) - max(one_s[0], other_s[0])
    return float(both / max(np.ptp(one_s), np.ptp(other_s), 1e-9))
