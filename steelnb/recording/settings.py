"""Settings of odometry and reconstruction for a recording: a preset, adapted to its first scans, then overridden."""

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, Flight
from steelnb.points import voxel_grid
from steelnb.settings import ExperimentSettings, StructureSettings
from steelnb.settings.base import setting_names
from steelnb.settings.stages import NO_FLOOR_M

FIRST_SCANS = 10
SCALE_MIN = 1.25
"""Lengths are kept for scenes up to this many times as large as that of the preset's sensor."""
POINTS_MIN = 1000
"""Enlarged voxels must leave at least this many points of the first scan."""
REGISTERED_MIN = 100
"""Scans with fewer points are not registered."""
UNDERGROUND_M = 0.3
UNDERGROUND_SHARE = 0.01
"""If more than this share of points is below zero by more than `UNDERGROUND_M`, the world's zero is not the ground."""
LENGTHS = {
    "preprocess.voxel_leaf_m": 1,
    "hough.dx_m": 1, "hough.gap_max_m": 1, "hough.length_min_m": 1, "hough.density_min_per_m": -1,
    "fusion.distance_max_m": 1, "robust_scale_m": 1, "max_correspondence_m": 1, "map_voxel_m": 1,
}  # fmt: skip
"""Settings that scale with the distance of the points, and the exponent of the scale in each."""

CALIBRATION = ("tof.range_scale", "tof.range_offset_m", "tof.range_scale_sigma", "tof.range_offset_sigma_m")
"""The settings of the sensor that a recording needs."""


@dataclass(frozen=True)
class Scene:
    """Statistics of the first scans: ``range_m`` and ``median_m``, the 99th percentile and the median of the ranges,
    and ``underground``, the share of returns more than `UNDERGROUND_M` below the zero of the poses' world. All are NaN
    without a return. ``points (N, 3)`` are the returns of the first scan that has any."""

    range_m: float
    median_m: float
    underground: float
    points: Array

    @classmethod
    def of(cls, flight: Flight) -> "Scene":
        """The scene in the first scans of a flight."""
        first, clouds = flight.first(FIRST_SCANS), []
        for scan in first.scans:
            points = np.asarray(scan.points, dtype=float).reshape(-1, 3)
            clouds.append(points[np.isfinite(np.linalg.norm(points, axis=1))])
        range_m = np.linalg.norm(np.concatenate(clouds), axis=1)
        if not len(range_m):
            return cls(np.nan, np.nan, np.nan, clouds[0])
        up = (first.prior.T_world_drone @ flight.T_drone_sensor)[:, 2]
        height_m = np.concatenate([cloud @ z[:3] + z[3] for cloud, z in zip(clouds, up, strict=True)])
        seen = next(cloud for cloud in clouds if len(cloud))
        median_m, far_m = np.percentile(range_m, [50, 99])
        return cls(float(far_m), float(median_m), float((height_m < -UNDERGROUND_M).mean()), seen)

    def overrides(self, preset: ExperimentSettings) -> dict[str, float]:
        """The settings of the odometry that differ from the preset's.

        If returns reach beyond the range of the preset's sensor, so does the crop. If their median exceeds half of that
        range, all other lengths are scaled in proportion, as long as voxels leave `POINTS_MIN` points. Both need a
        factor above `SCALE_MIN`. The floor is removed if the world's zero is not the ground.
        """
        range_max_m = preset.tof.range_max_m
        scale, leaf_m = self.median_m / (0.5 * range_max_m), preset.odometry.preprocess.voxel_leaf_m
        while scale > SCALE_MIN and len(voxel_grid(self.points, scale * leaf_m)) < POINTS_MIN:
            scale *= 0.9
        changed: dict[str, float] = {}
        if self.range_m > SCALE_MIN * range_max_m:
            changed["preprocess.crop_m"] = float(f"{self.range_m:.3g}")
        if scale > SCALE_MIN:
            known = setting_names(type(preset.odometry))
            for name, power in LENGTHS.items():
                if name in known:
                    changed[name] = float(f"{attrgetter(name)(preset.odometry) * scale**power:.3g}")
        if self.underground > UNDERGROUND_SHARE:
            changed["preprocess.floor_m"] = NO_FLOOR_M
        return changed


def recording_settings(
    method: str = "best",
    sensor: str = "starling2",
    *,
    scene: Scene | None = None,
    range_max_m: float | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> tuple[ExperimentSettings, StructureSettings]:
    """Settings of odometry and reconstruction for a recording, from the preset of a sensor.

    ``scene`` adapts lengths and floor to the first scans of a flight. ``range_max_m``, the crop in all directions, and
    ``overrides`` take precedence over it. Raises `InputError`, also for settings of the simulation alone.
    """
    preset = ExperimentSettings.preset(noise="none", sensor=sensor, method=method)
    found = scene.overrides(preset) if scene is not None else {}
    found |= {"preprocess.crop_m": range_max_m} if range_max_m is not None else {}
    settings = preset.override(found | dict(overrides or {}))
    for name in overrides or {}:
        if ExperimentSettings.table_of(name) != "odometry" and name not in CALIBRATION:
            raise InputError(
                f"{name}: a setting of simulated flights, which changes nothing in a recording; expected one of the"
                f" odometry, {', '.join(CALIBRATION)}, or --range for the range"
            )
    seen, before = settings.odometry.preprocess, preset.odometry.preprocess
    seen.check_range(range_max_m)
    also = {"range_max_m": seen.crop_m} if seen.crop_m != before.crop_m else {}
    also |= {"floor_m": seen.floor_m} if seen.floor_m != before.floor_m else {}
    # Uncorrected poses are not adjusted, and smoothed ones already are.
    return settings, StructureSettings(adjust=method != "none" and not settings.odometry.smooth, **also)


def settings_line(settings: ExperimentSettings) -> str:
    """The settings that matter most for another kind of sensor, as a line of text."""
    seen = settings.odometry.preprocess
    floor = f"floor at {seen.floor_m:g} m" if seen.floor_m > NO_FLOOR_M else "no floor"
    return f"settings  range {seen.crop_m:g} m, {floor}, voxels of {seen.voxel_leaf_m:g} m"


def voxel_warning(settings: ExperimentSettings, scene: Scene) -> tuple[str, ...]:
    """A line if voxels leave too few points of a scan to register it, else nothing."""
    leaf_m, seen = settings.odometry.preprocess.voxel_leaf_m, len(scene.points)
    left = len(voxel_grid(scene.points, leaf_m))
    if left >= min(REGISTERED_MIN, seen):
        return ()
    return (f"voxels of {leaf_m:g} m leave {left} of the {seen} points of a scan; expected {REGISTERED_MIN}",)
