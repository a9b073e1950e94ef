"""Trajectories in text files, and their interpolation. Names of columns and options say what the numbers mean."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.checks import COORDINATE_MAX_M, RIGID_TOLERANCE, SAME_S, STAMP_MAX_S, shown
from steelnb.core.errors import InputError
from steelnb.core.files import display_name, new_file, reading
from steelnb.core.types import Array, Trajectory
from steelnb.io.clouds import Table, read_table
from steelnb.settings import RecordingOptions
from steelnb.settings.recording import metres_of

GAP_MAX_S = 0.5, 2.0
"""Bounds of the longest gap that is interpolated. A drone may turn and stop in a longer one."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of stamps, seconds."""
IN_ORDER = "in-order"
QUATERNION_TOLERANCE = 0.05
"""Maximum error of the length of a quaternion, beyond which the numbers are something else."""
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
W_FIRST = (*TUM[:4], "qw", *TUM[4:7])
OTHER_NAMES = {
    **dict.fromkeys(("timestamp", "stamp", "time"), "t"),
    **{name: axis for axis in "xyz" for name in (f"t{axis}", f"p_rs_r_{axis}", f"p{axis}")},
    **{name: f"q{axis}" for axis in "xyzw" for name in (f"q_{axis}", f"q_rs_{axis}")},
}
"""Names of the columns in files of TUM, evo and EuRoC, in small letters, and those of `TUM`."""
NOT_UNIT = "pose that is not finite or has no unit quaternion"
NOT_RISING = "pose whose stamp does not rise"


def read_trajectory(
    path: Path | str,
    options: RecordingOptions | None = None,
    skipped: Counter[str] | None = None,
    **stated: Any,
) -> Trajectory:
    """Read the poses of a text file, in metres.

    TUM: lines of ``stamp x y z qx qy qz qw``. KITTI: lines of the twelve numbers of ``T_world_drone[:3]``, with the
    stamps in times.txt beside it. EuRoC, and other tables: columns named t (timestamp, stamp), x, y, z, qx, qy, qz and
    qw in their first line, in any order, with units in brackets. Stamps are seconds unless a name or an option says
    another unit.

    ``options``, or ``stated`` fields of them: ``columns`` names those of other tables; ``stamps`` is the unit of the
    stamps, a file of them in seconds, or "in-order" for 0, 1, 2, …; ``quaternion`` is the order in TUM files;
    ``calib``, a calib.txt of KITTI, turns the poses of its camera to those of its scanner.

    Dropped poses are counted in ``skipped``. Raises `InputError`.
    """
    path, skipped = Path(path), Counter() if skipped is None else skipped
    options = options or RecordingOptions(**stated)
    with reading(path, "a trajectory"):
        table = read_table(path, options.columns)
        if table.width == 12 and not table.names:
            rows = _kitti_rows(path, table, options)
        else:
            rows = _rows(path, table, options)
    return trajectory_of(path, rows, skipped)


def _rows(path: Path, table: Table, options: RecordingOptions) -> Array:
    """Rows of ``stamp x y z qx qy qz qw`` by the names of the columns, or those of TUM."""
    order = ",".join(TUM)
    is_tum = not table.names and table.width == len(TUM)
    if is_tum:
        table = table._replace(names=W_FIRST if options.quaternion == "wxyz" else TUM, units=[""] * len(TUM))
    if not table.names:
        expected = f"TUM's 8, KITTI's 12, or their names by --columns {order} (in order, _ for one to skip)"
        raise ValueError(f"{table.width} columns without names; expected {expected}")
    roles = [name.lower() for name in table.names]
    if not options.columns:
        roles = [OTHER_NAMES.get(role, role) for role in roles]
    is_beside = options.stamps == IN_ORDER or ("t" not in roles and bool(stamps_file(options)))
    if wrong := [role for role in (TUM[1:] if is_beside else TUM) if roles.count(role) != 1]:
        counted = f"{roles.count(wrong[0])} of them are {wrong[0]}"
        raise ValueError(
            f"columns {shown(', '.join(table.names))}: {counted}; expected --columns {order} (_ for one to skip)"
        )
    columns = [roles.index(role) for role in TUM[1:]]
    values = table.values(columns)
    lengths = {table.units[column] or "m" for column in columns[:3]}
    if len(lengths) > 1:
        raise ValueError(f"x, y and z in {' and '.join(sorted(lengths))}; expected one unit")
    values[:, :3] *= metres_of(lengths.pop())
    if is_beside:
        return np.column_stack([_stamps_beside(path, options, len(values)), values])
    column = roles.index("t")
    stamps, unit = table.values([column])[:, 0], table.units[column]
    if is_tum and table.separator != " " and (np.abs(stamps) > STAMP_MAX_S).any():
        expected = f"--columns {order}, or qw before qx as of EuRoC, and --stamps ns"
        raise ValueError(f"8 columns without names, and stamps such as {stamps[0]:.0f}; expected {expected}")
    if options.stamps in SECONDS and ("." not in table.first_cells[column] or (np.abs(stamps) > STAMP_MAX_S).any()):
        unit = str(options.stamps)
    return np.column_stack([_seconds(stamps, unit, table.names[column]), values])


