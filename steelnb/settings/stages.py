"""Settings of the stages that several methods share, and of the final reconstruction. Lengths in metres, angles in
radians."""

import math
from typing import Annotated, Self

from pydantic import Field

from steelnb.core.errors import InputError
from steelnb.settings.base import Finite, NotNegative, Positive, Probability, Settings, VoxelEdge

THICKNESS_MIN, THICKNESS_MAX = 0.04, 0.2
"""Bounds of the thickness of angle sections, a share of their flanges."""
NO_FLOOR_M = -1e6
"""A floor so low that no point is below it."""


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
