"""Trajectories as text: TUM, KITTI and EuRoC files ↔ `Trajectory`.

evo reads and writes TUM and KITTI, since its files are what others expect; but it refuses a second blank without
naming the line, so what it gets to read has been checked here. EuRoC's stamps, 19 digits of nanoseconds, are read here:
evo takes them for floating point numbers, which leaves 0.1 µs.
"""

import io
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array, Trajectory
from steelnb.errors import FileContentError, OutputError, RecordingError
from steelnb.recordings.segments import new_folder
from steelnb.recordings.stamps import NANO, nanoseconds, read_stamps, stamps_beside, text_lines

QUATERNION_MIN = 1e-6
"""Shorter ones have no direction."""
ROTATION_TOLERANCE = 0.01
"""Of the columns of a KITTI rotation: further from unit length or from right angles, it is none."""
EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)  # fmt: skip


class Form(NamedTuple):
    """One line of a form: ``separator`` None means blanks; ``least`` and ``most`` numbers."""

    name: str
    separator: str | None
    least: int
    most: int
    says: str


TUM = Form("TUM", None, 8, 8, "8 numbers: stamp tx ty tz qx qy qz qw")
KITTI = Form("KITTI", None, 12, 12, "12 numbers: the first three rows of a pose")
EUROC = Form("EuRoC", ",", 8, 10**3, "a stamp in whole nanoseconds, then x, y, z, qw, qx, qy, qz, with commas")


class Row(NamedTuple):
    """A checked line of a file: its number and its words, all of them numbers."""

    number: int
    words: list[str]


def read_trajectory(path: Path | str, skipped: Counter[str] | None = None, rate_hz: float | None = None) -> Trajectory:
    """Read a TUM, KITTI or EuRoC file; its first line of numbers tells which.

    ``skipped`` counts what was left out (`trajectory_of`). KITTI files hold no stamps: see `read_kitti`. Raises
    `FileMissingError`, `FileContentError` with the number and the text of the first bad line, and `RecordingError`
    where no pose is left.
    """
    path = Path(path)
    form = form_of(path)
    if form is None:
        raise FileContentError(f"{path}: no line with a pose; expected {TUM.says}; or {KITTI.says}; or {EUROC.says}")
    if form is KITTI:
        return read_kitti(path, skipped, rate_hz=rate_hz)
    return (read_tum if form is TUM else read_euroc)(path, skipped)


def form_of(path: Path) -> Form | None:
    """What a file's first line of numbers looks like; None where it looks like no pose."""
    for _, line in text_lines(path):
        if not _is_number(line.replace(",", " ").split()[0:1]):
            continue  # a header
        for form in (EUROC, TUM, KITTI):
            words = _split(line, form)
            if form.least <= len(words) <= form.most and _is_number(words):
                return form
        return None
    return None


def read_tum(path: Path | str, skipped: Counter[str] | None = None) -> Trajectory:
    """Read lines of ``stamp tx ty tz qx qy qz qw``; raises as `read_trajectory`."""
    from evo.tools.file_interface import read_tum_trajectory_file

    path = Path(path)
    poses = read_tum_trajectory_file(_clean(_rows(path, TUM), " "))
    quaternion = np.roll(poses.orientations_quat_wxyz, -1, axis=1)
    return trajectory_of(path, poses.timestamps, poses.positions_xyz, quaternion, skipped)


def read_euroc(path: Path | str, skipped: Counter[str] | None = None) -> Trajectory:
    """Read lines of ``ns,x,y,z,qw,qx,qy,qz,...``; what follows (velocities, biases) is ignored.

    Raises as `read_trajectory`.
    """
    from evo.tools.file_interface import read_euroc_csv_trajectory

    path = Path(path)
    rows = [Row(number, words[:8]) for number, words in _rows(path, EUROC)]
    for number, words in rows:
        if not words[0].lstrip("+-").isdigit() or len(words[0]) > 20:
            raise _bad(path, number, ",".join(words), EUROC)
    poses = read_euroc_csv_trajectory(_clean(rows, ","))
    stamp_s = np.array([int(words[0]) / NANO for _, words in rows])
    quaternion = np.roll(poses.orientations_quat_wxyz, -1, axis=1)
    return trajectory_of(path, stamp_s, poses.positions_xyz, quaternion, skipped)


