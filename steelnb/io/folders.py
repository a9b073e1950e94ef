"""Reader of folders of clouds with a trajectory, as other programs write and name them."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name
from steelnb.core.types import Array, Trajectory
from steelnb.io.clouds import READERS, read_points
from steelnb.io.containers import is_bag
from steelnb.io.encodings import foreign_file
from steelnb.io.opened import Opened, Walk
from steelnb.io.table_form import read_table, unix_us
from steelnb.io.trajectories import OUT_OF_ORDER, SECONDS, read_trajectory, unit_of_stamps

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
FRACTIONS = {3: "ms", 6: "µs", 9: "ns"}
NUMBER = re.compile(r"\d+(?:\.\d+)?")
DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_. T]*(\d\d)[-_.h]?(\d\d)[-_.m]?(\d\d)s?"
    r"(?:[-_.,]?(\d{1,9}))?(?!\d)"
)
"""Date and time, to decimals of a second, as programs that may not use colons write them into names."""


def open_clouds(path: Path, scans: str | None, poses: str | None) -> Opened:
    """Open a folder of clouds with a trajectory.

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
    if stamp_s is not None:
        by_stamp = np.argsort(stamp_s, kind="stable")
        files, stamp_s = [files[k] for k in by_stamp], stamp_s[by_stamp]
    else:
        stamp_s, source = prior.stamp_s, "in the order of their names"
        dropped = f" ({skipped.total()} dropped)" if skipped.total() else ""
        if len(prior) != len(files) or skipped[OUT_OF_ORDER]:
            order = f", {skipped[OUT_OF_ORDER]} of them out of order" if skipped[OUT_OF_ORDER] else dropped
            raise InputError(
                f"{path}: {len(files)} clouds, no stamps in their names, and {len(prior)} poses in {trajectory.name}"
                f"{order}; expected one pose per cloud, or stamps in the names, unlike {files[0].name}"
                + (f" ({', '.join(file.name for file in strays[:3])} beside them)" if strays else "")
            )
    strays = [file for file in strays if file != trajectory and file.name not in TRUE]
    if strays:
        named = ", ".join(map(display_name, strays[:3])) + (", …" if len(strays) > 3 else "")
        skipped[f"cloud beside the scans ({named})"] += len(strays)
    facts = {"scans": f"{len(files)} files, {source}", "poses": display_name(trajectory), "mount": "identity assumed"}
    walk: Walk = lambda number: (partial(read_points, files[k]) for k in number.tolist())  # noqa: E731
    return Opened(stamp_s, walk, prior, np.eye(4), facts, None, skipped)


def named_file(path: Path, name: str) -> Path:
    """A file by its name, relative to the working directory or to ``path``. Raises `InputError`."""
    for file in (Path(name), path / name):
        if os.path.exists(file) and not os.path.isdir(file):
            return file
    raise InputError(f"{name}: no such file, here or in {path}; expected a trajectory")


def _other_files(folder: Path, suffixes: Sequence[str]) -> str:
    """What is in a folder instead of clouds, and what to do."""
    files = sorted(folder.glob("[!.]*"))
    held = ", ".join(sorted({file.suffix or file.name for file in files})[:8]) or "nothing"
    wanted = f"{held}; expected files with suffix {', '.join(suffixes)}"
    for inner in filter(Path.is_dir, files):
        if any(file.suffix.lower() in suffixes for file in inner.iterdir()):
            return f"{wanted}, or the name of a folder in it (--scans {inner.name})"
    for file in filter(Path.is_file, files):
        if what := foreign_file(file):
            return f"{held}; {file.name} is {what}"
    return wanted


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
        raise InputError(f"{folder}: no clouds in it, but {_other_files(folder, suffixes)}")
    chosen = max(forms.values(), key=len)
    others = [each for each in forms.values() if each is not chosen]
    if len(chosen) == 1:  # the names differ in more than numbers
        chosen, others = no_tables or files, []
        leading = {float(match[0]) for file in chosen if (match := NUMBER.match(file.stem))}
        has_stamps = all("." in "".join(NUMBER.findall(file.stem)) for file in chosen)
        if _by_number(chosen) != sorted(chosen) and len(leading) < len(chosen) and not has_stamps:
            raise InputError(
                f"{folder}: clouds such as {chosen[0].name} and {chosen[1].name} have no order; expected names that "
                "differ in numbers alone"
            )
    for each in sorted(others, key=len, reverse=True):
        if len(each) > max(1, STRAY_SHARE * len(chosen)) or len(files) > 2 * len(chosen):
            raise InputError(
                f"{folder}: {len(chosen)} clouds such as {chosen[0].name}, and {len(each)} such as {each[0].name}; "
                "expected names that differ in numbers alone, or one kind a folder"
            )
    scans = _by_number(chosen)
    return scans, sorted(set(files) - set(scans))


def _by_number(files: Sequence[Path]) -> list[Path]:
    """Files in the order of the numbers in their names."""
    return sorted(files, key=lambda file: ([float(number) for number in NUMBER.findall(file.stem)], file.stem))


def _trajectory_file(path: Path, poses: str | None, scans: Sequence[Path]) -> Path:
    """The file of the drone's poses: the one of this name, or the only one in the folder. Raises `InputError`."""
    if poses:
        return named_file(path, poses)
    files = [file for file in sorted(path.glob("[!.]*")) if file.suffix.lower() in TRAJECTORIES and file.is_file()]
    found = [file for file in files if file.name not in TRUE and file not in {*scans}]
    if len(found) > 1:  # notes and tables of other things are no trajectories
        found = [file for file in found if _is_trajectory(file)] or found
    if len(found) != 1:
        bags = [file.name for file in sorted(path.glob("[!.]*")) if not file.is_dir() and is_bag(file)]
        if bags and not found:
            raise InputError(
                f"{path}: clouds without a trajectory, and {', '.join(bags)}; expected one, or the bag itself"
            )
        listed = ", ".join(file.name for file in found) or "no trajectory"
        raise InputError(f"{path}: {listed}; expected one TUM file (.tum, .txt, .csv), or the name of one (--poses)")
    return found[0]