def stamps_file(options: RecordingOptions) -> str:
    """The file of stamps that ``stamps`` names, or ""."""
    return "" if options.stamps in (None, IN_ORDER, *SECONDS) else str(options.stamps)


def _seconds(stamps: Array, unit: str, name: str) -> Array:
    """Stamps ``(N,)`` in seconds from a column; ``unit``: "" if not given. Raises ValueError."""
    if unit not in ("", *SECONDS):
        raise ValueError(f"{name} in {unit}; expected one of {', '.join(SECONDS)} (--stamps)")
    if not unit and len(late := stamps[np.abs(stamps) > STAMP_MAX_S]):
        raise ValueError(f"stamps such as {late[0]:.0f}, which are no seconds; expected their unit, as --stamps us")
    seconds: Array = stamps * SECONDS[unit or "s"]
    return seconds


def _stamps_beside(path: Path, options: RecordingOptions, count: int) -> Array:
    """Stamps of ``count`` poses that are not in their file: in order, in the file that is named, or in times.txt."""
    if options.stamps == IN_ORDER:
        return np.arange(float(count))
    named = stamps_file(options)
    beside = named_file(path.parent, named) if named else path.with_name("times.txt")
    if not beside.is_file():
        raise ValueError(f"{count} poses without stamps; expected times.txt beside it, or --stamps FILE or {IN_ORDER}")
    stamp_s = read_stamps(beside)
    if len(stamp_s) != count:
        raise ValueError(f"{count} poses, but {len(stamp_s)} stamps in {display_name(beside)}; expected as many")
    return stamp_s


def read_stamps(path: Path) -> Array:
    """Stamps ``(N,)`` in seconds of a file with one a line. Raises `InputError`."""
    with reading(path, "a file of stamps"):
        values = np.loadtxt(path, ndmin=2, encoding="utf-8-sig")
        if values.shape[1] != 1:
            raise ValueError(f"{values.shape[1]} numbers a line; expected one, the stamp in seconds")
        return _seconds(values[:, 0], "", "stamps")


def named_file(folder: Path, name: str) -> Path:
    """A file by its name, relative to the working directory or to a ``folder``. Raises `InputError`."""
    for file in (Path(name), folder / name):
        if file.is_file():
            return file
    raise InputError(f"{name}: no such file, here or in {folder}")


def _kitti_rows(path: Path, table: Table, options: RecordingOptions) -> Array:
    """Rows of ``stamp x y z qx qy qz qw`` from lines of ``T[:3]``."""
    T = np.tile(np.eye(4), (len(numbers := table.values(range(12))), 1, 1))
    T[:, :3] = numbers.reshape(-1, 3, 4)
    R = T[:, :3, :3]
    finite = np.isfinite(R).all(axis=(1, 2))
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    if not (error[finite] <= 10 * RIGID_TOLERANCE).all() or (np.linalg.det(R[finite]) < 0).any():
        raise ValueError("12 numbers a line that are no rotations with translations (KITTI); expected --columns")
    if options.calib:
        T_camera_scanner = _calib(named_file(path.parent, options.calib))
        T = np.linalg.inv(T_camera_scanner) @ T @ T_camera_scanner
    xyzw = np.full((len(T), 4), np.nan)
    xyzw[finite] = Rotation.from_matrix(T[finite, :3, :3]).as_quat()
    if options.stamps in SECONDS:
        raise ValueError(f"poses without stamps, and --stamps {options.stamps}; expected a file of them, or {IN_ORDER}")
    return np.column_stack([_stamps_beside(path, options, len(T)), T[:, :3, 3], xyzw])


