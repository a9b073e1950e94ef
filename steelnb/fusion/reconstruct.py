"""The final reconstruction: all scans of a flight with corrected poses → `Structure`."""

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from steelnb.core.checks import check_sequence, checked_kind, checked_pose, checked_poses
from steelnb.core.errors import InputError
from steelnb.core.types import Array, Scan, shift_of, translated
from steelnb.fusion.adjustment.factors import DRIFT_PERIOD_S
from steelnb.fusion.adjustment.smooth import adjust
from steelnb.fusion.bars import TUBE_M, Ridges, find_bars
from steelnb.fusion.joints import between_joints, trim_bends
from steelnb.fusion.mapped_scans import BarFitter, MappedScans
from steelnb.fusion.sections import shapes
from steelnb.fusion.structure import Structure
from steelnb.hough.near_segments import freedom_of
from steelnb.settings import StructureSettings

SECTION_FREE_MIN = 0.5
"""Minimum freedom of a bar with a fitted section, less than `FREE_MIN` of a line: at true poses around five towers,
seed 11, four of 17 wrong bars are below it, and one of 666 right ones."""
TILT_MAX_RAD = 0.1
"""A bar whose direction has a larger standard deviation is dropped."""


def reconstruct(
    scans: Sequence[Scan],
    T_world_drone: Array,
    T_drone_sensor: Array | None = None,
    settings: StructureSettings | None = None,
) -> Structure:
    """Bars and joints of a structure from all scans of a flight and their smoothed or corrected poses.

    The axis of a bar is the line through the centroids of its sections. A bar with
    too few points for its section or direction is dropped, and so are lines in plates (`sections.fit`), on surfaces
    such as ground and walls (`Ridges`), and others that do not stand free (`freedom_of`).

    Parameters
    ----------
    scans : K scans, points in the sensor frame, NaN for no return; read several times, one in memory at a time.
    T_world_drone : ``(K, 4, 4)``, the corrected poses.
    T_drone_sensor : ``(4, 4)``, the mount of the sensor, default identity.
    settings : see `StructureSettings`. With ``adjust``, poses and bars are adjusted together first (`adjust`);
        smoothing does this more accurately.

    Returns
    -------
    `Structure` in the world frame, metres. An empty one states the reason.

    Raises `InputError` if the poses do not fit the scans or are not rigid, or if no scan has a return above the floor.
    Poses far from zero, such as in UTM, are moved near it for the work (`shift_of`).
    """
    settings = StructureSettings() if settings is None else settings
    check_sequence(scans, "scans", "Scan")
    for k, scan in enumerate(scans if isinstance(scans, list | tuple) else ()):
        checked_kind(scan, f"scans[{k}]", Scan)
    T_world_drone = checked_poses(T_world_drone, "T_world_drone", len(scans))
    origin = shift_of(T_world_drone[0, :3, 3] * [1, 1, 0]) if len(scans) else np.zeros(3)
    if origin.any():
        near = T_world_drone.copy()
        near[:, :3, 3] = translated(near[:, :3, 3], -origin)
        return reconstruct(scans, near, T_drone_sensor, settings).moved(origin)
    mount = None if T_drone_sensor is None else checked_pose(T_drone_sensor, "T_drone_sensor")
    T_world_sensor = T_world_drone if mount is None else T_world_drone @ mount
    thickness = settings.thickness or shapes.THICKNESS
    if settings.adjust:
        mapped = MappedScans.mapped(scans, T_world_sensor, settings, every=3)
        stamp_s = DRIFT_PERIOD_S * np.arange(len(scans), dtype=np.float64)
        with contextlib.suppress(InputError):  # too few bars
            adjusted, _ = adjust(mapped, T_world_sensor, stamp_s, ((4, 2),), fits=2)
            T_world_sensor, thickness = adjusted.T_world_sensor, adjusted.bars.thickness
    mapped = MappedScans.mapped(scans, T_world_sensor, settings)
    fitter = BarFitter(mapped, thickness)
    ridges = Ridges.of(mapped.voxels)
    segments, reason = find_bars(ridges, rise_m=TUBE_M)
    if not len(segments):
        return Structure.empty(reason)
    for _ in range(2):
        _, segments = fitter.refine(segments, rise_m=TUBE_M)
    fitted = fitter.fit(trim_bends(segments), every=1)
    fitted = fitted.take(fitted.bars.is_bar & (fitted.tilt <= TILT_MAX_RAD))  # a tilt is NaN if points are too few
    half_m = np.maximum(0.5 * np.nan_to_num(fitted.bars.flange), TUBE_M)
    fitted = fitted.take(freedom_of(ridges.points, fitted.bars.segments, half_m, SECTION_FREE_MIN) >= SECTION_FREE_MIN)
    if not len(fitted.tilt):
        return Structure.empty("no bar stands free and has enough points to determine its direction")
    structure = fitted.tied()
    return replace(
        structure, segments=between_joints(structure.segments, structure.joint, structure.tie, fitted.is_weak)
    )
