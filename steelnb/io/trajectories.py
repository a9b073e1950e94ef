"""Trajectories in the TUM format, and their interpolation."""

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.types import Array, Trajectory

GAP_MAX_S = 0.5, 2.0
"""Bounds of the longest gap that is interpolated. A drone may turn and stop in a longer one."""


def read_trajectory(path: Path | str, skipped: Counter[str] | None = None) -> Trajectory:
    """Read a TUM file: lines of ``stamp x y z qx qy qz qw``, seconds and metres; ``#`` starts a comment.

    Dropped poses are counted in ``skipped``. Raises `InputError`.
    """
    with reading(path, "a TUM trajectory (stamp x y z qx qy qz qw)"):
        rows = np.loadtxt(path, ndmin=2)
        if rows.shape[1] != 8:
            raise ValueError(f"{rows.shape[1]} numbers per line")
    return trajectory_of(path, rows, Counter() if skipped is None else skipped)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM file: ``stamp x y z qx qy qz qw`` with all digits."""
    xyzw = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3]).as_quat(canonical=True)
    np.savetxt(path, np.column_stack([trajectory.stamp_s, trajectory.position, xyzw]))


def trajectory_of(path: Path | str, rows: Array, skipped: Counter[str]) -> Trajectory:
    """Poses sorted by stamp from ``rows (N, 8)``: stamp, position and quaternion xyzw, not necessarily unit.

    Rows with numbers that are not finite, zero quaternions and repeated stamps are dropped and counted in ``skipped``.
    Raises `InputError` if no pose remains.
    """
    largest = np.abs(rows[:, 4:]).max(axis=1, initial=0.0)
    valid = np.flatnonzero(np.isfinite(rows).all(axis=1) & (largest > 1e-6))
    _, first = np.unique(rows[valid, 0], return_index=True)
    chosen = valid[first]
    skipped["pose that is not finite, has a zero quaternion or a repeated stamp"] += len(rows) - len(chosen)
    if not len(chosen):
        raise InputError(f"{path}: {len(rows)} poses, none valid; expected finite numbers and unit quaternions")
    T = pose_matrices(np.column_stack([rows[chosen, 1:4], rows[chosen, 4:] / largest[chosen, None]]))
    return Trajectory(rows[chosen, 0], T)


def pose_matrices(rows: Array) -> Array:
    """Transforms ``(N, 4, 4)`` from positions and quaternions xyzw ``(N, 7)``."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]
    return T


def interpolate(trajectory: Trajectory, stamp_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Poses ``(K, 4, 4)`` at ``stamp_s (K,)``, and whether each is covered ``(K,)``.

    Positions are interpolated linearly, rotations by slerp. A recorded stamp gives exactly the recorded pose. Gaps of
    up to two median intervals, within the bounds of `GAP_MAX_S`, are covered.
    """
    recorded_s = trajectory.stamp_s
    gap_max_s = np.clip(2 * np.median(np.diff(recorded_s)), *GAP_MAX_S) if len(recorded_s) > 1 else GAP_MAX_S[0]
    # Stamps converted to text or integers may differ by rounding.
    after = np.clip(np.searchsorted(recorded_s, stamp_s - 1e-6), 0, len(recorded_s) - 1)
    exact = np.abs(recorded_s[after] - stamp_s) < 1e-6
    before = np.where(exact, after, np.maximum(after - 1, 0))
    covered = exact | (
        (recorded_s[before] <= stamp_s)
        & (stamp_s <= recorded_s[after])
        & (recorded_s[after] - recorded_s[before] <= gap_max_s)
    )
    result = trajectory.between(stamp_s) if len(recorded_s) > 1 else np.tile(np.eye(4), (len(stamp_s), 1, 1))
    result[exact] = trajectory.T_world_drone[after[exact]]
    return result, covered
