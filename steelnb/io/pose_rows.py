"""Rows of stamp, position and quaternion xyzw: which are poses of a drone, and in which order its quaternions are."""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.checks import COORDINATE_MAX_M
from steelnb.core.types import Array

LENGTHS = 0.5, 2.0
"""Bounds of the length of a quaternion, which is normalised."""
SPEED_MAX, FAR_M = 100.0, 20.0
"""Maximum speed of a drone, m/s, and a distance that is always allowed, since some stamps are coarse or in bursts."""
FAR_RUN, FAR_SHARE = 3, 0.1
"""So many poses in a row, and this share of all, or one, may be far off: more are another map, or in another unit."""
JUMP_SHARE = 0.5
"""Poses jump to and fro if the median distance to the second next is less than this share of that to the next."""
ROTATION_TOLERANCE = 1e-2
"""Maximum error of rotation matrices, beyond which the numbers are something else."""
UPRIGHT, UPRIGHT_SHARE = 0.7, 0.9
"""Minimum cosine between the vertical and the z axis of what stands upright, and share of the poses that have it, by
which a drone does."""
ZEROS_FAR_M, ZEROS_SPEED = 1.0, 30.0
"""Poses at (0, 0, 0) between others stand for none if a drone would have to go farther than this, and faster, m/s, to
get there and back."""
LEVEL = 0.2
"""Maximum sine between the horizontal and an axis that is level, as one across the image is; drones bank by more, but
seldom longer."""


def are_valid(rows: Array) -> NDArray[np.bool_]:
    """Which ``rows (N, 8)`` are finite and no farther than `COORDINATE_MAX_M`, with nearly unit quaternions."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(rows[:, 4:], axis=1)
    is_unit = (length >= LENGTHS[0]) & (length <= LENGTHS[1])
    found: NDArray[np.bool_] = np.isfinite(rows).all(axis=1) & is_unit
    return found & (np.abs(rows[:, 1:4]).max(axis=1, initial=0.0) <= COORDINATE_MAX_M)


def are_far(rows: Array) -> NDArray[np.bool_]:
    """Which ``rows (N, 4 or more)``, rising by stamp, are farther from those before and after than a drone flies.

    They are few in a row. Poses that go on from a new place are right: a map was corrected.
    """
    begin = np.flatnonzero([True, *_are_apart(rows[:-1], rows[1:])])
    size, far = np.diff([*begin, len(rows)]), np.zeros(len(rows), bool)
    goes_on = np.flatnonzero(size > FAR_RUN)
    if len(goes_on) in (0, len(size)):
        return far
    # From the first long run to the end, then back to the beginning.
    for runs, is_back in ((range(goes_on[0], len(size)), False), (range(goes_on[0], -1, -1), True)):
        last = 0
        for k in runs:
            first, end = begin[k], begin[k] + size[k] - 1
            near, next_last = (end, first) if is_back else (first, end)
            if size[k] > FAR_RUN or not _are_apart(rows[[last]], rows[[near]])[0]:
                last = next_last
            else:
                far[first : end + 1] = True
    return far if far.sum() <= max(1, FAR_SHARE * len(rows)) else np.zeros(len(rows), bool)


def _are_apart(rows: Array, others: Array) -> NDArray[np.bool_]:
    """Whether a drone cannot get from each row to the other in time."""
    way_m, time_s = np.linalg.norm(others[:, 1:4] - rows[:, 1:4], axis=1), np.abs(others[:, 0] - rows[:, 0])
    apart: NDArray[np.bool_] = way_m > FAR_M + SPEED_MAX * time_s
    return apart


def are_placeholders(rows: Array) -> NDArray[np.bool_]:
    """Which ``rows (N, 4 or more)``, rising by stamp, are at (0, 0, 0) between others, where no drone gets so fast."""
    is_zero = (rows[:, 1:4] == 0).all(axis=1)
    begin = np.flatnonzero([True, *(is_zero[1:] != is_zero[:-1])])
    found = np.zeros(len(rows), bool)
    for first, end in itertools.pairwise(begin[1:]):
        edges = rows[[first, end]] - rows[[first - 1, end - 1]]
        way_m = np.linalg.norm(edges[:, 1:4], axis=1)
        found[first:end] = is_zero[first] and (way_m > np.maximum(ZEROS_FAR_M, ZEROS_SPEED * edges[:, 0])).all()
    return found


def jump_m(rows: Array) -> float:
    """Median distance of poses, ``rows (N, 4 or more)``, from the next, if they jump to and fro, else 0."""
    if len(rows) < 4:
        return 0.0
    next_m, second_m = (np.median(np.linalg.norm(rows[k:, 1:4] - rows[:-k, 1:4], axis=1)) for k in (1, 2))
    return float(next_m) if second_m < JUMP_SHARE * next_m else 0.0


def xyzw_of(rows: Array, columns: int) -> Array | None:
    """Quaternions ``(N, 4)`` of the rotations in matrices of three rows and 3 or 4 ``columns``, ``rows (N, 9 or 12)``,
    NaN where these are; None if they are no rotations."""
    R, xyzw = rows.reshape(-1, 3, columns)[:, :, :3], np.full((len(rows), 4), np.nan)
    R = R[is_finite := np.isfinite(R).all(axis=(1, 2))]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > ROTATION_TOLERANCE or (np.linalg.det(R) < 0).any():
        return None
    xyzw[is_finite] = Rotation.from_matrix(R).as_quat()
    return xyzw


def of_transforms(rows: Array) -> Array:
    """``T[:3]``, ``(N, 12)``, of transforms, ``rows (N, 16)``, row by row, or column by column as Eigen, MATLAB and
    ARKit write them. Raises ValueError if neither way the last row is 0 0 0 1."""
    T, is_finite = rows.reshape(-1, 4, 4), np.isfinite(rows).all(axis=1)
    for ordered in (T, T.transpose(0, 2, 1)):
        if np.abs(ordered[is_finite, 3] - (0, 0, 0, 1)).max(initial=0.0) < ROTATION_TOLERANCE:
            return ordered[:, :3].reshape(-1, 12)
    raise ValueError("16 numbers after the stamp that are no transforms; expected 0 0 0 1 as the last row")


def heights_of_z(quaternions: Array) -> tuple[Array, Array]:
    """Cosine ``(N,)`` between the vertical and the z axis of rotations, if ``quaternions (N, 4)`` are x, y, z, w, and
    if they are w, x, y, z."""
    as_xyzw, as_wxyz = (Rotation.from_quat(q).as_matrix()[:, 2, 2] for q in (quaternions, quaternions[:, [1, 2, 3, 0]]))
    return as_xyzw, as_wxyz


def w_is_first(quaternions: Array) -> bool | None:
    """Whether a drone with ``quaternions (N, 4)`` is upright if they are w, x, y, z, and in no usual attitude if they
    are x, y, z, w: neither upright nor upside down, as with z down, nor with z level, as of a camera. None if it is
    upright in both orders."""
    q = quaternions[np.isfinite(quaternions).all(axis=1) & quaternions.any(axis=1)]
    if not len(q):
        return False
    as_xyzw, as_wxyz = heights_of_z(q)
    if (as_wxyz > UPRIGHT).mean() <= UPRIGHT_SHARE:
        return False
    if (as_xyzw > UPRIGHT).mean() > UPRIGHT_SHARE:
        return None
    return not ((as_xyzw < -UPRIGHT).mean() > UPRIGHT_SHARE or np.median(np.abs(as_xyzw)) < LEVEL)