def _calib(path: Path) -> Array:
    """``T_camera_scanner (4, 4)`` of KITTI's calib.txt. Raises `InputError`."""
    with reading(path, "KITTI's calib.txt"):
        lines = dict(line.split(":", 1) for line in path.read_text("utf-8").splitlines() if ":" in line)
        numbers = lines.get("Tr", lines.get("Tr_velo_to_cam", "")).split()
        if len(numbers) != 12:
            raise ValueError(f"{len(numbers)} numbers after Tr; expected 12")
        T = np.eye(4)
        T[:3] = np.array(numbers, dtype=float).reshape(3, 4)
        return T


def trajectory_of(path: Path | str, rows: Array, skipped: Counter[str]) -> Trajectory:
    """Poses of rising stamps from ``rows (N, 8)``: stamp, position and quaternion xyzw, which is normalised.

    Rows that are not finite or have no unit quaternion, and those whose stamp does not rise, are dropped and counted in
    ``skipped``. Raises `InputError` if no pose remains, and if most quaternions are not of unit length.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(rows[:, 4:], axis=1)
        valid = np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 1:4]).max(axis=1, initial=0.0) <= COORDINATE_MAX_M)
        is_unit = np.abs(length - 1) <= QUATERNION_TOLERANCE
    if is_unit[valid].sum() * 2 < valid.sum():
        typical, expected = np.median(length[valid]), "qx, qy, qz and qw of length 1"
        raise InputError(f"{path}: quaternions of length {typical:.3g}; expected {expected}")
    count = len(rows)
    skipped[NOT_UNIT] += count - int((valid & is_unit).sum())
    rows = rows[valid & is_unit]
    rises = np.diff(np.maximum.accumulate(rows[:, 0]), prepend=-np.inf) > 0
    skipped[NOT_RISING] += len(rows) - int(rises.sum())
    rows = rows[rises]
    if not len(rows):
        raise InputError(f"{path}: {count} poses, none valid; expected finite numbers and unit quaternions")
    largest = np.abs(rows[:, 4:]).max(axis=1, keepdims=True)  # results have the rounding of this division
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:] / largest).as_matrix(), rows[:, 1:4]
    return Trajectory(rows[:, 0], T)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM file: ``stamp x y z qx qy qz qw`` with all digits. Raises `OutputError`; no partial file is left."""
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    with new_file(path) as file:
        np.savetxt(file, np.column_stack([trajectory.stamp_s, trajectory.position, xyzw]))


def interpolate(trajectory: Trajectory, stamp_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Poses ``(K, 4, 4)`` at ``stamp_s (K,)``, and whether each is covered ``(K,)``.

    Positions are interpolated linearly, rotations by slerp. A recorded stamp gives exactly the recorded pose. Gaps of
    up to two median intervals, within the bounds of `GAP_MAX_S`, are covered.
    """
    recorded_s = trajectory.stamp_s
    gap_max_s = np.clip(2 * np.median(np.diff(recorded_s)), *GAP_MAX_S) if len(recorded_s) > 1 else GAP_MAX_S[0]
    # Stamps converted to text or integers may differ by rounding.
    after = np.clip(np.searchsorted(recorded_s, stamp_s - SAME_S), 0, len(recorded_s) - 1)
    exact = np.abs(recorded_s[after] - stamp_s) < SAME_S
    before = np.where(exact, after, np.maximum(after - 1, 0))
    covered = exact | (
        (recorded_s[before] <= stamp_s)
        & (stamp_s <= recorded_s[after])
        & (recorded_s[after] - recorded_s[before] <= gap_max_s)
    )
    result = trajectory.between(stamp_s) if len(recorded_s) > 1 else np.tile(np.eye(4), (len(stamp_s), 1, 1))
    result[exact] = trajectory.T_world_drone[after[exact]]
    return result, covered
