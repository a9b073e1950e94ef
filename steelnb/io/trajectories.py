"""Trajectories in text files, and their interpolation."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.arguments import checks_arguments
from steelnb.core.checks import COORDINATE_MAX_M, SAME_S
from steelnb.core.errors import InputError
from steelnb.core.files import new_file, reading
from steelnb.core.types import Array, Trajectory
from steelnb.io import kitti, pose_rows
from steelnb.io.clocks import seconds_and_fraction
from steelnb.io.column_names import QUATERNION, ROLES, ROTATIONS, STAMPS, TUM
from steelnb.io.coordinates import check_geocentric
from steelnb.io.table_form import read_table
from steelnb.io.text import Table

GAP_MAX_S = 0.5, 2.0
"""Bounds of the longest gap that is interpolated. A drone may turn and stop in a longer one."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNIX_S, STEP_MAX_S = (9e8, 4.3e9), 2.0
"""Unix times of 1998 to 2106; a longer median interval of poses (nothing is interpolated across it) shows that other
stamps are not seconds, as a median speed above `SPEED_MAX` shows that positions or stamps have another unit."""
QUATERNION_TOLERANCE = 0.05
"""Maximum error of the length of most quaternions, beyond which the numbers are something else."""
MAY_BE_W_FIRST = "trajectory as of EuRoC whose quaternions may begin with w; read as x, y, z, w"
OUT_OF_ORDER = "pose out of order, sorted by its stamp"


@checks_arguments
def read_trajectory(path: Path | str, skipped: Counter[str] | None = None) -> Trajectory:
    """Read the poses of a text file, in metres.

    By the names of its columns, if it has them: a stamp, x, y, z, and qx, qy, qz, qw, or roll, pitch and yaw (turned
    about z, then y, then x) with their unit, or r11, r12, … r33: CSV of other programs, EuRoC. Else lines of ``stamp x
    y z qx qy qz qw`` (TUM), of a stamp and the numbers of ``T_world_drone``, or of the twelve of ``T_world_drone[:3]``
    with the stamps in times.txt beside it (KITTI; with calib.txt, too, they are turned from its camera to its scanner).
    Stamps are seconds, or Unix times in a smaller unit, or in the unit that their name gives.

    Dropped poses are counted in ``skipped``. Raises `InputError`.
    """
    path, skipped = Path(path), Counter() if skipped is None else skipped
    with reading(path, "a TUM trajectory (stamp x y z qx qy qz qw) or one with names of columns"):
        table = read_table(path)
        number = {role: table.find(*patterns) for role, patterns in ROLES.items()}
        is_named = any(k is not None for k in number.values())
        rows, unit = _named(table, number) if is_named else (_unnamed(path, table, skipped), "")
        check_units(rows, unit)
    return trajectory_of(path, rows, skipped)


def unit_of_stamps(stamps: Array) -> str | None:
    """The unit in which these are Unix times of this century: s, ms, us or ns; None for other stamps."""
    typical = float(np.median(np.abs(stamps[np.isfinite(stamps)]))) if np.isfinite(stamps).any() else 0.0
    return next((unit for unit, s in SECONDS.items() if UNIX_S[0] <= typical * s <= UNIX_S[1]), None)


def check_units(rows: Array, unit: str) -> None:
    """Raise ValueError if poses, ``rows (N, 4 or more)`` of stamp and position, are so far apart that their stamps,
    whose ``unit`` is "" if not given, are no seconds, or that their positions are no metres."""
    rows = rows[np.isfinite(rows[:, :4]).all(axis=1)]
    if len(rows) < 2:
        return
    step_s, way_m = np.abs(np.diff(rows[:, 0])), np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1)
    typical_s = float(np.median(step_s))
    if typical_s == 0 and np.median(way_m) > 0:
        count = len(np.unique(rows[:, 0]))
        raise ValueError(f"{len(rows)} poses have {count} stamps; expected one each, written with all their digits")
    if typical_s > STEP_MAX_S and not unit and not unit_of_stamps(rows[:, 0]):
        expected = "expected seconds, or their unit in the column's name (stamp_s, stamp_ns)"
        raise ValueError(f"stamps {typical_s:.4g} s apart; {expected}")
    if np.median(way_m - pose_rows.SPEED_MAX * step_s) > 0 and np.median(way_m) <= COORDINATE_MAX_M:
        expected = "positions in metres, and stamps in seconds or with their unit in the column's name (stamp_ns)"
        raise ValueError(f"poses {np.median(way_m):.4g} m apart after {typical_s:.4g} s; expected {expected}")


