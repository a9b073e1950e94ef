"""A lattice tower, built from a list of members or from a few dimensions: members, joints and surface mesh."""

import itertools
from dataclasses import dataclass, field

import numpy as np

from steelnb.settings import TowerSettings
from steelnb.simulation.lattice import build_lattice, leg_half_width
from steelnb.simulation.sections import PLATE, Member, mesh_members, orthonormal_flanges, unit
from steelnb.types import Array, IntArray


@dataclass(frozen=True)
class Tower:
    """``joints (J, 3)`` metres, world frame; ``members``; and the triangle mesh: ``vertices (V, 3)`` metres,
    ``triangles (T, 3)`` and the member of each, ``triangle_member (T,)``, `PLATE` for a plate."""

    joints: Array
    members: tuple[Member, ...]
    vertices: Array
    triangles: IntArray
    triangle_member: IntArray
    settings: TowerSettings

    @property
    def axes(self) -> Array:
        """End points of the member axes, ``(M, 2, 3)`` metres, world frame."""
        return np.array([self.joints[[member.joints[0], member.joints[-1]]] for member in self.members])

    @property
    def plates(self) -> Array:
        """Triangles of the plates, ``(P, 3, 3)`` metres, world frame."""
        return self.vertices[self.triangles[self.triangle_member == PLATE]]


def half_width(settings: TowerSettings, z: float) -> float:
    """Distance of the body's faces from its axis at height ``z``, metres: from the legs in a list of members, else from
    the two tapers that meet at the waist. Raises `InputError`."""
    if settings.members is not None:
        return leg_half_width(settings.members, z)
    heights = (0.0, settings.waist_height_m, settings.height_m)
    widths = (settings.base_width_m, settings.waist_width_m, settings.top_width_m)
    return float(np.interp(z, heights, widths)) / 2


CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of x and y of the four legs; face k lies between corners k and k + 1."""


@dataclass
class _Builder:
    settings: TowerSettings
    joints: list[Array] = field(default_factory=list)
    known: dict[tuple[int, int, int], int] = field(default_factory=dict)
    members: list[Member] = field(default_factory=list)

    def joint(self, position: Array) -> int:
        key = tuple(np.round(np.asarray(position) * 1e5).astype(int))
        if key not in self.known:
            self.known[key] = len(self.joints)
            self.joints.append(np.asarray(position, dtype=np.float64))
        return self.known[key]

    def corner(self, k: int, z: float) -> Array:
        half = half_width(self.settings, z)
        return np.array([CORNERS[k % 4][0] * half, CORNERS[k % 4][1] * half, z])

    def add(self, kind: str, points: list[Array], flange_a: Array, flange_b: Array) -> None:
        """Add a bar through ``points``; its flanges are made perpendicular to the axis, ``flange_b`` first."""
        joints = tuple(self.joint(point) for point in points)
        flanges = orthonormal_flanges(unit(self.joints[joints[-1]] - self.joints[joints[0]]), flange_a, flange_b)
        size = getattr(self.settings, f"{kind}_section_m")
        self.members.append(Member(kind, size, joints, *flanges, self.settings.section))

    def in_face(self, kind: str, k: int, points: list[Array]) -> None:
        """Add a bar in face ``k`` with one flange in the face and one pointing inwards."""
        inward = -np.array([*np.add(CORNERS[k], CORNERS[(k + 1) % 4]) / 2.0, 0.0])
        axis = unit(points[-1] - points[0])
        self.add(kind, points, np.cross(axis, inward), inward)


def build_tower(settings: TowerSettings | None = None) -> Tower:
    """The tower of the settings (default: the preset ``tapered``), standing on z = 0 of the world frame, metres.

    Arms extend along ±x. The mesh has a closed prism for each member. Nothing is random. Raises `InputError`.
    """
    settings = settings or TowerSettings()
    return Tower(*(_build_tapered(settings) if settings.members is None else build_lattice(settings)), settings)


def _build_tapered(settings: TowerSettings) -> tuple[Array, tuple[Member, ...], Array, IntArray, IntArray]:
    """X-bracing up to the waist, K-bracing between the arms, single bracing over their depth; centred on the z axis."""
    build = _Builder(settings)
    lower = _panel_levels(settings)
    upper = [settings.waist_height_m]
    for z, _ in settings.arms_m:
        upper += [z, z + settings.arm_depth_m]
    if settings.height_m - upper[-1] > 1e-6:
        upper.append(settings.height_m)

    for k in range(4):
        _braced_face(build, k, lower, upper)
    for z in (*lower[1:], *upper[1:]):
        for k in range(4):
            a, b = build.corner(k, z), build.corner(k + 1, z)
            # K-bracing meets the rings of every second upper level at mid-length
            build.in_face("ring", k, [a, (a + b) / 2, b] if z in upper[1::2] else [a, b])
    for k in range(4):
        inwards = -np.array([*CORNERS[k], 0.0])
        flanges = inwards * [1, 0, 0], inwards * [0, 1, 0]
        build.add("leg", [build.corner(k, z) for z in lower], *flanges)
        build.add("leg", [build.corner(k, z) for z in upper], *flanges)
    for z, reach in settings.arms_m:
        for side in (-1, 1):
            _arm(build, z, reach, side)

    joints = np.array(build.joints)
    return joints, tuple(build.members), *mesh_members(joints, build.members)


def _panel_levels(settings: TowerSettings) -> list[float]:
    """Heights of the rings up to the waist: panels are about 0.8 times as high as wide."""
    levels = [0.0]
    while levels[-1] < settings.waist_height_m:
        levels.append(levels[-1] + 0.8 * 2 * half_width(settings, levels[-1]))
    return [z * settings.waist_height_m / levels[-1] for z in levels[:-1]] + [settings.waist_height_m]


def _braced_face(build: _Builder, k: int, lower: list[float], upper: list[float]) -> None:
    for low, high in itertools.pairwise(lower):
        a, b, c, d = build.corner(k, low), build.corner(k + 1, low), build.corner(k, high), build.corner(k + 1, high)
        share = np.linalg.norm(b - a) / (np.linalg.norm(b - a) + np.linalg.norm(d - c))
        crossing = a + share * (d - a)
        build.in_face("bracing", k, [a, crossing, d])
        build.in_face("bracing", k, [b, crossing, c])
    for panel, (low, high) in enumerate(itertools.pairwise(upper)):
        a, b, c, d = build.corner(k, low), build.corner(k + 1, low), build.corner(k, high), build.corner(k + 1, high)
        if panel % 2 == 0 and high in upper[1::2]:
            build.in_face("bracing", k, [a, (c + d) / 2])
            build.in_face("bracing", k, [b, (c + d) / 2])
        else:
            build.in_face("bracing", k, [a, d] if (panel + k) % 2 else [b, c])


def _arm(build: _Builder, z: float, reach: float, side: int) -> None:
    """A pyramid arm: two level bottom chords, two sloping top chords, three bays of webs."""
    tip = np.array([side * reach, 0.0, z])
    up, out = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    shares = (1 / 3, 2 / 3)
    points: dict[tuple[int, int], list[Array]] = {}
    for y in (-1, 1):
        for level, height in enumerate((z, z + build.settings.arm_depth_m)):
            half = half_width(build.settings, height)
            root = np.array([side * half, y * half, height])
            points[y, level] = [root + share * (tip - root) for share in (0.0, *shares)] + [tip]
            build.add("arm", points[y, level], -y * out, up if level == 0 else -up)
        for bay in (1, 2):
            build.add("arm", [points[y, 0][bay], points[y, 1][bay]], side * np.array([-1.0, 0, 0]), -y * out)
        for bay in (0, 1):
            build.add("arm", [points[y, 1][bay], points[y, 0][bay + 1]], side * np.array([1.0, 0, 0]), -y * out)
    for bay in (1, 2):
        build.add("arm", [points[-1, 0][bay], points[1, 0][bay]], side * np.array([-1.0, 0, 0]), up)
        build.add("arm", [points[-1, 0][bay - 1], points[1, 0][bay]], side * np.array([1.0, 0, 0]), up)
