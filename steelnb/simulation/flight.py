"""A quadrotor-sized rigid body flown along a path in PyBullet, with true poses and IMU readings at every step."""

import itertools
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from steelnb.core import rng
from steelnb.core.errors import CollisionError
from steelnb.core.types import GRAVITY, Array, Imu, IntArray, Trajectory
from steelnb.settings import FlightSettings, TowerSettings
from steelnb.settings.report_plots import STEP_S
from steelnb.simulation.tower import Tower, half_width

COMMAND_S = 0.1
"""Interval between the commands of a pilot."""
MASS_KG = 0.275
INERTIA = (6e-4, 6e-4, 10e-4)
HALF_BOX_M = (0.12, 0.12, 0.04)
DRAG_N_PER_M_S = 0.1
# Gains of the cascade position → velocity → acceleration, and attitude → angular acceleration.
POSITION_P, VELOCITY_P, VELOCITY_I, ATTITUDE_P, ATTITUDE_D = 1.2, 2.5, 0.8, 80.0, 16.0
TILT_ACCELERATION_MAX = 5.0
GUST_TIME_S = 2.0
"""Correlation time of gusts."""


class Command(NamedTuple):
    """A pilot's setpoint until the next command: velocity ``(forward, left, up)``, m/s, along the axes of the levelled
    drone, and the rate of the heading, rad/s."""

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0


Pilot = Callable[[Trajectory, Imu], Command | None]
"""Called every `COMMAND_S` with the true poses and exact IMU readings since its last call; the last sample of that
call is repeated. A pilot may use them only to simulate its sensors. Returning None ends the flight."""
Vector = Sequence[float]
_Reference = Callable[[int, Vector, Vector], Any]
"""Step number, position and quaternion → reference position, velocity, acceleration and heading; or None to end the
flight."""
STILL = (0.0, 0.0, 0.0)


def fly(tower: Tower, settings: FlightSettings, seed: rng.Seed, pilot: Pilot | None = None) -> tuple[Trajectory, Imu]:
    """True trajectory and noise-free IMU of a flight along the path of the settings, both at 125 Hz from t = 0.

    The drone is a rigid body of 275 g, driven by thrust along its z axis and by torques. A velocity controller follows
    `minimum_jerk` through waypoints, or `setpoints` without waypoints. With a ``pilot``, it starts at their first point
    and follows the pilot's commands. `gusts` act through drag. World frame and REP 103 drone frame; specific force
    (m/s²) and angular rate (rad/s) are means over the step that ends at their stamp. Raises `CollisionError`, with time
    and position, when the body touches the structure or the ground.
    """
    pybullet = _import_pybullet()
    steps = round(settings.duration_s / STEP_S)
    time_s = np.arange(steps, dtype=np.float64) * STEP_S
    state, imu = np.empty((steps + 1, 7)), np.empty((steps + 1, 6))
    if settings.waypoints:
        target, velocity, acceleration = minimum_jerk(settings, time_s)
        yaws = target[:, 3].tolist()
    else:
        target, velocity = setpoints(settings, tower.settings, steps, STEP_S)
        acceleration, yaws = np.zeros_like(target), [heading(settings, *target[0, :2])]
    planned = [each[:, :3].tolist() for each in (target, velocity, acceleration)]

    def along_path(step: int, position: Vector, _: Vector) -> Any:
        yaw = yaws[step] if settings.waypoints else heading(settings, position[0], position[1])
        return *(each[step] for each in planned), yaw

    reference = along_path if pilot is None else _as_commanded(pilot, yaws[0], state, imu)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = _make_world(pybullet, client, tower, planned[0][0], yaws[0])
        wind = gusts(settings, seed, steps).tolist()
        steps = _loop(pybullet, client, body, reference, settings, wind, state, imu)
    finally:
        pybullet.disconnect(client)
    return _flown(state[: steps + 1], imu[: steps + 1])