def read_kitti(
    path: Path | str,
    skipped: Counter[str] | None = None,
    times: Path | Array | None = None,
    rate_hz: float | None = None,
) -> Trajectory:
    """Read lines of 12 numbers, the first three rows of a pose in KITTI's order.

    The stamps come from ``times`` (a file, or seconds), from a file of stamps in the same folder, or from ``rate_hz``,
    in this order; as many as poses. The poses are taken as they are: those of KITTI's own files are of its camera.
    Matrices that are no rotations are left out and counted. Raises as `read_trajectory`, and `RecordingError` where
    there are no stamps.
    """
    from evo.tools.file_interface import read_kitti_poses_file

    path = Path(path)
    T = np.array(read_kitti_poses_file(_clean(_rows(path, KITTI), " ")).poses_se3)
    times = stamps_beside(path) if times is None else times
    if times is not None:
        stamp_s = read_stamps(times) if isinstance(times, Path) else times
        if len(stamp_s) != len(T):
            where = times if isinstance(times, Path) else path
            raise RecordingError(f"{where}: {len(stamp_s)} stamps; expected the {len(T)} of the poses in {path.name}")
    elif rate_hz is not None:
        stamp_s = np.arange(len(T)) / rate_hz
    else:
        raise RecordingError(f"{path}: KITTI poses hold no stamps; expected times.txt beside them, or a rate")
    return trajectory_of_matrices(path, stamp_s, T, skipped)


