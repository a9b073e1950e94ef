"""Smoothing of a whole flight: find bars at the corrected poses, adjust poses and bars together, and repeat (`smooth`).

The second round starts from better poses, so it finds more bars and fits their sections more accurately. One round is
`adjust`: find and fit the bars, then take the steps of `adjustment.solver` in stages.

Covariances of the poses and bars follow from the equations of the last step (`marginals`). Only the diagonal blocks of
the inverse are needed. Those of the chain of poses follow from its factor. The bars add A⁻¹B S⁻¹ (A⁻¹B)ᵀ with their
Schur complement S. This is exact.

The points of one bar in one scan have correlated errors: the fitted section is inexact, mixed pixels lie at edges, and
only the near side is visible. So each scan observes a bar displaced across by an unknown vector, which is marginalised.
The information of a bar in a scan thus saturates with the number of pixels. Drift enters by the prior's increments.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from steelnb.core.checks import check_same_stamps, checked_number
from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, MountEstimate
from steelnb.core.geometry import UPRIGHT_DOF
from steelnb.core.types import Array, Flight, IntArray, Segments, Trajectory
from steelnb.fusion.adjustment import problem
from steelnb.fusion.adjustment.factors import (
    ROBUST_SIGMAS,
    TILT_SIGMA_RAD,
    PointEquations,
    drift_ratio,
    drift_variance,
    linearised,
    summed,
    with_all_freedom,
)
from steelnb.fusion.adjustment.imu_factors import Inertial, check_overlap
from steelnb.fusion.adjustment.mount import MOUNT_DOF, WORLD_DOF, Mount
from steelnb.fusion.adjustment.problem import BAR_DOF, Bars, Problem, pose_size
from steelnb.fusion.adjustment.solver import Chain, improve, normal_equations
from steelnb.fusion.bars import TUBE_M
from steelnb.fusion.mapped_scans import BarFitter, MappedScans, median_range_m
from steelnb.fusion.point_to_bar import BarVoxels, Observations
from steelnb.fusion.sections import shapes
from steelnb.fusion.sections.shapes import frames
from steelnb.settings import ImuSettings, MountSettings, StructureSettings

Stages = tuple[tuple[int, int], ...]
"""Stages ``(n, steps)`` of an adjustment: number of steps with one in n pixels."""
FACE_MAX_TUBES, RATIO_MIN = 1.3, 0.8
"""Maximum distance of a point from the front face of its bar in an adjustment, in tube radii beside `ROBUST_SIGMAS`
standard deviations of the range noise; and minimum noise ratio for the latter, below which large residuals are due
to poses and sections. With ``starling2``, 2 to 3 standard deviations give similar errors. With the report's sensor, a
larger bound leaves too few points of the first scan, which fixes the world frame."""


def adjust(
    scans: MappedScans, prior: Array, stamp_s: Array, stages: Stages, fits: int, every: int = 5, bars_min: int = 1,
    tilt_sigma_rad: float = 0.0, inertial: Inertial | None = None, before: Problem | None = None,
    mount: Mount | None = None, drift: Array | float = 1.0,
) -> tuple[Problem, PointEquations]:  # fmt: skip
    """Adjust the poses of scans and the bars of `BarFitter.find_and_fit` together; returns also the equations of the
    last step.

    ``prior`` and ``stamp_s`` as for `solver.improve`, ``tilt_sigma_rad``, ``inertial``, ``mount`` and ``drift`` as for
    `Problem`; with a ``mount``, ``prior`` and ``inertial`` are about the drone. ``before``: an earlier adjustment of
    the same flight, whose range noise and thickness are the first estimates. All steps of a stage use the same points.
    Without an earlier adjustment, these include points far from the front faces.

    Raises `InputError` if fewer than ``bars_min`` bars have a known section.
    """
    thickness = before.bars.thickness if before else scans.settings.thickness or shapes.THICKNESS
    bars = BarFitter(scans, thickness).find_and_fit(fits, every).bars
    if bars.has_section.sum() < bars_min:
        raise InputError("too few bars whose sections are known")
    state = problem.start(scans.T_world_sensor, prior, bars, tilt_sigma_rad, inertial, mount, drift)
    voxels = scans.around(bars.segments)
    for pixels, steps in stages:
        placed = replace(scans, T_world_sensor=state.T_world_sensor)
        if before:
            chosen = _points_near_faces(placed, voxels, pixels, state.bars, before.sigma_ratio)
        else:
            chosen = placed.bar_points(voxels, pixels=pixels)
        observations = Observations.gathered(chosen)
        for _ in range(steps):
            equations = linearised(state, observations)
            state = improve(state, equations, prior, stamp_s)
    return state, equations


def _points_near_faces(
    scans: MappedScans, voxels: BarVoxels, pixels: int, bars: Bars, sigma_ratio: float
) -> Iterator[tuple[int, Array, IntArray]]:
    """The `MappedScans.bar_points` within `ROBUST_SIGMAS` of the front faces of their bars (`BarVoxels.on_face`);
    ``sigma_ratio``: range noise as a multiple of that in `points.ranges`."""
    sigmas = ROBUST_SIGMAS * max(sigma_ratio, RATIO_MIN)
    for k, points, bar in scans.bar_points(voxels, pixels=pixels):
        on_face = voxels.on_face(points, bar, scans.T_world_sensor[k], bars, sigmas, FACE_MAX_TUBES * TUBE_M)
        yield k, points[on_face], bar[on_face]


SHARED_SIGMA_M = 0.001
"""Standard deviation, per axis, of the displacement that all points of a bar in a scan share, at the range noise of
`points.ranges`. It grows with the square of that noise, as two sensors show."""
END_SIGMA_M = 0.006
"""Standard deviation, per axis, of the model error at either end of a bar, common to all scans: its section type may
not be modelled, or fitted to only part of it. It grows with the range noise. Both were calibrated on seeds 11 to 15."""
ATTITUDE_SIGMA_RAD = 0.01
"""Standard deviation of the prior's roll and pitch if they are fixed: half a degree, as for attitude filters on
small drones. It is not propagated to the position."""
FREE_SIGMA = 10.0
"""A larger standard deviation, metres or radians, means that no factor constrains that direction."""
AXES = ("roll", "pitch", "yaw", "x", "y", "z")
HOLD = 1e-6
"""Information added to keep the matrix of free poses positive definite: a standard deviation of 1 km."""


def marginals(problem: Problem, equations: PointEquations, prior: Array, stamp_s: Array) -> tuple[Array, Array, Array]:
    """The marginal covariances of the state of an adjustment; the arguments are those of `solver.improve`.

    Returns those of the steps of the `Problem.poses` ``(K, D, D)`` (`factors`), zero for the fixed first one; of the
    bars ``(B, 6, 6)``: position of the middle (2) and direction (2) in the frame ``across``, rotation and flange; and
    of the free unknowns of the mount. What no point determines has the standard deviation `problem.BAR_SIGMA`; for
    directions, 0.5 m per metre.

    Raises `InputError` with the free direction if a pose is not constrained.
    """
    equations = _with_displacements(equations, SHARED_SIGMA_M * problem.sigma_ratio**2)
    n, size = len(equations.block), pose_size(problem.tilt_sigma_rad)
    (matrix, beside, _), between, bars, _ = normal_equations(problem, equations, prior, stamp_s)
    matrix = matrix + HOLD * np.eye(matrix.shape[1])
    chain = Chain.factored(matrix, beside)
    forward = chain.forward(between)
    flat = forward.reshape(-1, forward.shape[2])
    inverse = cho_solve(cho_factor(bars - flat.T @ flat), np.eye(flat.shape[1]))
    by_bars = chain.backward(forward)[:, :size]
    pose = chain.inverse_blocks()[:, :size, :size] + (by_bars @ inverse) @ by_bars.transpose(0, 2, 1)
    pose[0] = 0.0
    value, vector = np.linalg.eigh(pose)
    is_free = value[:, -1] > FREE_SIGMA**2
    if is_free.any():
        k = int(np.argmax(is_free))
        axis = AXES[np.argmax(np.abs(vector[k, :, -1])) - size]
        raise InputError(f"covariance of pose {k} is singular: nothing holds it, mostly along {axis}")
    shared = inverse[BAR_DOF * n :, BAR_DOF * n :]
    bar = inverse[: BAR_DOF * n, : BAR_DOF * n].reshape(n, BAR_DOF, n, BAR_DOF)[range(n), :, range(n)]
    if problem.mount:
        by_world, across = _by_world(problem.bars), inverse[: BAR_DOF * n, -WORLD_DOF:].reshape(n, BAR_DOF, WORLD_DOF)
        onto = by_world.transpose(0, 2, 1)
        both = across @ onto
        bar = bar + both + both.transpose(0, 2, 1) + by_world @ shared[-WORLD_DOF:, -WORLD_DOF:] @ onto
        shared = shared[:-WORLD_DOF, :-WORLD_DOF]
    return pose, bar, shared


def mount_cost(problem: Problem, equations: PointEquations, flight: Flight, T_drone_sensor: Array) -> Array:
    """How far a wrong mount would move the positions of the drone ``(6,)``, a root mean square over the scans: metres
    per radian about each axis of the drone, and per metre along it.

    This is the derivative of the solution of an adjustment by a mount that it assumes to be known.
    """
    free = np.append(np.ones(6), 0.0)
    mount = replace(problem.mount, sigma=free) if problem.mount else Mount.started(flight, free, T_drone_sensor)
    of_drone = replace(problem, mount=mount, inertial=None)
    prior, stamp_s = flight.prior.T_world_drone, flight.prior.stamp_s
    equations = with_all_freedom(problem, equations)
    (matrix, beside, _), between, shared, _ = normal_equations(of_drone, equations, prior, stamp_s)
    chain = Chain.factored(matrix + HOLD * np.eye(matrix.shape[1]), beside)
    forward = chain.forward(between)
    flat, n = forward.reshape(-1, forward.shape[2]), BAR_DOF * len(equations.block)
    eliminated, off = shared - flat.T @ flat, np.arange(n, n + 6)
    others = np.delete(np.arange(len(shared)), off)
    follow = np.linalg.solve(eliminated[np.ix_(others, others)], eliminated[np.ix_(others, off)])
    step = chain.backward(forward[:, :, off] - forward[:, :, others] @ follow)[:, -3:]
    return np.asarray(np.sqrt((step**2).sum(axis=1).mean(axis=0)))


def _by_world(bars: Bars) -> Array:
    """Derivatives ``(B, 6, 6)`` of the steps of bars by the motion of all bars together."""
    result = np.zeros((len(bars.turn), BAR_DOF, WORLD_DOF))
    for axis in range(3):
        for rows, vector in ((slice(0, 2), bars.segments.middle), (slice(2, 4), bars.segments.direction)):
            result[:, rows, axis] = (bars.across @ np.cross(np.eye(3)[axis], vector)[:, :, None])[:, :, 0]
    result[:, :2, 3:] = bars.across
    return result


def _with_displacements(equations: PointEquations, sigma_m: float) -> PointEquations:
    """The equations after marginalising a displacement across the axis for each bar in each scan."""
    cross, shares, scan = equations.cross, equations.shares, equations.pair_scan
    displacement = np.linalg.inv(shares[:, :2, :2] + np.eye(2) / sigma_m**2)
    gain = cross[:, :, :2] @ displacement
    of_poses, of_bars = gain @ cross[:, :, :2].transpose(0, 2, 1), shares[:, :, :2] @ displacement @ shares[:, :2]
    return equations._replace(
        matrix=equations.matrix - summed(of_poses, scan, len(equations.matrix)),
        block=equations.block - summed(of_bars, equations.pair_bar, len(equations.block)),
        cross=cross - gain @ shares[:, :2],
        shares=shares - of_bars,
    )


def pose_covariances(pose: Array, T_world_sensor: Array, T_drone_sensor: Array) -> Array:
    """Covariances ``(K, 6, 6)`` of the drone's poses, metres and radians, from those of the sensor's ``(K, D, D)``.

    They refer to a perturbation δ in the world frame, in the order x, y, z, roll, pitch, yaw: the true pose has the
    position t + δ[:3] and the rotation exp(δ[3:]) R. The first pose defines the world, so its block is zero.
    """
    arm = (T_world_sensor @ np.linalg.inv(T_drone_sensor))[:, :3, 3] - T_world_sensor[:, :3, 3]
    size = pose.shape[1]
    by_step = np.tile(np.eye(size), (len(pose), 1, 1))
    for column, axis in enumerate(range(6 - size, 3)):
        by_step[:, -3:, column] = np.cross(np.eye(3)[axis], arm)
    result, order = np.zeros((len(pose), 6, 6)), np.array([3, 4, 5, 0, 1, 2])[-size:]
    result[:, order[:, None], order] = by_step @ pose @ by_step.transpose(0, 2, 1)
    if size == UPRIGHT_DOF:
        result[1:, [3, 4], [3, 4]] = ATTITUDE_SIGMA_RAD**2
    return result


def with_range_sigmas(covariance: Array, flight: Flight, T_world_sensor: Array, settings: StructureSettings) -> Array:
    """Covariances ``(K, 6, 6)`` of an `Estimate` with the errors that a calibration of the ranges leaves, the
    ``range_sigmas`` of the flight. An error of scale stretches the path from the first pose by its share, an error of
    offset by its share of the usual range."""
    scale, offset_m = flight.range_sigmas
    range_m = median_range_m(flight.scans, T_world_sensor, settings) if offset_m else np.nan
    share = scale**2 + (offset_m / range_m) ** 2 if np.isfinite(range_m) else scale**2
    shift, result = T_world_sensor[:, :3, 3] - T_world_sensor[0, :3, 3], covariance.copy()
    result[:, :3, :3] += share * shift[:, :, None] * shift[:, None, :]
    return result


def axis_covariances(bar: Array, segments: Segments, across: Array, sigma_ratio: float) -> Array:
    """Covariances ``(B, 4, 4)`` of the axes of bars, from their marginals ``(B, 6, 6)`` in the frames ``across``.

    They are in the frame `sections.frames` of each segment's direction: position of its middle across (2), metres, and
    direction (2), metres across per metre along. They include `END_SIGMA_M` times ``sigma_ratio``, the range
    noise as a multiple of that in `points.ranges`.
    """
    rotation = frames(segments.direction) @ across.transpose(0, 2, 1)
    both = np.zeros((len(bar), 4, 4))
    both[:, :2, :2] = both[:, 2:, 2:] = rotation
    result = both @ bar[:, :4, :4] @ both.transpose(0, 2, 1)
    end_m2 = (END_SIGMA_M * sigma_ratio) ** 2
    result[:, [0, 1], [0, 1]] += 0.5 * end_m2
    result[:, [2, 3], [2, 3]] += 2.0 * end_m2 / np.maximum(segments.length, 1e-9)[:, None] ** 2
    return np.asarray(result)


def axis_sigma_m(covariance: Array, along_m: Array) -> Array:
    """Standard deviation ``(B,)``, metres, of axes in the direction across in which it is largest, at the distances
    ``along_m (B,)`` from their middles, given their covariances ``(B, 4, 4)``."""
    at = np.concatenate([np.tile(np.eye(2), (len(along_m), 1, 1)), along_m[:, None, None] * np.eye(2)], axis=2)
    return np.sqrt(np.linalg.eigvalsh(at @ covariance @ at.transpose(0, 2, 1))[:, -1])


ROUNDS: tuple[tuple[int, Stages], ...] = ((1, ((8, 2),)), (2, ((8, 2), (1, 2))))
"""Number of times that sections are fitted, and stages, for each round. With half of the pixels in the last stage,
aligned errors are larger by a fifth; with one fit of sections in both rounds, by half."""
MOUNT_ROUNDS = (*ROUNDS, ROUNDS[-1])
"""With an unknown mount, the bars of the first round are those of a wrong one."""
BARS_MIN = 3
"""Minimum number of bars with a section."""


def found_mount(mount: Mount, covariance: Array | None, T_world_sensor: Array) -> MountEstimate:
    """The estimate of a mount, given the ``covariance`` of its free unknowns, and ``T_world_sensor (K, 4, 4)``."""
    full = None
    if covariance is not None:
        full = np.zeros((MOUNT_DOF, MOUNT_DOF))
        full[np.ix_(mount.free, mount.free)] = covariance
    return MountEstimate(mount.T_drone_sensor, mount.late_s, mount.error, full, T_world_sensor)


def smooth(
    flight: Flight,
    estimate: Estimate,
    settings: StructureSettings | None = None,
    tilt_sigma_rad: float = 0.0,
    imu: ImuSettings | None = None,
    known: MountSettings | None = None,
    T_drone_sensor: Array | None = None,
) -> Estimate:
    """The estimate of a flight with all its poses and bars adjusted together (`adjustment.solver`).

    Parameters
    ----------
    flight : K scans, the drifting poses, and the readings of an IMU if it has one.
    estimate : the corrected poses.
    settings : of the bars, as for `reconstruct`.
    tilt_sigma_rad : standard deviation of the prior's roll and pitch; if 0, they are fixed.
    imu : errors from the IMU's data sheet; if given, its readings are factors (`imu_factors`).
    known : how well the mount of the flight and its clock are known; by default, they are.
    T_drone_sensor : (4, 4), the mount that the odometry assumed, if it is not that of the flight.

    Returns
    -------
    The estimate with new poses, of which the first is the prior's, since drift begins there. The points of the map are
    those of one in three scans, at the poses before the last round. Its segments are the bars, with axes through the
    centroids of their sections. With too few bars, the old estimate is returned, with the reason in ``unsmoothed``.

    Raises `InputError` if no readings are within the time of the flight, and if the estimate is not of the flight.
    Poses far from zero are moved near it for the work (`Flight.origin`).
    """
    settings = StructureSettings() if settings is None else settings
    tilt_sigma_rad = checked_number(tilt_sigma_rad, "tilt_sigma_rad", 0.0)
    check_same_stamps(estimate.corrected.stamp_s, "estimate", flight.prior.stamp_s, "the scans of the flight")
    if (origin := flight.origin).any():
        near = flight.moved(-origin)
        found = smooth(near, estimate.moved(-origin, near.prior), settings, tilt_sigma_rad, imu, known, T_drone_sensor)
        return found.moved(origin, estimate.prior)
    stamp_s, T_drone_sensor = flight.prior.stamp_s, flight.T_drone_sensor if T_drone_sensor is None else T_drone_sensor
    prior, T = flight.prior.T_world_drone @ T_drone_sensor, estimate.corrected.T_world_drone @ T_drone_sensor
    before, inertial, mount, of_poses = None, None, None, T_drone_sensor
    if known is not None and known.sigma.any():
        prior, of_poses = flight.prior.T_world_drone, np.eye(4)
        mount = Mount.started(flight, known.sigma, T_drone_sensor)
    if imu is not None and flight.imu is not None:
        check_overlap(flight.imu, flight.prior)
        inertial = Inertial.started(flight.imu, imu, of_poses, estimate.corrected)
        tilt_sigma_rad = tilt_sigma_rad or TILT_SIGMA_RAD
    drift: Array | float = 1.0
    for fits, stages in ROUNDS if mount is None else MOUNT_ROUNDS:
        try:
            scans = MappedScans.mapped(flight.scans, T, settings, every=3)
            state, equations = adjust(
                scans, prior, stamp_s, stages, fits, bars_min=BARS_MIN, tilt_sigma_rad=tilt_sigma_rad,
                inertial=inertial, before=before, mount=mount, drift=drift,
            )  # fmt: skip
        except InputError as fault:
            return replace(estimate, unsmoothed=str(fault))
        if mount and before is None:  # the thickness is that of bars that a wrong mount has blurred
            state = replace(state, bars=replace(state.bars, thickness=settings.thickness or shapes.THICKNESS))
        elif mount:
            # Measured once: where the drift is small, poses that follow it would make it ever smaller.
            drift = drift_ratio(state.poses, prior, stamp_s, len(mount.free))
        T, before, inertial, mount = state.T_world_sensor, state, state.inertial, state.mount
    bars = state.bars.take(state.bars.is_bar)
    poses, unmeasured_s = mount.at_stamps(T) if mount else (T, 0.0)
    pose_covariance, axis_covariance, mount_covariance, cost, unsure = None, None, None, None, ""
    try:
        pose, bar, mount_covariance = marginals(state, equations, prior, stamp_s)
        cost = mount_cost(state, equations, flight, T_drone_sensor)
        pose_covariance = pose_covariances(pose, poses, of_poses)
        if np.any(unmeasured_s):
            order = [5, 0, 1, 2]
            pose_covariance[:, order, order] += drift_variance(unmeasured_s) * np.square(state.drift)
        pose_covariance = with_range_sigmas(pose_covariance, flight, T, settings)
        axis_covariance = axis_covariances(bar[state.bars.is_bar], bars.segments, bars.across, state.sigma_ratio)
    except InputError as fault:
        unsure = str(fault)
    return replace(
        estimate, corrected=Trajectory(stamp_s, poses @ np.linalg.inv(of_poses)), points=scans.voxels.means(),
        segments=bars.segments, unsmoothed="", pose_covariance=pose_covariance, axis_covariance=axis_covariance,
        unsure=unsure, thickness=state.bars.thickness, mount=found_mount(mount, mount_covariance, T) if mount else None,
        mount_cost=cost,
    )  # fmt: skip