def gusts(settings: FlightSettings, seed: rng.Seed, steps: int) -> Array:
    """Wind velocity at each step, ``(steps, 3)`` m/s in the world frame, from the stream ``gust`` of the seed.

    Each axis is an Ornstein-Uhlenbeck process with standard deviation ``gust_sigma_m_s`` and correlation time
    `GUST_TIME_S`; it begins after ``still_s``.
    """
    shocks = rng.stream(seed, "gust").standard_normal((steps, 3))
    decay = math.exp(-STEP_S / GUST_TIME_S)
    shocks = shocks * settings.gust_sigma_m_s * math.sqrt(1 - decay**2)
    shocks[: round(settings.still_s / STEP_S)] = 0.0
    # scipy.signal.lfilter is bit-identical, but its import takes longer than a short flight.
    return np.array(list(itertools.accumulate(shocks, lambda wind, shock: decay * wind + shock)))


def _flown(state: Array, imu: Array, first: int = 0) -> tuple[Trajectory, Imu]:
    """Trajectory and IMU from positions and quaternions ``(N, 7)`` and readings ``(N, 6)``; ``first``: number of the
    first step."""
    stamp = np.arange(first, first + len(state), dtype=np.float64) * STEP_S
    T_world_drone = np.tile(np.eye(4), (len(state), 1, 1))
    T_world_drone[:, :3, :3] = Rotation.from_quat(state[:, 3:]).as_matrix()
    T_world_drone[:, :3, 3] = state[:, :3]
    return Trajectory(stamp, T_world_drone), Imu(stamp, imu[:, :3].copy(), imu[:, 3:].copy())


def _as_commanded(pilot: Pilot, yaw: float, state: Array, imu: Array) -> _Reference:
    """Reference for a pilot's velocity commands: the position is not controlled, and the heading is ``yaw`` plus the
    integral of the commanded rates."""
    command, last_call = Command(), 0

    def reference(step: int, position: Vector, quaternion: Vector):  # type: ignore[no-untyped-def]
        nonlocal command, last_call, yaw
        if math.floor(step * STEP_S / COMMAND_S + 1e-6) != math.floor((step - 1) * STEP_S / COMMAND_S + 1e-6):
            new_command = pilot(*_flown(state[last_call : step + 1], imu[last_call : step + 1], last_call))
            if new_command is None:
                return None
            command, last_call = new_command, step
        yaw += command.yaw_rate * STEP_S
        x, y, z, w = quaternion
        true_yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        c, s = math.cos(true_yaw), math.sin(true_yaw)
        forward, left, up = command.velocity
        return position, (c * forward - s * left, s * forward + c * left, up), STILL, yaw

    return reference


def _import_pybullet() -> Any:
    """Import PyBullet, and suppress the line that its C code prints to stderr on the first import."""
    sys.stderr.flush()
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        import pybullet
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)
    return pybullet


def _make_world(pybullet, client: int, tower: Tower, start: list[float], yaw: float) -> int:  # type: ignore[no-untyped-def]
    shape, at = partial(pybullet.createCollisionShape, physicsClientId=client), {"physicsClientId": client}
    pybullet.setTimeStep(STEP_S, **at)
    pybullet.setGravity(0, 0, -GRAVITY, **at)
    for part in mesh_parts(tower.vertices, tower.triangles):
        with mesh_lists(*part) as mesh:
            # Without this flag PyBullet collides with the convex hull of the tower.
            solid = shape(pybullet.GEOM_MESH, flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH, **mesh)
        pybullet.createMultiBody(0, solid, **at)
    pybullet.createMultiBody(0, shape(pybullet.GEOM_PLANE), **at)
    box = shape(pybullet.GEOM_BOX, halfExtents=HALF_BOX_M)
    body = pybullet.createMultiBody(MASS_KG, box, -1, start, pybullet.getQuaternionFromEuler((0, 0, yaw)), **at)
    pybullet.changeDynamics(body, -1, localInertiaDiagonal=INERTIA, linearDamping=0, angularDamping=0, **at)
    return int(body)


