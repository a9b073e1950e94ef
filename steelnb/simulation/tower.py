"""A lattice tower, built from a list of members or from a few dimensions: members, joints and surface mesh."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from steelnb.core.arguments import checks_arguments
from steelnb.core.types import Array, IntArray
from steelnb.settings import TowerSettings
from steelnb.settings.world import Kind
from steelnb.simulation.member_list import leg_half_width, listed_members
from steelnb.simulation.members import ON_PLATE, Member, make_member, mesh_members, unit
from steelnb.simulation.mesh_file import read_mesh


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


@checks_arguments
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
        joints, members, plates = listed_members(settings)
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
