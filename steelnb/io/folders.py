"""Reader of folders of clouds with a trajectory. The numbers in the names of the clouds order them."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name
from steelnb.core.types import Array, Imu, IntArray, Trajectory
from steelnb.io.clouds import READERS, read_points
from steelnb.io.trajectories import IN_ORDER, SECONDS, named_file, read_stamps, read_trajectory, stamps_file
from steelnb.settings import RecordingOptions

NUMBER = re.compile(r"\d+(?:\.\d+)?")
NS_DIGITS = range(16, 20)
"""Numbers of so many digits in names are nanoseconds: since 2001, and before 2286."""
TRAJECTORIES = (".tum", ".txt", ".csv")
"""Suffixes of files that may be trajectories."""
CLOUDS = READERS.keys() - set(TRAJECTORIES)
"""Suffixes of files that are clouds, and nothing else."""
BESIDE = ("groundtruth", "times", "calib")
"""Files of these names beside a trajectory are none: the truth, and those of KITTI."""

Walk = Callable[[IntArray], Iterator[Callable[[], Array]]]
"""Iterator over the decoders of the scans with these increasing numbers."""


class Recorded(NamedTuple):
    """What a reader of recordings gives: the parts of a `Flight`, whose scans are still in their files.

    ``stamp_s (N,)`` of all scans, NaN for those that are not used; ``walk`` over their decoders; poses of the drone;
    ``T_drone_sensor (4, 4)``; the facts for `Flight`; readings of an IMU; and counts of what was skipped."""

    stamp_s: Array
    walk: Walk
    prior: Trajectory
    T_drone_sensor: Array
    facts: dict[str, str]
    imu: Imu | None
    skipped: Counter[str]


def open_folder(path: Path, options: RecordingOptions) -> Recorded:
    """Open a folder of clouds with one trajectory. Points and poses are as the files have them.

    The stamps are numbers in the names, or stated, or those of the poses if there is one pose a cloud. Raises
    `InputError`.
    """
    skipped = Counter[str]()
    folder = path / options.scans if options.scans else path
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected clouds in it (--scans)")
    files, others = _clouds(folder)
    trajectory = _trajectory_file(path, options, files)
    no_columns = options.replace(columns=())
    of_poses, of_clouds = (options, no_columns) if "qx" in options.columns else (no_columns, options)
    prior = read_trajectory(trajectory, of_poses, skipped)
    stamp_s, source = _stamps(path, files, options)
    if stamp_s is None:
        if len(prior) != len(files):
            dropped = f" ({skipped.total()} more dropped)" if skipped.total() else ""
            counts = f"{len(files)} clouds such as {files[0].name}, {len(prior)} poses in {trajectory.name}{dropped}"
            expected = "the unit of the numbers in the names (--stamps us), a file of stamps (--stamps FILE)"
            raise InputError(f"{path}: {counts}; expected {expected}, or one pose a cloud")
        stamp_s = prior.stamp_s
    by_stamp = np.argsort(stamp_s, kind="stable")
    files, stamp_s = [files[k] for k in by_stamp], stamp_s[by_stamp]
    beside = f"; {', '.join(map(display_name, others))} beside them is none" if others else ""
    unit = f", points in {options.unit}" if options.unit else ""
    facts = {
        "scans": f"{len(files)} files {files[0].suffix}{unit}, {source}{beside}",
        "poses": display_name(trajectory),
        "mount": "identity, as the poses are the sensor's: default, --mount states another",
    }
    walk: Walk = lambda number: (partial(read_points, files[k], of_clouds) for k in number.tolist())  # noqa: E731
    return Recorded(stamp_s, walk, prior, np.eye(4), facts, None, skipped)


def _clouds(folder: Path) -> tuple[list[Path], list[Path]]:
    """The scans in a folder, sorted by the numbers in their names, 9 before 10, and the clouds without a number.

    Text files are scans if there are no others. Raises `InputError`.
    """
    held = [file for file in sorted(folder.glob("[!.]*")) if file.is_file() and file.suffix.lower() in READERS]
    files = [file for file in held if file.suffix.lower() in CLOUDS]
    files = files or [file for file in held if NUMBER.search(file.stem)]
    if not files:
        inner = [each.name for each in sorted(folder.iterdir()) if each.is_dir() and not each.name.startswith(".")]
        hint = f", or the name of a folder in it (--scans {inner[0]})" if inner else ""
        binary = "; .bin files do not say what is in them" if any(folder.glob("*.bin")) else ""
        raise InputError(f"{folder}: no clouds in it{binary}; expected files {', '.join(READERS)}{hint}")
    scans = [file for file in files if NUMBER.search(file.stem)] or files
    forms = {NUMBER.sub("#", file.stem) + file.suffix.lower(): file for file in scans}
    if len(forms) > 1:
        first, second, *_ = forms.values()
        kinds = f"clouds such as {first.name} and {second.name}"
        raise InputError(
            f"{folder}: {kinds}; expected names that differ in numbers alone, others in a folder (--scans)"
        )
    scans.sort(key=lambda file: ([float(number) for number in NUMBER.findall(file.stem)], file.stem))
    return scans, [file for file in files if file not in scans]


def _trajectory_file(path: Path, options: RecordingOptions, scans: Sequence[Path]) -> Path:
    """The file of the drone's poses: the one that is named, or the only one in the folder. Raises `InputError`."""
    if options.poses:
        return named_file(path, options.poses)
    files = [file for file in sorted(path.glob("[!.]*")) if file.suffix.lower() in TRAJECTORIES and file.is_file()]
    named = {Path(name).name for name in (options.truth, options.calib, stamps_file(options)) if name}
    found = [file for file in files if file.stem not in BESIDE and file.name not in named and file not in scans]
    if len(found) != 1:
        listed = ", ".join(file.name for file in found) or "no trajectory"
        expected = f"expected one ({', '.join(TRAJECTORIES)}), or its name (--poses FILE)"
        raise InputError(f"{path}: {listed} beside {len(scans)} clouds; {expected}")
    return found[0]