def _loop(pybullet, client, body, reference, settings, wind, state, imu) -> int:  # type: ignore[no-untyped-def]
    """Control, step and record; returns the number of steps flown. It uses scalars only: NumPy is ten times slower on
    3-vectors."""
    position, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    velocity, rate = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    ix = iy = iz = 0.0  # integral of the velocity error
    state[0] = (*position, *quaternion)
    imu[0] = (0.0, 0.0, GRAVITY, 0.0, 0.0, 0.0)
    for step in range(len(wind)):
        setpoint = reference(step, position, quaternion)
        if setpoint is None:
            return step
        (rx, ry, rz), (vx, vy, vz), (gx, gy, gz), yaw = setpoint
        ex = vx + POSITION_P * (rx - position[0]) - velocity[0]
        ey = vy + POSITION_P * (ry - position[1]) - velocity[1]
        ez = vz + POSITION_P * (rz - position[2]) - velocity[2]
        ix, iy, iz = ix + ex * STEP_S, iy + ey * STEP_S, iz + ez * STEP_S
        ax, ay, az = VELOCITY_P * ex + VELOCITY_I * ix, VELOCITY_P * ey + VELOCITY_I * iy, VELOCITY_P * ez
        az += VELOCITY_I * iz + GRAVITY
        ax, ay, az = ax + gx, ay + gy, az + gz
        horizontal = math.hypot(ax, ay)
        if horizontal > TILT_ACCELERATION_MAX:
            ax, ay = ax * TILT_ACCELERATION_MAX / horizontal, ay * TILT_ACCELERATION_MAX / horizontal
        az = max(az, 0.3 * GRAVITY)

        m = pybullet.getMatrixFromQuaternion(quaternion)
        thrust = MASS_KG * (ax * m[2] + ay * m[5] + az * m[8])
        torque = _attitude(m, rate, ax, ay, az, yaw)
        w = wind[step]
        force = [DRAG_N_PER_M_S * (w[axis] - velocity[axis]) for axis in range(3)]
        pybullet.applyExternalForce(body, -1, (0, 0, thrust), (0, 0, 0), pybullet.LINK_FRAME, physicsClientId=client)
        pybullet.applyExternalForce(body, -1, force, position, pybullet.WORLD_FRAME, physicsClientId=client)
        pybullet.applyExternalTorque(body, -1, torque, pybullet.LINK_FRAME, physicsClientId=client)
        pybullet.stepSimulation(physicsClientId=client)
        if pybullet.getContactPoints(body, physicsClientId=client):
            x, y, z = position
            path = "" if settings.waypoints else f" with standoff_m = {settings.standoff_m}"
            raise CollisionError(
                f"{settings.trajectory} flight{path}: the drone touches the structure"
                f" or the ground at t = {(step + 1) * STEP_S:.2f} s, at x = {x:.2f}, y = {y:.2f}, z = {z:.2f} m;"
                " expected a path clear of both"
            )

        position, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        new_velocity, rate = pybullet.getBaseVelocity(body, physicsClientId=client)
        m = pybullet.getMatrixFromQuaternion(quaternion)
        fx, fy, fz = [(new - old) / STEP_S for new, old in zip(new_velocity, velocity, strict=True)]
        velocity = new_velocity
        state[step + 1] = (*position, *quaternion)
        imu[step + 1] = (*_in_body(m, (fx, fy, fz + GRAVITY)), *_in_body(m, rate))
    return len(wind)


