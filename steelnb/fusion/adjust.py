"""Joint adjustment of the poses of a flight and the axes of its bars (bundle adjustment with bars as landmarks).

Odometry places each scan against a map that holds the drift of the scans before it. Here all poses and axes move at
once: the residual of a point is its distance to the face of its bar that it hit, along the normal of the face. Free are
position and yaw of each pose, and place and tilt of each bar; roll and pitch are the IMU's. A shift and a turn of the
whole, which no scan can observe, are removed: in the mean of the first scans the poses stay where they were. A pose
sees few bars and a bar many poses, so the poses are eliminated first (Schur complement).
"""

from collections.abc import Iterable

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from steelnb.fusion import sections
from steelnb.fusion.bundle import yaw_of
from steelnb.types import Array, IntArray, Segments

POSE_SIGMA = np.array([0.1, 0.1, 0.1, 0.05])
"""Prior standard deviation of a pose, metres and radians: holds the directions that no bar constrains."""
BAR_SIGMA = np.array([0.05, 0.05, 0.05, 0.05])
"""Prior standard deviation of a bar, metres, and metres per metre."""
ANCHOR_SCANS = 25
"""First scans that keep the world frame: five seconds at 5 Hz, in which the drift has hardly begun."""

ScanPoints = Iterable[tuple[int, Array, IntArray]]
"""Of each scan: its number k, points ``(N, 3)`` in the sensor frame, and the bar of each point ``(N,)`` or −1."""


def adjust(
    bars: Segments, turn: Array, flange: Array, across: Array, T_world_sensor: Array, scan_points: ScanPoints
) -> tuple[Array, Segments]:
    """One Gauss-Newton step of all poses and bars; returns ``T_world_sensor (K, 4, 4)`` and the bars.

    ``turn (B,)`` radians, ``flange (B,)`` metres and the frames ``across (B, 2, 3)`` are those of `fusion.sections`.
    Bars without a known section, NaN ``flange``, take no part and stay in place.
    """
    poses, start, end = T_world_sensor.copy(), bars.start.copy(), bars.end.copy()
    known, direction, length = np.isfinite(flange), bars.direction, bars.length
    corner = sections.outlines(turn, np.where(known, flange, 0.05))
    block, right = np.zeros((len(bars), 4, 4)), np.zeros((len(bars), 4))
    whole = np.zeros((len(bars) * 4, len(bars) * 4))
    kept: list[tuple[int, Array, Array, IntArray]] = []
    for k, points, bar in scan_points:
        matrix, vector, cross = np.zeros((4, 4)), np.zeros(4), np.zeros((len(bars), 4, 4))
        bar = np.where((bar >= 0) & known[bar], bar, -1)
        _gather(points, poses[k], bar, start, direction, length, across, corner, matrix, vector, cross,
                block, right)  # fmt: skip
        matrix[np.diag_indices(4)] += POSE_SIGMA**-2.0
        seen = np.flatnonzero(cross.any(axis=(1, 2)))
        index = (4 * seen[:, None] + np.arange(4)).ravel()
        wide = cross[seen].transpose(1, 0, 2).reshape(4, -1)
        solved = np.linalg.solve(matrix, np.concatenate([wide, vector[:, None]], axis=1))
        whole[np.ix_(index, index)] -= wide.T @ solved[:, :-1]
        right.reshape(-1)[index] -= wide.T @ solved[:, -1]
        kept.append((k, solved[:, :-1], solved[:, -1], index))
    for b in range(len(bars)):
        whole[4 * b : 4 * b + 4, 4 * b : 4 * b + 4] += block[b] + np.diag(BAR_SIGMA**-2.0)
    moved = np.linalg.solve(whole, right.reshape(-1))
    for scan, wide, vector, index in kept:
        step = vector - wide @ moved[index]
        poses[scan, :3, 3] += step[:3]
        poses[scan, :3, :3] = Rotation.from_rotvec([0, 0, step[3]]).as_matrix() @ poses[scan, :3, :3]
    place, tilt = moved.reshape(-1, 4)[:, :2], moved.reshape(-1, 4)[:, 2:]
    half = 0.5 * length[:, None]
    start += np.einsum("bk,bkx->bx", place - half * tilt, across)
    end += np.einsum("bk,bkx->bx", place + half * tilt, across)
    turned, shift = _back(poses[:ANCHOR_SCANS], T_world_sensor[:ANCHOR_SCANS])
    poses[:, :3, :3], poses[:, :3, 3] = turned @ poses[:, :3, :3], poses[:, :3, 3] @ turned.T + shift
    return poses, Segments(start @ turned.T + shift, end @ turned.T + shift, bars.count, bars.radius)


def _back(poses: Array, before: Array) -> tuple[Array, Array]:
    """The rotation about z ``(3, 3)`` and the shift ``(3,)`` that bring poses back to those before, in the mean."""
    between = before[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    yaw = yaw_of(between).mean()
    turned = Rotation.from_rotvec([0, 0, yaw]).as_matrix()
    return turned, (before[:, :3, 3] - poses[:, :3, 3] @ turned.T).mean(axis=0)


@njit(cache=True)
def _gather(points, T, bar, start, direction, length, across, corner, matrix, vector, cross, block, right):  # type: ignore[no-untyped-def]
    """Add a scan's points to the normal equations of its pose, of the bars, and between them."""
    pose, place = np.empty(4), np.empty(4)
    for i in range(len(points)):
        b = bar[i]
        if b < 0:
            continue
        x, y, z, cx, cy, cz = sections.sighting(T, points[i], start[b])
        u, v, t = sections.in_frame(direction[b], across[b], x, y, z)
        p, q, w = sections.in_frame(direction[b], across[b], cx, cy, cz)
        residual, sigma, _, cosine, sine, _, _, rise = sections.face_distance(u, v, t, p, q, w, corner[b], length[b])
        if residual != residual:
            continue
        e1, e2 = across[b, 0], across[b, 1]
        bound = (2.5 * sigma + 0.02) ** 2
        weight = (bound / (bound + residual * residual)) ** 2 / (sigma * sigma + 1e-4)
        gu, gv = cosine + rise * sine, sine - rise * cosine
        for k in range(3):
            pose[k] = gu * e1[k] + gv * e2[k]
        pose[3] = cy * pose[0] - cx * pose[1]  # z × (point − sensor), along the normal
        tau = t - 0.5 * length[b]
        place[0], place[1], place[2], place[3] = -gu, -gv, -gu * tau, -gv * tau
        for k in range(4):
            for m in range(4):
                matrix[k, m] += weight * pose[k] * pose[m]
                cross[b, k, m] += weight * pose[k] * place[m]
                block[b, k, m] += weight * place[k] * place[m]
            vector[k] -= weight * pose[k] * residual
            right[b, k] -= weight * place[k] * residual