def trajectory_of_matrices(
    path: Path, stamp_s: Array, T_world_drone: Array, skipped: Counter[str] | None = None
) -> Trajectory:
    """As `trajectory_of`, from ``T_world_drone (N, 4, 4)``; those that are no rotations are left out and counted."""
    R = T_world_drone[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rotates = (off < ROTATION_TOLERANCE) & (np.linalg.det(np.where(np.isfinite(R), R, 0.0)) > 0)
    quaternion = np.full((len(R), 4), np.nan)
    quaternion[rotates] = Rotation.from_matrix(R[rotates]).as_quat()
    none = ~rotates & np.isfinite(R).all(axis=(1, 2))
    if skipped is not None:
        _count(skipped, "pose whose matrix is no rotation", none)
    return trajectory_of(path, stamp_s[~none], T_world_drone[~none, :3, 3], quaternion[~none], skipped)


def trajectory_of(
    path: Path, stamp_s: Array, position: Array, quaternion_xyzw: Array, skipped: Counter[str] | None = None
) -> Trajectory:
    """Poses in the order of their stamps: ``stamp_s (N,)``, ``position (N, 3)``, ``quaternion_xyzw (N, 4)``.

    Poses with a number that is not finite, with a quaternion of length zero, or with the stamp of an earlier one are
    left out, and counted in ``skipped`` by reason; other quaternions are normalised. Those out of order are sorted,
    and counted. Raises `RecordingError` where none is left.
    """
    skipped = Counter() if skipped is None else skipped
    numbers = np.column_stack([stamp_s, position, quaternion_xyzw])
    finite = np.asarray(np.isfinite(numbers).all(axis=1))
    largest = np.abs(np.where(finite[:, None], quaternion_xyzw, 0.0)).max(axis=1, initial=0.0)
    turns = largest > QUATERNION_MIN
    _count(skipped, "pose not finite", ~finite)
    _count(skipped, "pose with a quaternion of length zero", finite & ~turns)
    good = np.flatnonzero(finite & turns)
    _count(skipped, "pose out of order, sorted", np.diff(stamp_s[good]) < 0)
    good = good[np.argsort(stamp_s[good], kind="stable")]
    again = np.zeros(len(good), dtype=np.bool_)
    again[1:] = np.diff(stamp_s[good]) <= 0
    _count(skipped, "pose with a stamp that another has", again)
    good = good[~again]
    if not len(good):
        raise RecordingError(f"{path}: {len(numbers)} poses, none of use; expected finite numbers and unit quaternions")
    T_world_drone = np.tile(np.eye(4), (len(good), 1, 1))
    T_world_drone[:, :3, :3] = Rotation.from_quat(quaternion_xyzw[good] / largest[good, None]).as_matrix()
    T_world_drone[:, :3, 3] = position[good]
    return Trajectory(np.ascontiguousarray(stamp_s[good]), T_world_drone)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``stamp tx ty tz qx qy qz qw`` with all digits. Raises `OutputError`; nothing half-written stays."""
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools.file_interface import write_tum_trajectory_file

    poses = PoseTrajectory3D(trajectory.position, _wxyz(trajectory), timestamps=trajectory.stamp_s)
    _write(Path(path), lambda file: write_tum_trajectory_file(str(file), poses))


def write_kitti(path: Path | str, trajectory: Trajectory, times: Path | str | None = None) -> None:
    """Write 12 numbers a line; and the stamps to ``times``, by default ``times.txt`` beside. Raises `OutputError`."""
    from evo.core.trajectory import PosePath3D
    from evo.tools.file_interface import write_kitti_poses_file

    path = Path(path)
    poses = PosePath3D(poses_se3=list(trajectory.T_world_drone))
    _write(path, lambda file: write_kitti_poses_file(str(file), poses))
    stamps = "".join(f"{stamp!r}\n" for stamp in trajectory.stamp_s.tolist())
    _write(Path(times) if times else path.with_name("times.txt"), lambda file: file.write_text(stamps))


def write_euroc(path: Path | str, trajectory: Trajectory) -> None:
    """Write a csv file of nanoseconds, positions and quaternions, w first. Raises `OutputError`."""
    numbers = np.column_stack([trajectory.position, _wxyz(trajectory)]).tolist()
    lines = [
        ",".join([str(nanoseconds(stamp)), *map(repr, row)])
        for stamp, row in zip(trajectory.stamp_s.tolist(), numbers, strict=True)
    ]
    text = "\n".join([EUROC_HEADER, *lines, ""])
    _write(Path(path), lambda file: file.write_text(text))


def _wxyz(trajectory: Trajectory) -> Array:
    quaternion = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    return np.asarray(np.roll(quaternion, 1, axis=1))


def _write(path: Path, write: Callable[[Path], object]) -> None:
    if path.is_dir():
        raise OutputError(f"{path}: cannot be written: a folder; expected a file")
    with new_folder(path.parent) as folder:
        write(folder / path.name)


def _count(skipped: Counter[str], reason: str, which: NDArray[np.bool_]) -> None:
    if number := int(np.count_nonzero(which)):
        skipped[reason] += number


def _rows(path: Path, form: Form) -> list[Row]:
    """All lines of a file but comments, blank ones and a header; refuses the first that is none of ``form``."""
    rows: list[Row] = []
    for number, line in text_lines(path):
        words = _split(line, form)
        if form.least <= len(words) <= form.most and _is_number(words[: form.least]):
            rows.append(Row(number, words))
        elif rows or form is not EUROC or _is_number(words[:1]):
            raise _bad(path, number, line, form)
    if not rows:
        raise FileContentError(f"{path}: no line with a pose; expected {form.says}")
    return rows


def _split(line: str, form: Form) -> list[str]:
    words = [word.strip() for word in line.split(form.separator)]
    return words[:-1] if words and not words[-1] else words  # some programs end their lines with a comma


def _is_number(words: Sequence[str]) -> bool:
    try:
        return all(word.isascii() and "_" not in word and float(word) is not None for word in words) and bool(words)
    except ValueError:
        return False


def _clean(rows: Sequence[Row], separator: str) -> io.StringIO:
    return io.StringIO("\n".join(separator.join(words) for _, words in rows))


def _bad(path: Path, number: int, line: str, form: Form) -> FileContentError:
    shown = line if len(line) <= 60 else f"{line[:57]}..."
    return FileContentError(f"{path}, line {number}: {shown!r}; expected {form.name}'s {form.says}")