def _in_body(m: Vector, v: Vector) -> tuple[float, float, float]:
    """Rotate a world-frame vector into the body frame; ``m``: the body's rotation matrix by rows."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2], m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )  # fmt: skip


def _attitude(m, rate, ax: float, ay: float, az: float, yaw: float) -> tuple[float, float, float]:  # type: ignore[no-untyped-def]
    """Torque (body frame) that aligns the body's z axis with (ax, ay, az) and its x axis with the heading.

    The attitude error is ``½ (Rᵀ R_d − R_dᵀ R)^∨`` (Lee, Leok, McClamroch, CDC 2010). ``m``: R by rows; ``rate``:
    angular rate in the world frame.
    """
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    zx, zy, zz = ax / norm, ay / norm, az / norm
    cx, cy = math.cos(yaw), math.sin(yaw)
    yx, yy, yz = -zz * cy, zz * cx, zx * cy - zy * cx  # z × heading
    norm = math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx  # y × z
    # ½ Σ (column of R × column of R_d), turned into the body frame
    wx = m[3] * xz - m[6] * xy + m[4] * yz - m[7] * yy + m[5] * zz - m[8] * zy
    wy = m[6] * xx - m[0] * xz + m[7] * yx - m[1] * yz + m[8] * zx - m[2] * zz
    wz = m[0] * xy - m[3] * xx + m[1] * yy - m[4] * yx + m[2] * zy - m[5] * zx
    turn = [ATTITUDE_P * 0.5 * error - ATTITUDE_D * each for error, each in zip((wx, wy, wz), rate, strict=True)]
    tx, ty, tz = _in_body(m, turn)
    return INERTIA[0] * tx, INERTIA[1] * ty, INERTIA[2] * tz


def path(flight: FlightSettings, tower: TowerSettings) -> tuple[Array, Array]:
    """Corners ``(N, 3)`` of the path of a flight without waypoints, world frame, and the path length ``(N,)`` at each
    corner, metres.

    ``zigzag`` climbs in zigzags before the face y < 0; ``loops`` flies rectangular loops around the body. Both keep
    ``standoff_m`` from the body at every height. For a ``planned`` flight, only the starting point is returned.
    """
    heights = np.linspace(flight.height_min_m, flight.height_max_m, flight.levels)
    points: list[tuple[float, float, float]] = []
    for level, z in enumerate(heights):
        half = half_width(tower, z)
        reach = half + flight.standoff_m
        if flight.trajectory == "planned":
            return np.array([(0.0, -reach, z)]), np.zeros(1)
        if flight.trajectory == "zigzag":
            side = 0.8 * half * (-1) ** level
            points += [(-side, -reach, z), (side, -reach, z)]
        else:
            points += [(0, -reach, z), (reach, -reach, z), (reach, reach, z), (-reach, reach, z), (-reach, -reach, z)]
            points += [(0, -reach, z)]
    corner = np.array(points)
    return corner, np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))


def heading(flight: FlightSettings, x: float, y: float) -> float:
    """Heading (radians, 0 along x) at a position of a path without waypoints: along y for ``zigzag``, else towards the
    tower's axis."""
    return np.pi / 2 if flight.trajectory == "zigzag" else float(np.arctan2(-y, -x))


def setpoints(flight: FlightSettings, tower: TowerSettings, steps: int, step_s: float) -> tuple[Array, Array]:
    """Position and velocity setpoints, each ``(steps, 3)``, on a path without waypoints: after ``still_s`` along it at
    ``speed_m_s``, then hovering at its end.

    Two moving averages over one second round the corners, so the drone need not brake there.
    """
    corner, arc_m = path(flight, tower)
    travelled = np.maximum(np.arange(steps) * step_s - flight.still_s, 0.0) * flight.speed_m_s
    position = np.stack([np.interp(travelled, arc_m, axis) for axis in corner.T], axis=1)
    for _ in range(2):
        position = uniform_filter1d(position, max(1, round(1.0 / step_s)), axis=0, mode="nearest")
    return position, np.gradient(position, step_s, axis=0)


