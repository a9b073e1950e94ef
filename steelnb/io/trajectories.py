"""Trajectories in TUM's format, and poses between those that were recorded."""

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.files import reading
from steelnb.types import Array, Trajectory

GAP_MAX_S = 0.5, 2.0
"""Poses further apart than this are not interpolated between, since a drone turns and stops within it. The second
number is for poses that come slowly."""


def read_trajectory(path: Path | str, skipped: Counter[str] | None = None) -> Trajectory:
    """Read lines of ``stamp x y z qx qy qz qw``, seconds and metres; lines that begin with ``#`` are comments.

    ``skipped`` counts the poses that were left out. Raises `InputError`.
    """
    with reading(path, "a TUM trajectory (stamp x y z qx qy qz qw)"):
        rows = np.loadtxt(path, ndmin=2)
        if rows.shape[1] != 8:
            raise ValueError(f"{rows.shape[1]} numbers a line")
    return trajectory_of(path, rows, Counter() if skipped is None else skipped)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``stamp x y z qx qy qz qw`` with all digits."""
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    np.savetxt(path, np.column_stack([trajectory.stamp_s, trajectory.position, xyzw]))


def trajectory_of(path: Path | str, rows: Array, skipped: Counter[str]) -> Trajectory:
    """Poses sorted by stamp from ``rows (N, 8)``: stamp, position and quaternion xyzw of any length.

    Left out and counted: numbers that are not finite, quaternions of length zero, repeated stamps. Raises `InputError`
    where no pose is left.
    """
    largest = np.abs(rows[:, 4:]).max(axis=1, initial=0.0)
    good = np.flatnonzero(np.isfinite(rows).all(axis=1) & (largest > 1e-6))
    _, first = np.unique(rows[good, 0], return_index=True)
    chosen = good[first]
    skipped["pose that is not finite, has no direction or another's stamp"] += len(rows) - len(chosen)
    if not len(chosen):
        raise InputError(f"{path}: {len(rows)} poses, none of use; expected finite numbers and unit quaternions")
    T = pose_matrices(np.column_stack([rows[chosen, 1:4], rows[chosen, 4:] / largest[chosen, None]]))
    return Trajectory(rows[chosen, 0], T)


def pose_matrices(rows: Array) -> Array:
    """Transforms ``(N, 4, 4)`` from positions and quaternions xyzw ``(N, 7)``."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]
    return T


def interpolate(trajectory: Trajectory, stamp_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Poses ``(K, 4, 4)`` at ``stamp_s (K,)``, and where ``(K,)`` they are known: in gaps up to two usual intervals,
    within the limits of `GAP_MAX_S`.

    Positions linearly, rotations by slerp; exactly the recorded pose at its own stamp.
    """
    own = trajectory.stamp_s
    gap_max_s = np.clip(2 * np.median(np.diff(own)), *GAP_MAX_S) if len(own) > 1 else GAP_MAX_S[0]
    # Stamps that went through text or integers may miss by rounding.
    after = np.clip(np.searchsorted(own, stamp_s - 1e-6), 0, len(own) - 1)
    exact = np.abs(own[after] - stamp_s) < 1e-6
    before = np.where(exact, after, np.maximum(after - 1, 0))
    covered = exact | ((own[before] <= stamp_s) & (stamp_s <= own[after]) & (own[after] - own[before] <= gap_max_s))
    result = trajectory.between(stamp_s) if len(own) > 1 else np.tile(np.eye(4), (len(stamp_s), 1, 1))
    result[exact] = trajectory.T_world_drone[after[exact]]
    return result, covered
