"""Made-up lattices and clouds of them."""

import itertools
from dataclasses import replace

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from steelnb.settings import TowerSettings
from steelnb.simulation import Member, Tower
from steelnb.simulation.mesh import ON_PLATE


def lattice(height: float = 15.0, base: float = 6.0, top: float = 3.0, panels: int = 5) -> np.ndarray:
    """Bars ``(M, 2, 3)`` of a square tower: four legs, rings, and X-bracing on each face."""
    levels = np.linspace(0, height, panels + 1)
    half = (base + (top - base) * levels / height) / 2
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    joint = np.stack([np.column_stack([corner * h, np.full(4, z)]) for h, z in zip(half, levels, strict=True)])
    bars = [(joint[0, j], joint[-1, j]) for j in range(4)]
    for k in range(panels):
        for j in range(4):
            n = (j + 1) % 4
            bars += [(joint[k, j], joint[k + 1, n]), (joint[k, n], joint[k + 1, j]), (joint[k + 1, j], joint[k + 1, n])]
    return np.array(bars)


def scanned(bars: np.ndarray, per_m: float, width: float, noise: float, seed: int = 0) -> np.ndarray:
    """Points on bars as wide as ``width``, with Gaussian ``noise``, metres."""
    rng = np.random.default_rng(seed)
    points = []
    for start, end in bars:
        n = rng.poisson(per_m * np.linalg.norm(end - start))
        points.append(start + rng.uniform(size=(n, 1)) * (end - start) + rng.uniform(-width / 2, width / 2, (n, 3)))
    cloud = np.concatenate(points)
    return cloud + rng.normal(scale=noise, size=cloud.shape)


TOWER = lattice(8, 4, 2, 3)
STEEL = scanned(TOWER, 400, 0.08, 0.005)


def sheet(width: float, height: float, noise_m: float = 0.005, per_m2: int = 2500, seed: int = 0) -> np.ndarray:
    """Points on a rectangle at z = 0 from the origin along x and y."""
    rng = np.random.default_rng(seed)
    count = int(per_m2 * width * height)
    flat = np.column_stack([rng.uniform(0, width, count), rng.uniform(0, height, count), np.zeros(count)])
    return flat + rng.normal(scale=noise_m, size=flat.shape)


def on_ground(points: np.ndarray, half_m: float, per_m2: int = 800) -> np.ndarray:
    """The points on a square of level ground."""
    size = 2 * half_m
    return np.concatenate([points, sheet(size, size, per_m2=per_m2) - [half_m, half_m, 0.0]])


def rods(rng: np.random.Generator, *ends, radius_m: float, per_m2: float = 2000, noise_m: float = 0.005) -> np.ndarray:
    """Points on round bars, with Gaussian noise."""
    points = []
    for start, end in np.array(ends, dtype=float):
        length_m = np.linalg.norm(end - start)
        axis = (end - start) / length_m
        n = int(per_m2 * 2 * np.pi * radius_m * length_m)
        first = np.cross(axis, [0.6, 0.8, 0.0] if axis[2] else [0, 0, 1])
        first /= np.linalg.norm(first)
        turn = rng.uniform(0, 2 * np.pi, (n, 1))
        around = radius_m * (np.cos(turn) * first + np.sin(turn) * np.cross(axis, first))
        points.append(start + rng.uniform(0, length_m, (n, 1)) * axis + around)
    return np.concatenate(points) + rng.normal(0, noise_m, (sum(map(len, points)), 3))


def tree(rng: np.random.Generator, x: float, y: float) -> np.ndarray:
    """Trunk, branches and leaves."""
    tips = [np.array([np.cos(turn), np.sin(turn), 0.8]) for turn in rng.uniform(0, 2 * np.pi, 12)]
    starts = [np.array([x, y, height]) for height in rng.uniform(2.0, 4.5, 12)]
    branches = [(start, start + rng.uniform(0.8, 1.6) * tip) for start, tip in zip(starts, tips, strict=True)]
    leaves = rng.normal(size=(8_000, 3)) * [0.8, 0.8, 1.0] + [x, y, 4.5]
    wood = [rods(rng, ((x, y, 0.0), (x, y, 5.0)), radius_m=0.1), rods(rng, *branches, radius_m=0.03)]
    return np.concatenate([*wood, leaves[leaves[:, 2] > 1.5]])