def pose_on_path(tower: Tower, flight: FlightSettings, share: float, lean: Array | None = None) -> Array:
    """Pose ``T_world_sensor (4, 4)``, with the flight's heading, at a ``share`` (0 to 1) of the path's length, or of
    its duration if it has waypoints. ``lean (3,)`` adds yaw, pitch and roll, radians."""
    if flight.waypoints:
        *position, yaw = minimum_jerk(flight, np.array([share * flight.duration_s]))[0][0]
    else:
        corner, arc_m = path(flight, tower.settings)
        position = [np.interp(share * arc_m[-1], arc_m, axis) for axis in corner.T]
        yaw = heading(flight, *position[:2])
    T_world_sensor = np.eye(4)
    turn = np.array([yaw, 0.0, 0.0]) + (0.0 if lean is None else lean)
    T_world_sensor[:3, :3] = Rotation.from_euler("ZYX", turn).as_matrix()
    T_world_sensor[:3, 3] = position
    return T_world_sensor


def minimum_jerk(flight: FlightSettings, time_s: Array) -> tuple[Array, Array, Array]:
    """Pose x, y, z, heading (metres, radians) and its first two derivatives, each ``(N, 4)``, at ``time_s (N,)``, of a
    flight that begins through waypoints after ``still_s``.

    Between waypoints, the drone moves with minimum jerk from rest to rest: after a share τ of the time, it has done a
    share 10τ³ − 15τ⁴ + 6τ⁵ of the distance (Flash, Hogan, J. Neuroscience 5, 1985). The heading turns the shorter way;
    half turns are anticlockwise.
    """
    point = np.array(flight.waypoints)
    seconds, end_s = point[1:, 4], flight.still_s + np.cumsum(point[:, 4])
    corner = np.column_stack([point[:, :3], np.radians(point[:, 3])])
    step = np.diff(corner, axis=0)
    step[:, 3] = np.pi - (np.pi - step[:, 3]) % (2 * np.pi)
    corner[1:, 3] = corner[0, 3] + np.cumsum(step[:, 3])
    k = np.clip(np.searchsorted(end_s, time_s, side="right") - 1, 0, len(step) - 1)
    share = np.clip((time_s - end_s[k]) / seconds[k], 0.0, 1.0)[:, None]
    pose = corner[k] + step[k] * share**3 * (10 - 15 * share + 6 * share**2)
    rate = step[k] / seconds[k, None] * 30 * share**2 * (1 - share) ** 2
    return pose, rate, step[k] / seconds[k, None] ** 2 * 60 * share * (1 - share) * (1 - 2 * share)


VERTICES_MAX = 2**17
"""PyBullet's shared memory holds no larger mesh, and no more than four times as many indices."""
_rows: list[list[float]] = []
"""Reused for all meshes, so that memory is bounded by the largest."""
_lock = threading.Lock()


def mesh_parts(vertices: Array, triangles: IntArray) -> Iterator[tuple[Array, IntArray]]:
    """A mesh of vertices ``(V, 3)`` and triangles ``(T, 3)``, in parts that PyBullet holds."""
    if max(len(vertices), len(triangles)) <= VERTICES_MAX:
        yield vertices, triangles
        return
    for begin in range(0, len(triangles), VERTICES_MAX // 3):
        corner = vertices[triangles[begin : begin + VERTICES_MAX // 3]].reshape(-1, 3)
        yield corner, np.arange(len(corner)).reshape(-1, 3)


@contextmanager
def mesh_lists(vertices: Array, triangles: IntArray) -> Iterator[dict[str, list]]:
    """The arguments ``vertices`` and ``indices`` of ``createCollisionShape``, for a mesh of vertices ``(V, 3)`` and
    triangles ``(T, 3)``. They are emptied at the end."""
    with _lock:
        _rows.extend([] for _ in range(len(vertices) - len(_rows)))
        for kept, row in zip(_rows, vertices.tolist(), strict=False):
            kept[:] = row
        lists: dict[str, list] = {"vertices": _rows[: len(vertices)], "indices": triangles.ravel().tolist()}
        yield lists
        for each in lists.values():
            each.clear()
