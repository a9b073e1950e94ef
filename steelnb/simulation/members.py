"""Members of a tower, and the mesh of their sections: equal-leg angles or round rods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from steelnb.core.types import Array, IntArray
from steelnb.settings import TowerSettings
from steelnb.settings.world import Kind

GROUND, ON_PLATE = -1, -2
"""Used in place of a member's index: the ground, and a steel plate, which is not a bar. Constants of kernels (njit)."""
SIDES_THIN, SIDES, THIN_M = 8, 16, 0.08
"""Sides of round rods thinner than `THIN_M`, and of the others; surfaces are within 5.4 and 1.3 % of the circle's
radius."""


@dataclass(frozen=True)
class Member:
    """A straight bar. The axis of an angle is its heel, the outer corner; that of a round rod is its centre line.

    ``kind``: leg, ring, bracing, arm or secondary; ``section_m``: width and thickness of the flanges, or diameter and
    radius; ``joints``: indices of its joints from end to end; ``flange_a``, ``flange_b``: unit vectors from the heel
    along the flanges, world frame; for a round rod, any two directions perpendicular to the axis.
    """

    kind: Kind
    section_m: tuple[float, float]
    joints: tuple[int, ...]
    flange_a: tuple[float, float, float]
    flange_b: tuple[float, float, float]
    section: Literal["angle", "round"] = "angle"


def unit(vector: Array) -> Array:
    """A vector scaled to length 1."""
    return np.asarray(vector / np.linalg.norm(vector))


def make_member(
    settings: TowerSettings, kind: Kind, joints: tuple[int, ...], axis: Array, first: Array, second: Array,
    own_width: float | None = None,
) -> Member:  # fmt: skip
    """A member with the section of its kind, or that section scaled to its ``own_width``. Its flanges are made
    perpendicular to the unit ``axis`` and to each other, by Gram-Schmidt: ``second`` before ``first``."""
    second = unit(second - (second @ axis) * axis)
    first = first - (first @ axis) * axis
    first = unit(first - (first @ second) * second)
    width, thickness = settings.sections_m[kind]
    if own_width is not None:
        width, thickness = own_width, thickness * own_width / width
    size = (width, thickness if settings.section == "angle" else width / 2)
    return Member(kind, size, joints, tuple(first.tolist()), tuple(second.tolist()), settings.section)


def mesh_members(joints: Array, members: Sequence[Member]) -> tuple[Array, IntArray, IntArray]:
    """Closed prisms with the outlines of the sections: vertices ``(V, 3)``, triangles ``(T, 3)`` and the member of each
    ``(T,)``. The vertices of a member are consecutive, those at its first joint first."""
    vertices, triangles, count = [], [], 0
    for member in members:
        outline, prism = _angle(*member.section_m), _ANGLE_PRISM
        start, end = joints[[member.joints[0], member.joints[-1]]]
        if member.section == "round":
            sides = SIDES_THIN if member.section_m[0] < THIN_M else SIDES
            outline, prism = _circle(member.section_m[0] / 2, sides), _ROUND_PRISMS[sides]
            if np.cross(member.flange_a, member.flange_b) @ (end - start) < 0:
                prism = prism[:, ::-1]
        offset = outline @ np.array([member.flange_a, member.flange_b])
        vertices += [start + offset, end + offset]
        triangles.append(count + prism)
        count += 2 * len(outline)
    owner = np.repeat(np.arange(len(members)), [len(prism) for prism in triangles])
    return np.concatenate(vertices), np.concatenate(triangles), owner


def _angle(width: float, thickness: float) -> Array:
    return np.array([(0, 0), (width, 0), (width, thickness), (thickness, thickness), (thickness, width), (0, width)])


def _circle(radius_m: float, sides: int) -> Array:
    """A regular polygon with the area of the circle."""
    angle, reach = 2 * np.pi * np.arange(sides) / sides, np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides)))
    return np.asarray(radius_m * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))


_SIDES = [t for i in range(6) for j in [(i + 1) % 6] for t in ((i, j, 6 + j), (i, 6 + j, 6 + i))]
_ENDS = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
_ANGLE_PRISM = np.array([*_SIDES, *(t[::-1] for t in _ENDS), *(tuple(6 + i for i in t) for t in _ENDS)])
"""Triangles of a closed prism with the outline of `_angle`: corners 0–5 at the start, 6–11 at the end."""


def _round_prism(sides: int) -> IntArray:
    """The same for the outline of `_circle`."""
    low = np.arange(sides)
    high, fan = np.roll(low, -1), np.stack([0 * low[2:], low[1:-1], low[2:]], 1)
    walls = np.stack([low, high, low + sides], 1), np.stack([high, high + sides, low + sides], 1)
    return np.concatenate([*walls, fan[:, ::-1], sides + fan])


_ROUND_PRISMS = {sides: _round_prism(sides) for sides in (SIDES_THIN, SIDES)}