def _seconds(stamps: Array, unit: str, table: Table, column: int) -> Array:
    """The ``stamps (N,)`` of a column in seconds; ``unit``: "" if not given."""
    if unit and unit not in SECONDS:
        raise ValueError(f"stamps in {unit}; expected one of {', '.join(SECONDS)}")
    unit = unit or unit_of_stamps(stamps) or "s"
    padded = seconds_and_fraction(table.texts(column)) if unit == "s" and np.isfinite(stamps).all() else None
    return stamps * SECONDS[unit] if padded is None else padded[0]


def _unnamed(path: Path, table: Table, skipped: Counter[str]) -> Array:
    """Rows of ``stamp x y z qx qy qz qw`` from a table without names: TUM, EuRoC, or matrices."""
    if table.has_header:
        raise ValueError(f"columns {', '.join(table.names)[:80]}; expected {', '.join(TUM)}")
    count, other = len(table.own), "without names; expected 8, or 12 with times.txt beside it"
    times = kitti.times_beside(path) if count == 12 else None
    if count not in (8, 12, 13, 17):
        raise ValueError(f"{count} numbers per line, {other}")
    rows = table.values(table.own)
    if count > 8:
        if times is not None:
            if len(rows) != len(stamps := times.values([0])):
                raise ValueError(f"{len(rows)} poses, {len(stamps)} stamps in times.txt; expected as many")
            rows = np.column_stack([stamps, kitti.of_scanner(path, rows)])
        elif count == 17:
            rows = np.column_stack([rows[:, :1], pose_rows.of_transforms(rows[:, 1:])])
        if (xyzw := pose_rows.xyzw_of(rows[:, 1:13], 4)) is None:
            other = "not rotations with translations (KITTI)" if times else other
            raise ValueError(f"{count} numbers per line, {other}")
        stamp_s = _seconds(rows[:, 0], "", times or table, 0 if times else table.own[0])
        return np.column_stack([stamp_s, rows[:, 4:13:4], xyzw])
    is_euroc = table.separator == "," and unit_of_stamps(rows[:, 0]) == "ns" and not table.said
    rows[:, 0] = _seconds(rows[:, 0], "", table, table.own[0])
    orders = [table.said[k : k + 4] for k in range(3, len(table.said)) if table.said[k - 1].endswith("z")]
    is_said = ("qw", "qx", "qy", "qz") in orders and QUATERNION not in orders
    w_first = pose_rows.w_is_first(rows[:, 4:]) if is_euroc else is_said
    skipped[MAY_BE_W_FIRST] += w_first is None
    return rows[:, [0, 1, 2, 3, 5, 6, 7, 4]] if w_first else rows


def _named(table: Table, number: dict[str, int | None]) -> tuple[Array, str]:
    """Rows of ``stamp x y z qx qy qz qw`` from the columns that their names show, in any order; and the unit of the
    stamps, "" if not given."""
    stamp, quaternion = _stamp_columns(table), [number[role] for role in QUATERNION]
    angles = [table.find(rf"(?:.*_)?{name}") for name in ("yaw", "pitch", "roll")]
    turned = quaternion
    if number["qw"] is None and None not in angles:
        turned = angles
    elif number["qw"] is None and {*ROTATIONS} <= {*table.names}:
        turned = [table.find(name) for name in ROTATIONS]
    wanted = {"stamp": stamp[0] if stamp else None} | {axis: number[axis] for axis in "xyz"}
    wanted |= dict(zip(QUATERNION, quaternion, strict=True)) if turned is quaternion else {}
    if missing := [role for role, k in wanted.items() if k is None]:
        none = f"columns {', '.join(table.names)[:120]}, none for {', '.join(missing)}"
        raise ValueError(f"{none}; expected {', '.join(TUM)}")
    position = [k for axis in "xyz" if (k := number[axis]) is not None]
    if other := {table.units[k] for k in position} - {"", "m"}:
        raise ValueError(f"x, y and z in {', '.join(sorted(other))}; expected metres")
    values = table.values([*stamp, *position, *(k for k in turned if k is not None)])
    unit = table.units[stamp[0]]
    stamp_s, values = _seconds(values[:, 0], unit, table, stamp[0]), values[:, 1:]
    if len(stamp) == 2:
        stamp_s, values = stamp_s + values[:, 0] * SECONDS[table.units[stamp[1]]], values[:, 1:]
    xyzw = values[:, 3:]
    if turned is angles:
        units = {table.units[k] for k in angles if k is not None}
        if units not in ({"deg"}, {"rad"}):
            raise ValueError("roll, pitch and yaw without their unit; expected names such as roll_deg or roll_rad")
        xyzw, finite = np.full((len(values), 4), np.nan), np.isfinite(values).all(axis=1)
        xyzw[finite] = Rotation.from_euler("ZYX", values[finite, 3:], degrees=units == {"deg"}).as_quat()
    elif turned is not quaternion:
        if (found := pose_rows.xyzw_of(values[:, 3:], 3)) is None:
            raise ValueError(f"{', '.join(ROTATIONS)} are no rotations; expected a matrix, row by row")
        xyzw = found
    rows = np.column_stack([stamp_s, values[:, :3], xyzw])
    return rows * (1, 1, -1, -1, 1, -1, -1, 1) if _has_z_down(table) else rows, unit