def _is_trajectory(file: Path) -> bool:
    try:
        return len(read_trajectory(file)) > 0 and not read_table(file).has_title
    except InputError:
        return False


def _stamps(files: Sequence[Path], prior: Trajectory) -> tuple[Array | None, str]:
    """Stamps ``(K,)`` in seconds from the names, and a text on them; None if no number in the names is one.

    A stamp is a number with a decimal point, in seconds; an integer that is a Unix time in s, ms, µs or ns, or in one
    of these units fits the poses; or two integers, Unix seconds and their decimals. The last such number is chosen.
    Date and time count as a Unix time where the poses have such.
    """
    dates = _dates(files)
    if dates is not None and unit_of_stamps(prior.stamp_s) == "s":
        return dates, "stamped by their names (date and time, taken for UTC)"
    numbers = [NUMBER.findall(file.stem)[::-1] for file in files]
    columns = list(zip(*numbers, strict=False))  # the numbers of each place, the last first
    for column, before in zip(columns, [*columns[1:], None], strict=False):
        for stamp_s, units in _readings(column, before, prior):
            step_s = np.diff(np.sort(stamp_s) if "." in column[0] else stamp_s)
            if not len(step_s) or ((step_s >= 0).all() and STEP_S[0] <= np.median(step_s) <= STEP_S[1]):
                return stamp_s, f"stamped by their names ({units})"
    return None, ""


def _dates(files: Sequence[Path]) -> Array | None:
    """Unix times ``(K,)`` of the dates in the names, if all have one, and hardly two the same."""
    parts = [match.groups(default="") for file in files if (match := DATE.search(file.stem))]
    decimals = [each[6] for each in parts]
    if all(decimals) and len({*map(len, decimals)}) == 1 and {*np.diff([*map(int, decimals)])} == {1}:
        decimals = [""] * len(parts)  # they count
    try:
        times = ["{}-{}-{}T{}:{}:{}".format(*each) for each in parts]
        stamp_s = [unix_us(time) / 1e6 + float(f"0.{part or 0}") for time, part in zip(times, decimals, strict=True)]
    except ValueError:
        return None
    return np.array(stamp_s) if len({*stamp_s}) > len(files) / 2 else None


def _readings(column: Sequence[str], before: Sequence[str] | None, prior: Trajectory) -> Iterator[tuple[Array, str]]:
    """What the same number of all names, and the one before it, may mean: stamps in seconds, and their units."""
    if any("." in number for number in column):
        stamp_s, units = _decimals(column)
        is_order = len(prior) == len(column) and not unit_of_stamps(stamp_s) and len(column) > 1
        if not is_order or _overlap(np.sort(stamp_s), prior.stamp_s) > OVERLAP_MIN:
            yield stamp_s, units
        return
    whole = [int(number) for number in column]
    widths = {len(number) for number in column}
    digits = next((each for each in (3, 6, 9) if each >= max(widths)), 0)
    if before and digits and not any("." in number for number in before):
        is_padded, is_count = widths == {digits}, len(whole) > 1 and set(np.diff(whole)) == {1}
        seconds = np.array([float(number) for number in before])
        stamp_s = seconds + np.array(whole) / 10**digits
        is_time = unit_of_stamps(seconds) == "s" or _overlap(stamp_s, prior.stamp_s) > OVERLAP_MIN
        if is_time and not is_count and (is_padded or max(widths) > 6):
            yield stamp_s, f"s and {FRACTIONS[digits]}"
    unix = unit_of_stamps(np.array(whole, dtype=np.float64))
    sure = [unix or "", "ns" if min(widths) >= NS_DIGITS else ""]
    for unit in [unit for unit in sure if unit] + ["ns", "us", "ms"]:
        per_second = round(1 / SECONDS[unit])
        stamp_s = np.array([number // per_second + number % per_second / per_second for number in whole])
        if unit in sure or _overlap(stamp_s, prior.stamp_s) > OVERLAP_MIN:
            yield stamp_s, unit.replace("us", "µs")


def _decimals(column: Sequence[str]) -> tuple[Array, str]:
    """Seconds with decimals. Some programs write nanoseconds after the point without the zeros before them: stamps of
    scans then have even steps if they are read so, and not otherwise."""
    plain, parts = np.array([float(number) for number in column]), [number.partition(".") for number in column]
    longest = max(len(part) for *_, part in parts)
    digits = next((each for each in (3, 6, 9) if each >= longest), 0)
    if not digits or len({len(part) for *_, part in parts}) == 1:
        return plain, "s"
    padded = np.array([int(whole) + int(part or 0) / 10**digits for whole, _, part in parts])
    uneven = [float(np.ptp(np.diff(np.sort(stamp_s)))) for stamp_s in (plain, padded)]
    return (padded, f"s and {FRACTIONS[digits]}") if uneven[1] < 0.5 * uneven[0] else (plain, "s")


def _overlap(one_s: Array, other_s: Array) -> float:
    """Share that two intervals have in common, of the longer one."""
    both = min(one_s[-1], other_s[-1]) - max(one_s[0], other_s[0])
    return float(both / max(np.ptp(one_s), np.ptp(other_s), 1e-9))
