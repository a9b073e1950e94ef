"""A lattice tower, built from a list of members or from a few dimensions: members, joints and surface mesh."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from steelnb.core.types import Array, IntArray
from steelnb.settings import TowerSettings
from steelnb.settings.world import Kind
from steelnb.simulation.member_list import JOINT_M, joints_of_members, leg_half_width, read_members
from steelnb.simulation.mesh import ON_PLATE, read_mesh

SIDES_THIN, SIDES, THIN_M = 8, 16, 0.08
"""Sides of round rods thinner than `THIN_M`, and of the others; surfaces are within 5.4 and 1.3 % of the circle's
radius."""
UPRIGHT, IN_FACE = 0.3, 0.5
"""A member is upright if the horizontal part of its unit direction is below `UPRIGHT`. Seen from above, a member in a
face has a slope of at most `IN_FACE` against that face."""


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


@dataclass(frozen=True, eq=False)
class Tower:
    """``joints (J, 3)`` metres, world frame; ``members``; and the triangle mesh: ``vertices (V, 3)`` metres,
    ``triangles (T, 3)`` and the member of each, ``triangle_member (T,)``, `ON_PLATE` for a plate."""

    joints: Array
    members: tuple[Member, ...]
    vertices: Array
    triangles: IntArray
    triangle_member: IntArray
    settings: TowerSettings

    def __repr__(self) -> str:
        return f"Tower({len(self.members)} members, {self.vertices[:, 2].max(initial=0.0):.1f} m high)"

    @property
    def axes(self) -> Array:
        """End points of the member axes, ``(M, 2, 3)`` metres, world frame."""
        return np.array([self.joints[[member.joints[0], member.joints[-1]]] for member in self.members])

    @property
    def plates(self) -> Array:
        """Triangles of the plates, ``(P, 3, 3)`` metres, world frame."""
        return self.vertices[self.triangles[self.triangle_member == ON_PLATE]]


def build_tower(settings: TowerSettings | None = None) -> Tower:
    """The tower of the settings (default: the preset ``tapered``), standing on z = 0 of the world frame, metres.

    Arms extend along ±x. The mesh has a closed prism for each member, or is that of a file; plates have no thickness.
    Nothing is random. Equal settings share one tower, whose arrays are read-only. Raises `InputError`.
    """
    settings = settings or TowerSettings()
    return _built(settings, settings.file_bytes())


@lru_cache(maxsize=8)  # the report's tower takes half a second, and each flight asks for it
def _built(settings: TowerSettings, _file_bytes: bytes) -> Tower:
    if settings.members is None:
        joints, members = _tapered_members(settings)
        plates = np.zeros((0, 3, 3))
    else:
        joints, members, plates = _listed_members(settings)
    vertices, triangles, owner = mesh_members(joints, members)
    triangles = np.concatenate([triangles, len(vertices) + np.arange(3 * len(plates)).reshape(-1, 3)])
    vertices = np.concatenate([vertices, plates.reshape(-1, 3)])
    owner = np.concatenate([owner, np.full(len(plates), ON_PLATE)])
    tower = Tower(joints, tuple(members), vertices, triangles, owner, settings)
    if settings.mesh is not None:
        vertices, triangles, owner = read_mesh(settings.mesh, tower.axes)
        tower = replace(tower, vertices=vertices, triangles=triangles, triangle_member=owner)
    for array in (joints, vertices, triangles, owner):
        array.setflags(write=False)
    return tower


def _listed_members(settings: TowerSettings) -> tuple[Array, list[Member], Array]:
    """Joints ``(J, 3)`` and members of the list ``settings.members``, and the triangles ``(P, 3, 3)`` of its plates.

    Joints are the ends of members and the points where they meet. Raises `InputError`.
    """
    kinds, ends, plates, widths = read_members(settings.members or "")
    joints, joints_of = joints_of_members(ends)
    middle, members = (ends.min(axis=(0, 1)) + ends.max(axis=(0, 1))) / 2, []
    for kind, (start, end), own, width in zip(kinds, ends - middle, joints_of, widths, strict=True):
        axis = unit(end - start)
        members.append(make_member(settings, kind, own, axis, *_flanges(axis, (start + end) / 2), width))
    return joints, members, plates


def _flanges(axis: Array, out: Array) -> tuple[Array, Array]:
    """Flange directions of a member with a unit ``axis``; ``out`` is its midpoint relative to the tower's centre.

    The flanges of an upright member point inwards along x and y. A member in a face has one flange in the face,
    pointing downwards, and one inwards. The second flange of a member inside the body points downwards.
    """
    down, run, inward = np.array([0.0, 0.0, -1.0]), np.abs(axis[:2]), np.diag(np.where(out > 0, -1.0, 1.0))
    face = int(np.argmin(run))
    if np.hypot(*run) < UPRIGHT:
        return inward[0], inward[1]
    if run[face] <= IN_FACE * run[1 - face] and abs(out[face]) > JOINT_M:
        first = np.cross(axis, inward[face])
        return first if first[2] < 0 else -first, inward[face]
    return np.cross(axis, down), down


def half_width(settings: TowerSettings, z: float) -> float:
    """Distance of the body's faces from its axis at height ``z``, metres: from the legs in a list of members, else from
    the profile. Raises `InputError`."""
    if settings.members is not None:
        return leg_half_width(settings.members, z)
    return float(np.interp(z, *np.transpose(settings.profile_m))) / 2


CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of x and y of the four legs; face k lies between corners k and k + 1."""
Bar = tuple[Kind, list[Array], Array, Array]
"""Kind, joints from end to end, and the directions of both flanges."""


