"""What all drawings of a structure share: the class of a member, the prism it is drawn as, its colour."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from steelnb.datatypes import Array, Segments
from steelnb.errors import NonFiniteError, SettingsError, StructureError
from steelnb.fusion.structure import Structure
from steelnb.recordings.clouds import SHIFT_FROM_M, SHIFT_STEP_M

UNIT = "metre"
FRAME = "world: right-handed, z up"
VERTICAL_DEG, HORIZONTAL_DEG = 20.0, 10.0
"""Near vertical is up to 20° from the vertical, since legs lean; near horizontal up to 10° from the horizontal."""
GROUPS = ("near_vertical", "inclined", "near_horizontal")
THINNEST_M = 0.01
UNKNOWN = (0.6, 0.6, 0.6)
JOINT = (0.15, 0.15, 0.15)


def orientation(segments: Segments) -> list[str]:
    """The class of each segment out of `GROUPS`, from its direction alone."""
    lean = np.degrees(np.arccos(np.clip(np.abs(segments.direction[:, 2]), 0, 1)))
    return [GROUPS[0] if angle <= VERTICAL_DEG else GROUPS[1 + (angle >= 90 - HORIZONTAL_DEG)] for angle in lean]


@dataclass(frozen=True)
class Colours:
    """Bars coloured by ``value_m (B,)`` metres, from 0 to ``max_m`` and clipped above; NaN is not known."""

    value_m: Array
    name: str
    max_m: float

    @staticmethod
    def of(value_m: Array, name: str, max_m: float | None) -> "Colours":
        """``max_m`` None: the 95th percentile, since one stray value would leave all others in one colour."""
        if (value_m < 0).any():
            raise SettingsError(f"{name} = {np.nanmin(value_m)}: expected lengths of 0 or more to colour bars by")
        finite = value_m[np.isfinite(value_m)]
        if max_m is None:
            max_m = max(float(np.quantile(finite, 0.95)), 1e-3) if len(finite) else 1.0
        elif not 0 < max_m < np.inf:
            raise SettingsError(f"colour_max_m = {max_m}: expected a length above 0")
        return Colours(value_m, name, max_m)

    @property
    def rgb(self) -> Array:
        """sRGB of each bar ``(B, 3)``, 0 to 1."""
        import matplotlib

        known = ~np.isnan(self.value_m)
        colour = matplotlib.colormaps["viridis"](np.clip(np.where(known, self.value_m, 0.0) / self.max_m, 0, 1))
        return np.where(known[:, None], np.asarray(colour)[:, :3], UNKNOWN)

    @property
    def legend(self) -> str:
        """The scale in words, since these files hold no colour bar."""
        return f"{self.name}: viridis, dark at 0 to yellow at {self.max_m:.4g} m and above; grey: not known"


@dataclass(frozen=True)
class Extras:
    """What goes into a file besides the structure: ``about`` into JSON, ``colours`` into GLB and PLY."""

    colours: Colours
    about: Mapping[str, Any] = field(default_factory=dict)


def drawn_width(structure: Structure) -> Array:
    """Width that each bar is drawn with ``(B,)``, metres: its own, or twice its radius where that is not known."""
    width = np.where(np.isfinite(structure.width_m), structure.width_m, 2 * structure.segments.radius)
    return np.maximum(width, THINNEST_M)


def joint_size(structure: Structure) -> float:
    """Edge of the cubes that joints are drawn as, metres: half as much again as the bars are wide."""
    return 1.5 * float(np.median(drawn_width(structure)))


def rotations(segments: Segments) -> Array:
    """Rotations ``R_world_bar (B, 3, 3)``: x along the bar, y horizontal, z up as far as it can.

    How a section is turned about its axis is not estimated; for a vertical bar y is the world's y.
    """
    along = segments.direction
    side = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=1)
    size = np.linalg.norm(side, axis=1)
    side = np.where(size[:, None] > 1e-9, side / np.maximum(size, 1e-12)[:, None], [0.0, 1.0, 0.0])
    return np.stack([along, side, np.cross(along, side)], axis=2)


def origin_of(structure: Structure) -> Array:
    """What viewers' files are shifted by ``(3,)``, metres: zero unless the coordinates are large (UTM).

    Viewers compute in single precision, which rounds UTM coordinates to 0.25 m.
    """
    middle = structure.segments.middle.mean(axis=0)
    far = np.abs(middle).max() > SHIFT_FROM_M
    return SHIFT_STEP_M * np.round(middle / SHIFT_STEP_M) if far else np.zeros(3)


def checked(structure: Structure, name: str) -> Structure:
    """The structure itself, if its parts fit; ``name`` begins the message if not.

    Raises `NonFiniteError`, or `StructureError` for arrays of different lengths, a bar without length, a negative
    size, a tie to a joint or a bar that does not exist, and a tie given twice.
    """
    segments, bars, joints = structure.segments, len(structure), len(structure.joint)
    for each in (segments.start, segments.end, segments.radius, structure.width_m, structure.sightings):
        if len(each) != bars or len(structure.sigma_m) != bars:
            raise StructureError(f"{name}: {len(each)} rows for {bars} bars; expected one each")
    for what, array in (("start", segments.start), ("end", segments.end), ("joint", structure.joint)):
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if len(bad):
            owner = f"joint {bad[0]}" if what == "joint" else f"{what} of bar {bad[0]}"
            raise NonFiniteError(f"{name}: {owner} = {array[bad[0]].tolist()}; expected finite coordinates")
    sizes = (("width_m", structure.width_m), ("sigma_m", structure.sigma_m), ("radius", segments.radius))
    for what, value in sizes:
        for bar in np.flatnonzero(np.isinf(value) | (np.isnan(value) & (what == "radius"))):
            raise NonFiniteError(f"{name}: {what} of bar {bar} = {value[bar]}; expected a finite length")
    for what, amount in (*sizes, ("sightings", structure.sightings), ("points", segments.count)):
        for bar in np.flatnonzero(amount < 0):
            raise StructureError(f"{name}: {what} of bar {bar} = {amount[bar]}; expected 0 or more")
    for bar in np.flatnonzero(segments.length == 0):
        raise StructureError(f"{name}: bar {bar} starts and ends at {segments.start[bar].tolist()}; expected a length")
    for k, (joint, bar) in enumerate(structure.tie.tolist()):
        if not (0 <= joint < joints and 0 <= bar < bars):
            raise StructureError(f"{name}: tie {k} is of joint {joint} and bar {bar}; there are {joints} and {bars}")
    twice = len(structure.tie) - len(np.unique(structure.tie, axis=0))
    if twice:
        raise StructureError(f"{name}: {twice} ties given twice; expected each joint and bar once")
    return structure
