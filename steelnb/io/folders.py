"""Reader of folders of clouds with a trajectory, as other programs write and name them."""

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.files import display_name
from steelnb.io.clouds import READERS, read_points
from steelnb.io.containers import is_bag
from steelnb.io.encodings import foreign_file
from steelnb.io.opened import Opened, Walk
from steelnb.io.stamped_names import NUMBER, stamps_of
from steelnb.io.table_form import read_table
from steelnb.io.trajectories import MAY_BE_W_FIRST, OUT_OF_ORDER, read_trajectory

TRUE = ("groundtruth.tum", "groundtruth.txt", "groundtruth.csv")
OF_KITTI = "as numpy.save writes it of KITTI's numpy.fromfile(FILE, 'f4').reshape(-1, 4)"
ALIKE = "expected names that differ in numbers alone"
TRAJECTORIES = (".tum", ".txt", ".csv")
"""Suffixes of files that may be trajectories."""
COMPRESSED = (".gz", ".bz2", ".xz", ".zst", ".zip", ".7z")
STRAY_SHARE = 0.1
"""Clouds with names of another form are no scans if they are fewer than this share of the scans, or a single one."""


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
    stamp_s, source = stamps_of([file.stem for file in files], prior)
    if stamp_s is not None:
        by_stamp = np.argsort(stamp_s, kind="stable")
        files, stamp_s = [files[k] for k in by_stamp], stamp_s[by_stamp]
    else:
        stamp_s, named, source = prior.stamp_s, source, "in the order of their names"
        if len(prior) != len(files) or skipped[OUT_OF_ORDER]:
            count = skipped.total() - skipped[MAY_BE_W_FIRST]
            but = f" ({count} dropped)" if count else ""
            but = f", {skipped[OUT_OF_ORDER]} of them out of order" if skipped[OUT_OF_ORDER] else but
            beside = f" ({', '.join(file.name for file in strays[:3])} beside them)" if strays else ""
            raise InputError(
                f"{path}: {len(files)} clouds, {named}, and {len(prior)} poses in {trajectory.name}{but}; expected one "
                f"pose per cloud, or stamps in the names, unlike {files[0].name}{beside}"
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
        if any(file.suffix.lower() in suffixes for file in inner.iterdir()) or _texts(inner):
            return f"{wanted}, or the name of a folder in it (--scans {inner.name})"
    if any(folder.glob("*.bin")) or any(folder.glob("*/*.bin")):
        return f"{held}; .bin files do not say what is in them; expected .npy, {OF_KITTI}"
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
    if not files and (texts := _texts(folder)):
        return texts, []
    if not no_tables and max(map(len, forms.values()), default=0) < 2:
        raise InputError(f"{folder}: no clouds in it, but {_other_files(folder, suffixes)}")
    chosen = max(forms.values(), key=len)
    others = [each for each in forms.values() if each is not chosen]
    if len(chosen) == 1:  # the names differ in more than numbers
        chosen, others = no_tables or files, []
        leading = {float(match[0]) for file in chosen if (match := NUMBER.match(file.stem))}
        has_stamps = all("." in "".join(NUMBER.findall(file.stem)) for file in chosen)
        if _by_number(chosen) != sorted(chosen) and len(leading) < len(chosen) and not has_stamps:
            raise InputError(f"{folder}: clouds such as {chosen[0].name} and {chosen[1].name} have no order; {ALIKE}")
    for each in sorted(others, key=len, reverse=True):
        if len(each) > max(1, STRAY_SHARE * len(chosen)) or len(files) > 2 * len(chosen):
            kinds = f"{len(chosen)} clouds such as {chosen[0].name}, and {len(each)} such as {each[0].name}"
            raise InputError(f"{folder}: {kinds}; {ALIKE}, or one kind a folder")
    scans = _by_number(chosen)
    return scans, sorted((set(files) | _alike(folder, scans[0])) - set(scans))


def _alike(folder: Path, scan: Path) -> set[Path]:
    """Clouds that are named as the scans but have another ending, as where half of them are compressed."""
    form = NUMBER.sub("#", scan.stem)
    files = [file for file in folder.glob("[!.]*") if file.suffix.lower() in (*READERS, *COMPRESSED) and "#" in form]
    return {file for file in files if NUMBER.sub("#", file.name.partition(".")[0]) == form and file.is_file()}


def _texts(folder: Path) -> list[Path]:
    """The clouds among text files, sorted by number: those whose names differ in numbers alone, if the first can be
    read as one. Trajectories and notes have this ending, too."""
    forms: dict[str, list[Path]] = {}
    for file in _by_number([file for file in folder.glob("[!.]*") if file.suffix.lower() == ".txt"]):
        if NUMBER.search(file.stem):
            forms.setdefault(NUMBER.sub("#", file.stem), []).append(file)
    found = max(forms.values(), key=len, default=[])
    if len(found) < 2 or _is_trajectory(found[0]):
        return []
    with suppress(InputError):
        read_points(found[0])
        return found
    return []


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
            without = f"clouds without a trajectory, and {', '.join(bags)}"
            raise InputError(f"{path}: {without}; expected one, or the bag itself")
        listed = ", ".join(file.name for file in found) or "no trajectory"
        raise InputError(f"{path}: {listed}; expected one TUM file (.tum, .txt, .csv), or the name of one (--poses)")
    return found[0]


def _is_trajectory(file: Path) -> bool:
    try:
        return len(read_trajectory(file)) > 0 and not read_table(file).has_title
    except InputError:
        return False
