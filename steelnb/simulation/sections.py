"""Members of a tower, and the mesh of their sections: equal-leg angles or round rods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from steelnb.types import Array, IntArray

GROUND, PLATE = -1, -2
"""In place of a member: the ground, which is no steel; and a plate, which is steel, but no bar."""
SIDES = 16
"""Sides of a round rod: its surface is within 1.3 % of the radius of the circle's."""


@dataclass(frozen=True)
class Member:
    """A straight bar. The axis of an angle is its heel, the outer corner; that of a round rod is its centre line.

    ``kind`` leg, ring, bracing, arm or secondary; ``section_m`` width and thickness of the flanges, or diameter and
    radius; ``joints`` on it, from end to end; ``flange_a``, ``flange_b`` unit vectors from the heel along the flanges,
    world frame, which for a round rod are just two directions across the axis.
    """

    kind: str
    section_m: tuple[float, float]
    joints: tuple[int, ...]
    flange_a: tuple[float, float, float]
    flange_b: tuple[float, float, float]
    section: Literal["angle", "round"] = "angle"


def unit(vector: Array) -> Array:
    """A vector of length 1 in the same direction."""
    return np.asarray(vector / np.linalg.norm(vector))


Vector = tuple[float, float, float]


def across(axis: Array, first: Array, second: Array) -> tuple[Vector, Vector]:
    """Unit vectors across a unit ``axis``, at a right angle to each other: ``second`` is turned the least."""
    second = unit(second - (second @ axis) * axis)
    first = first - (first @ axis) * axis
    first = unit(first - (first @ second) * second)
    return tuple(first.tolist()), tuple(second.tolist())


def mesh_members(
    joints: Array, members: Sequence[Member], sides: int = SIDES, closed: bool = True
) -> tuple[Array, IntArray, IntArray]:
    """Prisms over the outlines of the sections: vertices ``(V, 3)``, triangles ``(T, 3)`` and their members ``(T,)``.

    The vertices of a member follow each other, those at its first joint first. ``closed``: round rods have ends.
    """
    vertices, triangles, count = [], [], 0
    for member in members:
        outline, prism = _angle(*member.section_m), _ANGLE_PRISM
        start, end = joints[[member.joints[0], member.joints[-1]]]
        if member.section == "round":
            outline, prism = _circle(member.section_m[0] / 2, sides), _round_prism(sides, closed)
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


_SIDES = [t for i in range(6) for j in [(i + 1) % 6] for t in ((i, j, 6 + j), (i, 6 + j, 6 + i))]
_ENDS = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
_ANGLE_PRISM = np.array([*_SIDES, *(t[::-1] for t in _ENDS), *(tuple(6 + i for i in t) for t in _ENDS)])
"""Triangles of a closed prism over an L-shaped outline of six corners, the lower one first."""


def _circle(radius_m: float, sides: int) -> Array:
    """A regular polygon of the same area as the circle."""
    angle, reach = 2 * np.pi * np.arange(sides) / sides, np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides)))
    return np.asarray(radius_m * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _round_prism(sides: int, closed: bool) -> IntArray:
    low = np.arange(sides)
    high = (low + 1) % sides
    wall = [np.stack([low, high, low + sides], 1), np.stack([high, high + sides, low + sides], 1)]
    end = np.stack([np.zeros_like(low[2:]), low[1:-1], low[2:]], 1)
    return np.concatenate([*wall, end[:, ::-1], sides + end] if closed else wall)