def _tapered_members(settings: TowerSettings) -> tuple[Array, list[Member]]:
    """Joints ``(J, 3)`` and members, centred on the z axis: X-bracing up to the waist, K-bracing above it, and single
    bracing over the depth of the arms."""
    bars = [*_body(settings), *(bar for z, reach in settings.arms_m for side in (-1, 1)
                                for bar in _arm(settings, z, reach, side))]  # fmt: skip
    points = np.array([point for _, own, *_ in bars for point in own])
    _, first, label = np.unique(np.round(points * 1e5).astype(int), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # joints are numbered as they appear
    joints, number = points[first[order]], iter(np.argsort(order)[label.ravel()].tolist())
    members = []
    for kind, own, first_flange, second_flange in bars:
        ties = tuple(itertools.islice(number, len(own)))
        axis = unit(joints[ties[-1]] - joints[ties[0]])
        members.append(make_member(settings, kind, ties, axis, first_flange, second_flange))
    return joints, members


def _body(settings: TowerSettings) -> Iterator[Bar]:
    """Bracing, rings and legs."""
    _, (waist_m, _), (top_m, _) = settings.profile_m
    lower, upper = _panel_levels(settings), [waist_m]
    for z, _ in settings.arms_m:
        upper += [z, z + settings.arm_depth_m]
    if top_m - upper[-1] > 1e-6:
        upper.append(top_m)
    k_levels = upper[1::2]  # K-bracing meets the rings of these levels at mid-length

    def corner(k: int, z: float) -> Array:
        return np.array([*np.multiply(CORNERS[k % 4], half_width(settings, z)), z])

    for k in range(4):
        for low, high in itertools.pairwise(lower):
            a, b, c, d = corner(k, low), corner(k + 1, low), corner(k, high), corner(k + 1, high)
            share = np.linalg.norm(b - a) / (np.linalg.norm(b - a) + np.linalg.norm(d - c))
            crossing = a + share * (d - a)
            yield _in_face("bracing", k, [a, crossing, d])
            yield _in_face("bracing", k, [b, crossing, c])
        for panel, (low, high) in enumerate(itertools.pairwise(upper)):
            a, b, c, d = corner(k, low), corner(k + 1, low), corner(k, high), corner(k + 1, high)
            if panel % 2 == 0 and high in k_levels:
                yield _in_face("bracing", k, [a, (c + d) / 2])
                yield _in_face("bracing", k, [b, (c + d) / 2])
            else:
                yield _in_face("bracing", k, [a, d] if (panel + k) % 2 else [b, c])
    for z, k in itertools.product((*lower[1:], *upper[1:]), range(4)):
        a, b = corner(k, z), corner(k + 1, z)
        yield _in_face("ring", k, [a, (a + b) / 2, b] if z in k_levels else [a, b])
    for k, levels in itertools.product(range(4), (lower, upper)):
        inwards = -np.array([*CORNERS[k], 0.0])
        yield "leg", [corner(k, z) for z in levels], inwards * [1, 0, 0], inwards * [0, 1, 0]


def _in_face(kind: Kind, k: int, points: list[Array]) -> Bar:
    """A bar in face ``k`` with one flange in the face and one pointing inwards."""
    inward = -np.array([*np.add(CORNERS[k], CORNERS[(k + 1) % 4]) / 2.0, 0.0])
    return kind, points, np.cross(unit(points[-1] - points[0]), inward), inward


def _panel_levels(settings: TowerSettings) -> list[float]:
    """Heights of the rings up to the waist: panels are about 0.8 times as high as wide."""
    waist_m, levels = settings.profile_m[1][0], [0.0]
    while levels[-1] < waist_m:
        levels.append(levels[-1] + 0.8 * 2 * half_width(settings, levels[-1]))
    return [z * waist_m / levels[-1] for z in levels[:-1]] + [waist_m]


def _arm(settings: TowerSettings, z: float, reach: float, side: int) -> Iterator[Bar]:
    """A pyramid arm: two level bottom chords, two sloping top chords, three bays of webs."""
    tip, across, up = np.array([side * reach, 0.0, z]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    out = side * np.array([1.0, 0.0, 0.0])
    points: dict[tuple[int, int], list[Array]] = {}
    for y in (-1, 1):
        for level, height in enumerate((z, z + settings.arm_depth_m)):
            half = half_width(settings, height)
            root = np.array([side * half, y * half, height])
            points[y, level] = [root + share * (tip - root) for share in (0.0, 1 / 3, 2 / 3)] + [tip]
            yield "arm", points[y, level], -y * across, up if level == 0 else -up
        for bay in (1, 2):
            yield "arm", [points[y, 0][bay], points[y, 1][bay]], -out, -y * across
        for bay in (0, 1):
            yield "arm", [points[y, 1][bay], points[y, 0][bay + 1]], out, -y * across
    for bay in (1, 2):
        yield "arm", [points[-1, 0][bay], points[1, 0][bay]], -out, up
        yield "arm", [points[-1, 0][bay - 1], points[1, 0][bay]], out, up