def _stamps(path: Path, files: Sequence[Path], options: RecordingOptions) -> tuple[Array | None, str]:
    """Stamps ``(K,)`` of clouds in seconds, or None if they are those of the poses, and where they are from."""
    if options.stamps == IN_ORDER:
        return None, "one pose each, in order (--stamps)"
    if name := stamps_file(options):
        stamp_s = read_stamps(named_file(path, name))
        if len(stamp_s) != len(files):
            raise InputError(f"{path}: {len(files)} clouds, but {len(stamp_s)} stamps in {name}; expected as many")
        return stamp_s, f"stamps in {display_name(name)} (--stamps)"
    columns = list(zip(*(NUMBER.findall(file.stem) for file in files), strict=True))
    differ = [column for column in columns if len(set(column)) > 1] or columns
    decimal = [column for column in differ if all("." in number for number in column)]
    if len(decimal) == 1:
        return np.array([float(number) for number in decimal[0]]), "seconds in their names"
    long = [column for column in differ if all(len(number) in NS_DIGITS for number in column)]
    unit = options.stamps or ("ns" if len(long) == 1 else None)
    chosen = long if options.stamps is None else differ
    if unit is None:
        return None, "one pose each, in the order of their names (default)"
    if len(chosen) != 1:
        expected = f"expected one, or a file of stamps, one a cloud (--stamps FILE), not {unit}"
        raise InputError(f"{path}: {len(chosen)} numbers in names such as {files[0].name} differ; {expected}")
    per_second = round(1 / SECONDS[unit])
    whole = [int(number) for number in chosen[0]]
    stated = " (--stamps)" if options.stamps else ""
    return np.array([n // per_second + n % per_second / per_second for n in whole]), f"{unit} in their names{stated}"
