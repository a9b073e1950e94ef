"""Trajectory files (TUM, KITTI, EuRoC) and stamps in text files and file names. NumPy reads the numbers, evo writes."""

import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import dropwhile, islice
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.errors import FileContentError, RecordingError, SteelnbError, needs
from steelnb.files import new_file, open_lines, reading
from steelnb.fusion.uncertainty import POSE_AXES, check_covariances
from steelnb.io.clouds import FARTHEST_M
from steelnb.types import Array, Trajectory

QUATERNION_MIN = 1e-6
"""Length below which a quaternion has no direction."""
ROTATION_TOLERANCE = 0.01
"""Largest element of R Rᵀ − I of a rotation matrix."""
FORMS = (
    "TUM's 8 numbers (stamp tx ty tz qx qy qz qw), KITTI's 12 (the first three rows of a pose), or EuRoC's with commas "
    "(whole nanoseconds, x, y, z, qw, qx, qy, qz)"
)
STAMP_FILES = ("timestamps.txt", "times.txt", "stamps.csv")
_BEGINS = re.compile(r"\s*([-+.\d]|nan)", re.IGNORECASE)
_IN_NAME = re.compile(r"\d+(?:\.\d+)?", re.ASCII)
_UNITS = ((10**17, 10**9), (10**14, 10**6), (10**11, 10**3))
"""From these whole numbers on, a stamp is in parts of a second: seconds since 1970 have ten digits."""


def read_trajectory(path: Path | str, skipped: Counter[str] | None = None, stamp_s: Array | None = None) -> Trajectory:
    """Read a TUM, KITTI or EuRoC file; the number of columns, and commas between them, tell which.

    Parameters
    ----------
    skipped : counts the poses left out, by reason (`trajectory_of`).
    stamp_s : ``(N,)``, of KITTI poses without a file of stamps (``times.txt``) beside them.

    Raises `FileMissingError`, `FileContentError`, and `RecordingError` where no pose is left or KITTI poses have no
    stamps.
    """
    path, skipped = Path(path), Counter() if skipped is None else skipped
    with reading(path, "a trajectory"):
        form, numbers = _numbers(path)
        if form == "EuRoC":
            return trajectory_of(path, numbers[:, 0] / 1e9, numbers[:, 1:4], numbers[:, [5, 6, 7, 4]], skipped)
        if form == "TUM":
            return trajectory_of(path, numbers[:, 0], numbers[:, 1:4], numbers[:, 4:], skipped)
    beside = stamps_beside(path)
    if beside is not None:
        stamp_s = np.array([stamp for stamp, _ in read_stamps(beside)])
    if stamp_s is None:
        raise RecordingError(f"{path}: KITTI poses hold no stamps; expected times.txt beside them")
    if len(stamp_s) != len(numbers):
        raise RecordingError(f"{beside or path}: {len(stamp_s)} stamps; expected {len(numbers)}, one a pose")
    T_world_drone = np.tile(np.eye(4), (len(numbers), 1, 1))
    T_world_drone[:, :3] = numbers.reshape(-1, 3, 4)
    return trajectory_of_matrices(path, stamp_s, T_world_drone, skipped)


def holds_poses(path: Path) -> bool:
    """Whether the first line of numbers of a text file is a pose."""
    try:
        with reading(path, "a trajectory"):
            return bool(_numbers(path, 1))
    except SteelnbError:
        return False


def trajectory_of(
    path: Path, stamp_s: Array, position: Array, quaternion_xyzw: Array, skipped: Counter[str]
) -> Trajectory:
    """Poses sorted by stamp, from ``stamp_s (N,)``, ``position (N, 3)`` and ``quaternion_xyzw (N, 4)`` of any length.

    Left out and counted: numbers not finite, quaternions of length zero, repeated stamps. Raises `RecordingError` where
    no pose is left.
    """
    numbers = np.column_stack([stamp_s, position, quaternion_xyzw])
    finite = np.asarray(np.isfinite(numbers).all(axis=1))
    largest = np.abs(np.where(finite[:, None], quaternion_xyzw, 0.0)).max(axis=1, initial=0.0)
    turns = largest > QUATERNION_MIN
    count(skipped, "pose not finite", ~finite)
    with np.errstate(invalid="ignore"):
        near = (np.abs(position) <= FARTHEST_M).all(axis=1)
    count(skipped, f"pose farther than {FARTHEST_M:.0e} m", finite & ~near)
    finite &= near
    count(skipped, "pose with a quaternion of length zero", finite & ~turns)
    good = np.flatnonzero(finite & turns)
    count(skipped, "pose out of order, sorted", np.diff(stamp_s[good]) < 0)
    good = good[np.argsort(stamp_s[good], kind="stable")]
    repeated = np.diff(stamp_s[good], prepend=-np.inf) <= 0
    count(skipped, "pose with a stamp that another has", repeated)
    good = good[~repeated]
    if not len(good):
        raise RecordingError(f"{path}: {len(numbers)} poses, none of use; expected finite numbers and unit quaternions")
    T_world_drone = matrices(position[good], quaternion_xyzw[good] / largest[good, None])
    return Trajectory(np.ascontiguousarray(stamp_s[good]), T_world_drone)


def matrices(position: Array, quaternion_xyzw: Array) -> Array:
    """Transforms ``(N, 4, 4)`` from positions ``(N, 3)`` and quaternions ``(N, 4)``."""
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(quaternion_xyzw).as_matrix(), position
    return T


