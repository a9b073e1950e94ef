"""Settings of the stages that several methods share, and of the final reconstruction. Lengths in metres, angles in
radians."""

import math
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.settings.base import Finite, NotNegative, Positive, Probability, Settings, VoxelEdge

THICKNESS_MIN, THICKNESS_MAX = 0.04, 0.2
"""Bounds of the thickness of angle sections, a share of their flanges."""
NO_FLOOR_M = -1e6
"""A floor so low that no point is below it."""
ROTATION_SIGMA_MAX_DEG, TRANSLATION_SIGMA_MAX_M, TIME_SIGMA_MAX_S = 10.0, 0.5, 0.5
"""A mount or a clock that is known less well than this must be stated."""


class PreprocessSettings(Settings):
    """Pass-through box of ±``crop_m`` in the drone frame, floor in the world frame, voxel grid."""

    crop_m: Positive = 6.0
    floor_m: Finite = 0.3
    voxel_leaf_m: VoxelEdge = 0.05

    def check_range(self, range_max_m: float | None) -> None:
        """Raise `InputError` for the range of a sensor, if given, that is within a voxel."""
        if range_max_m is not None and not range_max_m > self.voxel_leaf_m:
            raise InputError(f"range_max_m = {range_max_m:g}: expected more than a voxel of {self.voxel_leaf_m:g} m")


class HoughSettings(Settings):
    """Iterative 3D Hough transform (Dalitz et al. 2017) and the sorting of its lines into segments.

    ``dx_m`` is the cell width of the transform and the maximum root mean square radius of a segment. ``granularity`` is
    how often the icosahedron of directions is subdivided. With ``skip_weak``, a line with too few points is dropped and
    the search goes on; in the original, such a line ends the search.
    """

    dx_m: Positive = 0.07
    min_votes: Annotated[int, Field(ge=2)] = 20
    max_lines: Annotated[int, Field(ge=1)] = 40
    granularity: Annotated[int, Field(ge=0, le=6)] = 4
    gap_max_m: Positive = 0.25
    pca_ratio_min: Probability = 0.98
    density_min_per_m: NotNegative = 0.0
    length_min_m: NotNegative = 0.0
    skip_weak: bool = False


class FusionSettings(Settings):
    """Gates of a segment and a mapped bar: angle, and perpendicular distance, plus both radii if ``add_radii``."""

    angle_max_rad: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.13962634015954636  # 8 degrees
    distance_max_m: Positive = 0.15
    add_radii: bool = False


class MountSettings(Settings):
    """How well the mount of the sensor and its clock are known: standard deviations of the rotation about each axis,
    of the translation along each axis of the drone, and of the delay of the stamps. What has 0 is known; the rest is
    estimated by smoothing (`steelnb.fusion.adjustment.mount`)."""

    rotation_sigma_deg: NotNegative = 0.0
    translation_sigma_m: NotNegative = 0.0
    time_sigma_s: NotNegative = 0.0

    @model_validator(mode="after")
    def _is_an_error(self) -> Self:
        for name, most, unit, stated in (
            ("rotation_sigma_deg", ROTATION_SIGMA_MAX_DEG, "°", "the mount"),
            ("translation_sigma_m", TRANSLATION_SIGMA_MAX_M, " m", "the mount"),
            ("time_sigma_s", TIME_SIGMA_MAX_S, " s", "the offset of the clock"),
        ):
            if (sigma := getattr(self, name)) > most:
                raise ValueError(f"{name} = {sigma:g}: expected at most {most:g}{unit}; state {stated} instead")
        return self

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(7,)`` of rotation (rad), translation (m) and delay (s)."""
        return np.repeat(
            [math.radians(self.rotation_sigma_deg), self.translation_sigma_m, self.time_sigma_s], [3, 3, 1]
        )


class StructureSettings(Settings):
    """The final reconstruction (`steelnb.fusion.reconstruct`).

    Points below ``floor_m`` or farther from the sensor than ``range_max_m`` are ignored. ``adjust``: first adjust poses
    and bars together, if the poses were corrected but not smoothed. ``thickness``: that of angle sections, a share of
    their flanges, by default a usual one; an adjustment estimates it anew.
    """

    floor_m: Finite = 0.2
    range_max_m: Positive = 6.0
    adjust: bool = False
    thickness: Annotated[float, Field(ge=THICKNESS_MIN, le=THICKNESS_MAX)] | None = None

    @classmethod
    def of(cls, preprocess: PreprocessSettings) -> Self:
        """With the floor and the range of a method's preprocessing."""
        return cls(floor_m=preprocess.floor_m, range_max_m=preprocess.crop_m)
