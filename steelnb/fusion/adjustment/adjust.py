"""The adjustment of a flight: find and fit its bars, then take the steps of `adjustment.solver` in stages."""

from collections.abc import Iterator
from dataclasses import replace

from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray
from steelnb.fusion.adjustment import problem
from steelnb.fusion.adjustment.imu_factors import Inertial
from steelnb.fusion.adjustment.point_factors import PointEquations, linearised
from steelnb.fusion.adjustment.problem import Bars, Problem
from steelnb.fusion.adjustment.solver import improve
from steelnb.fusion.bar_fitting import BarFitter
from steelnb.fusion.mapped_scans import MappedScans
from steelnb.fusion.point_to_bar import BarVoxels, Observations
from steelnb.fusion.ridges import TUBE_M
from steelnb.fusion.sections import shapes

Stages = tuple[tuple[int, int], ...]
"""Stages ``(n, steps)`` of an adjustment: number of steps with one in n pixels."""
FACE_SIGMAS, FACE_MAX_TUBES, RATIO_MIN = 2.5, 1.3, 0.8
"""Maximum distance of a point from the front face of its bar in an adjustment, in standard deviations of the range
noise and in tube radii; and minimum noise ratio for the first, below which large residuals are due to poses and
sections. With ``starling2``, 2 to 3 standard deviations give similar errors. With the report's sensor, a larger bound
leaves too few points of the first scan, which fixes the world frame."""


def adjust(
    scans: MappedScans, prior: Array, stamp_s: Array, stages: Stages, fits: int, every: int = 5, bars_min: int = 1,
    tilt_sigma_rad: float = 0.0, inertial: Inertial | None = None, before: Problem | None = None,
) -> tuple[Problem, PointEquations]:  # fmt: skip
    """Adjust the poses of scans and the bars of `BarFitter.find_and_fit` together; returns also the equations of the
    last step.

    ``prior`` and ``stamp_s`` as for `solver.improve`, ``tilt_sigma_rad`` and ``inertial`` as for `Problem`. ``before``:
    an earlier adjustment of the same flight, whose range noise and thickness are the first estimates. All steps of a
    stage use the same points. Without an earlier adjustment, these include points far from the front faces.

    Raises `InputError` if fewer than ``bars_min`` bars have a known section.
    """
    thickness = before.bars.thickness if before else scans.settings.thickness or shapes.THICKNESS
    bars = BarFitter(scans, thickness).find_and_fit(fits, every).bars
    if bars.has_section.sum() < bars_min:
        raise InputError("too few bars whose sections are known")
    state = problem.start(scans.T_world_sensor, prior, bars, tilt_sigma_rad, inertial)
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
    """The `MappedScans.bar_points` within `FACE_SIGMAS` of the front faces of their bars (`BarVoxels.on_face`);
    ``sigma_ratio``: range noise as a multiple of that in `points.ranges`."""
    sigmas = FACE_SIGMAS * max(sigma_ratio, RATIO_MIN)
    for k, points, bar in scans.bar_points(voxels, pixels=pixels):
        on_face = voxels.on_face(points, bar, scans.T_world_sensor[k], bars, sigmas, FACE_MAX_TUBES * TUBE_M)
        yield k, points[on_face], bar[on_face]