def bare_tree(rng: np.random.Generator, x: float, y: float) -> np.ndarray:
    """Trunk, limbs and twigs in all directions but down."""
    limbs, twigs = [], []
    for height in rng.uniform(1.5, 4.8, 12):
        turn, rise, length_m = rng.uniform((0, 0.2, 1.0), (2 * np.pi, 1.2, 2.0))
        start = np.array([x, y, height])
        limbs.append((start, start + length_m * np.array([np.cos(turn), np.sin(turn), rise])))
        for share, side in zip(rng.uniform(0.3, 0.9, 2), rng.normal(size=(2, 3)), strict=True):
            fork = start + share * (limbs[-1][1] - start)
            twigs.append((fork, fork + 0.9 * (limbs[-1][1] - start) / length_m + 0.5 * side))
    wood = rods(rng, ((x, y, 0.0), (x, y, 5.5)), radius_m=0.1), rods(rng, *limbs, radius_m=0.03)
    return np.concatenate([*wood, rods(rng, *twigs, radius_m=0.02)])


def gussets(rings: np.ndarray, size_m: float, per_m2: int = 2000, seed: int = 0) -> np.ndarray:
    """Points on upright square plates at both ends of horizontal bars ``rings (R, 2, 3)``, half above them."""
    rng, points = np.random.default_rng(seed), []
    for start, end in np.concatenate([rings, rings[:, ::-1]]):
        along, up = rng.uniform(0, size_m, (2, int(per_m2 * size_m**2), 1))
        inwards = (end - start) / np.linalg.norm(end - start)
        points.append(start + along * inwards + (up - size_m / 2) * [0, 0, 1])
    return np.concatenate(points) + rng.normal(0, 0.005, (sum(map(len, points)), 3))


def thinned(points: np.ndarray, apart: float) -> np.ndarray:
    """A subset in which no two points are closer than ``apart``, as in delivered LiDAR surveys."""
    tree, keep, gone = cKDTree(points), [], np.zeros(len(points), dtype=bool)
    for i in range(len(points)):
        if not gone[i]:
            keep.append(i)
            gone[tree.query_ball_point(points[i], apart)] = True
    return points[keep]


def pieces_of(tower) -> tuple[np.ndarray, int]:
    """Pairs of joints ``(P, 2)`` that a piece of a member connects, each once, and the number of connected parts."""
    ends = [sorted(ends) for member in tower.members for ends in itertools.pairwise(member.joints)]
    pieces, size = np.unique(ends, axis=0), len(tower.joints)
    return pieces, connected_components(coo_array((np.ones(len(pieces)), pieces.T), shape=(size, size)))[0]


def with_plate(tower: Tower, corner: np.ndarray) -> Tower:
    """The tower beside a plate, such as a wall, with corners ``(4, 3)``: two on one side, then two on the other."""
    triangle = len(tower.vertices) + np.array([[0, 1, 2], [1, 2, 3]])
    return replace(
        tower, vertices=np.concatenate([tower.vertices, corner]), triangles=np.concatenate([tower.triangles, triangle]),
        triangle_member=np.concatenate([tower.triangle_member, [ON_PLATE, ON_PLATE]]),
    )  # fmt: skip


def build_tubes(axes: np.ndarray, radius_m: float, sides: int = 48) -> Tower:
    """Round tubes along ``axes (M, 2, 3)``: open prisms whose polygon of ``sides`` has the area of the circle."""
    angle, low = 2 * np.pi * np.arange(sides) / sides, np.arange(sides)
    reach = radius_m * np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides)))
    outline, high = reach * np.column_stack([np.cos(angle), np.sin(angle)]), (low + 1) % sides
    wall = np.concatenate([np.stack([low, high, low + sides], 1), np.stack([high, high + sides, low + sides], 1)])
    members, vertices = [], []
    for k, (start, end) in enumerate(axes):
        axis = (end - start) / np.linalg.norm(end - start)
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        flanges = first, np.cross(axis, first)
        members.append(Member("tube", (2 * radius_m, radius_m), (2 * k, 2 * k + 1), *map(tuple, flanges), "round"))
        vertices += [start + outline @ flanges, end + outline @ flanges]
    triangles = np.concatenate([wall + 2 * sides * k for k in range(len(axes))])
    owner = np.repeat(np.arange(len(axes)), len(wall))
    return Tower(axes.reshape(-1, 3), tuple(members), np.concatenate(vertices), triangles, owner, TowerSettings())


def mesh_of(tower: Tower) -> trimesh.Trimesh:
    """A tower's triangles, to save them as a file."""
    return trimesh.Trimesh(tower.vertices, tower.triangles, process=False)