def _has_z_down(table: Table) -> bool:
    """Whether z points down: PX4 says so in pose_frame (1 NED, 2 FRD), and AirSim's recordings always have it so."""
    frame = table.find("pose_frame")
    if frame is not None:
        return bool(np.isin(table.values([frame]), (1, 2)).mean() > 0.5)
    return {"pos_x", "q_w"} <= {*table.names} and not {"imagefile", "vehiclename"}.isdisjoint(table.names)


def _stamp_columns(table: Table) -> list[int]:
    """The column of the stamps, or two: of whole seconds, and of the nanoseconds (or micro-) after them.

    Raises ValueError if several columns of one unit may be stamps.
    """
    for pattern in STAMPS:
        found = [k for k, name in enumerate(table.names) if re.fullmatch(pattern, name)]
        found = [k for k in found if table.names[k] or table.units[k] in SECONDS]
        found.sort(key=lambda k: table.units[k] != "s")
        parts = [k for k in found if table.units[k] in SECONDS and table.units[k] != "s"]
        if len(parts) == 1 and len(found) > 1 and table.units[found[0]] == "s":
            whole, part = (values := table.values([found[0], *parts]))[np.isfinite(values).all(axis=1)].T
            if len(part) and (whole == np.round(whole)).all() and np.median(part) * SECONDS[table.units[parts[0]]] < 1:
                return [found[0], *parts]
        if len({table.units[k] for k in found}) < len(found):
            named = ", ".join(table.names[k] for k in found)
            raise ValueError(f"{len(found)} columns may be stamps: {named}; expected one")
        if found:
            return found[:1]
    return []


@checks_arguments
def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM file: ``stamp x y z qx qy qz qw`` with all digits. Raises `OutputError`; no partial file is left."""
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    with new_file(path) as file:
        np.savetxt(file, np.column_stack([trajectory.stamp_s, trajectory.position, xyzw]))


def trajectory_of(path: Path | str, rows: Array, skipped: Counter[str]) -> Trajectory:
    """Poses sorted by stamp from ``rows (N, 8)``: stamp, position and quaternion xyzw, which is normalised.

    Rows that are no poses (`are_valid`), those with a repeated stamp and those far from the others (`are_far`) are
    dropped and counted in ``skipped``. Raises `InputError` if no pose remains, and if most quaternions are not of unit
    length.
    """
    valid = np.flatnonzero(pose_rows.are_valid(rows))
    skipped[OUT_OF_ORDER] += int((np.diff(rows[valid, 0]) < 0).sum())
    _, first = np.unique(rows[valid, 0], return_index=True)
    chosen = valid[first]
    skipped["pose that is not finite, has no unit quaternion or a repeated stamp"] += len(rows) - len(chosen)
    if not len(chosen):
        parts = [" ".join(f"{number:g}" for number in part) for part in np.split(rows[0, 1:], [3])] if len(rows) else ()
        is_not = ", not x y z {}, qx qy qz qw {}".format(*parts) if parts else ""
        raise InputError(f"{path}: {len(rows)} poses, none valid; expected finite numbers and unit quaternions{is_not}")
    chosen = chosen[~(zeros := pose_rows.are_placeholders(rows[chosen]))]
    skipped["pose at (0, 0, 0) between others, where no drone gets so fast"] += int(zeros.sum())
    check_geocentric(path, rows[chosen, 1:4])
    far = pose_rows.are_far(rows[chosen])
    skipped["pose farther from those before and after than a drone flies"] += int(far.sum())
    chosen = chosen[~far]
    length = np.linalg.norm(rows[chosen, 4:], axis=1)
    if (np.abs(length - 1) > QUATERNION_TOLERANCE).mean() > 0.5:
        typical = float(np.median(length))
        raise InputError(f"{path}: quaternions of length {typical:.3g}; expected {', '.join(QUATERNION)} of length 1")
    largest = np.abs(rows[chosen, 4:]).max(axis=1, keepdims=True)  # results have the rounding of this division
    T = np.tile(np.eye(4), (len(chosen), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[chosen, 4:] / largest).as_matrix(), rows[chosen, 1:4]
    return Trajectory(rows[chosen, 0], T)


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