def trajectory_of_matrices(path: Path, stamp_s: Array, T_world_drone: Array, skipped: Counter[str]) -> Trajectory:
    """`trajectory_of` for ``T_world_drone (N, 4, 4)``; matrices that are no rotations are left out and counted."""
    R = T_world_drone[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rotates = (off < ROTATION_TOLERANCE) & (np.linalg.det(np.where(np.isfinite(R), R, 0.0)) > 0)
    quaternion = np.full((len(R), 4), np.nan)
    quaternion[rotates] = Rotation.from_matrix(R[rotates]).as_quat()
    none = ~rotates & np.isfinite(R).all(axis=(1, 2))
    count(skipped, "pose whose matrix is no rotation", none)
    return trajectory_of(path, stamp_s[~none], T_world_drone[~none, :3, 3], quaternion[~none], skipped)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``stamp tx ty tz qx qy qz qw`` with all digits. Raises `OutputError`; nothing half-written stays."""
    with needs("io"):
        from evo.core.trajectory import PoseTrajectory3D
        from evo.tools.file_interface import write_tum_trajectory_file

    path = Path(path)
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    poses = PoseTrajectory3D(trajectory.position, np.roll(xyzw, 1, axis=1), timestamps=trajectory.stamp_s)
    with new_file(path) as file:
        write_tum_trajectory_file(file, poses)


def write_sigma(path: Path | str, stamp_s: Array, covariance: Array) -> None:
    """Write the standard deviations of poses, CSV: ``stamp_s``, ``sigma_x_m`` … ``sigma_yaw_deg``, a row a pose.

    ``covariance (K, 6, 6)`` as `Estimate.pose_covariance`; the first pose has zeros, since it defines the world. Raises
    `SingularError` for one that is not finite or not positive definite; nothing half-written stays.
    """
    check_covariances(covariance[1:], "pose", POSE_AXES, first=1)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    sigma = np.column_stack([sigma[:, :3], np.degrees(sigma[:, 3:])])
    names = [f"sigma_{axis}_{'m' if k < 3 else 'deg'}" for k, axis in enumerate(POSE_AXES)]
    table = pd.DataFrame(sigma, columns=names).round(6)
    table.insert(0, "stamp_s", stamp_s)
    with new_file(path) as file:
        table.to_csv(file, index=False, lineterminator="\n")


def _numbers(path: Path, rows: int | None = None) -> tuple[str, Array]:
    """The form of a trajectory file and its numbers, a row a pose. Raises `FileContentError`, ValueError."""
    lines = list(islice(_lines(path), rows))
    if not lines:
        raise FileContentError(f"{path}: no line with a pose; expected {FORMS}")
    commas = "," in lines[0]
    numbers = np.loadtxt((line.replace(",", " ") for line in lines), ndmin=2)
    columns = numbers.shape[1]
    form = "EuRoC" if commas and columns >= 8 else {8: "TUM", 12: "KITTI"}.get(columns)
    if form is None or (form == "EuRoC" and (numbers[:, 0] != np.floor(numbers[:, 0])).any()):
        raise FileContentError(f"{path}: {lines[0].strip()[:60]!r}; expected {FORMS}")
    return form, numbers


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file from the first number on; bytes that are no UTF-8 are replaced."""
    with io.TextIOWrapper(open_lines(path), "utf-8-sig", "replace") as file:
        lines = dropwhile(lambda line: not _BEGINS.match(line), file)
        yield from (line for line in lines if line.strip() and not line.startswith("#"))


def seconds(word: str) -> float:
    """A stamp from a word: seconds, or whole milli-, micro- or nanoseconds since 1970. Raises ValueError."""
    if not word.isdecimal():
        return float(word)
    whole = int(word)
    return whole / next((parts for least, parts in _UNITS if whole >= least), 1)


def read_stamps(path: Path) -> list[tuple[float, str]]:
    """Stamp and rest of each line, as in TUM's ``depth.txt``. Raises `FileMissingError` and `FileContentError`."""
    with reading(path, "a file of stamps"):
        words = [re.split(r"[\s,]+", line.strip(), maxsplit=1) for line in _lines(path)]
        return [(seconds(stamp), "".join(rest)) for stamp, *rest in words]


def stamps_of_names(names: Sequence[str]) -> Array | None:
    """Stamps ``(N,)``, the last number in each name, or None where these only count the files.

    A stamp has a decimal point or ten to twenty digits.
    """
    words = [found[-1] if (found := _IN_NAME.findall(name)) else "" for name in names]
    if not words or not all("." in word or 10 <= len(word.lstrip("0")) <= 20 for word in words):
        return None
    return np.array([seconds(word) for word in words])


def stamps_beside(path: Path) -> Path | None:
    """The file of stamps in a folder, or in the folder of a file; None without one."""
    folder = path if path.is_dir() else path.parent
    return next((folder / name for name in STAMP_FILES if (folder / name).is_file() and folder / name != path), None)


def rising(stamp_s: Array, skipped: Counter[str], prefix: str = "") -> NDArray[np.bool_]:
    """Which stamps ``(N,)`` are finite and later than all before them; ``skipped`` counts the others by reason."""
    finite = np.isfinite(stamp_s)
    latest = np.maximum.accumulate(np.where(finite, stamp_s, -np.inf))
    before = np.concatenate([[-np.inf], latest[:-1]])
    count(skipped, f"{prefix}stamp not finite", ~finite)
    count(skipped, f"{prefix}duplicate stamp", finite & (stamp_s == before))
    count(skipped, f"{prefix}time ran backwards", finite & (stamp_s < before))
    return np.asarray(finite & (stamp_s > before))


def count(skipped: Counter[str], reason: str, which: NDArray[np.bool_]) -> None:
    """Add the number of True in ``which`` to a reason, if there is any."""
    if number := int(np.count_nonzero(which)):
        skipped[reason] += number
