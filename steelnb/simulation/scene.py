"""Viewing rays, and what they hit: ray casting against a tower's mesh (Open3D, Embree) on one thread.

The same bits on every processor: see `cast_bundle`.
"""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import njit

from steelnb.libraries import import_open3d
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray

STEPS_PER_M = 65536.0
TOUCH_M = 1e-5
"""Surfaces this near to each other are too near for float32 to tell which a ray hits first."""


class Pinhole(Protocol):
    """Settings of a camera: the size of its image and its fields of view."""

    @property
    def columns(self) -> int: ...
    @property
    def rows(self) -> int: ...
    @property
    def fov_horizontal_rad(self) -> float: ...
    @property
    def fov_vertical_rad(self) -> float: ...


def rays(settings: Pinhole) -> Array:
    """Unit viewing rays ``(rows, columns, 3)`` in the sensor frame: x along the optical axis, y left, z up."""
    u = (np.arange(settings.columns) + 0.5) / settings.columns * 2 - 1
    v = (np.arange(settings.rows) + 0.5) / settings.rows * 2 - 1
    ray = np.ones((settings.rows, settings.columns, 3))
    ray[..., 1] = -np.tan(settings.fov_horizontal_rad / 2) * u
    ray[..., 2] = -np.tan(settings.fov_vertical_rad / 2) * v[:, None]
    return np.asarray(ray / np.linalg.norm(ray, axis=2, keepdims=True))


class Scene(NamedTuple):
    """The mesh of a tower on the ground plane. Open3D tells which of its T triangles a ray hits, and the plane of that
    triangle how far away.

    ``mesh``: Open3D's; ``member (T + 1,)``: of each triangle, −1 for the ground and, as the last entry, for no hit;
    ``corner (T, 3, 3)`` metres; ``plane (T, 4)``: unit normal n and offset d of n · x = d; ``begin (T + 1,)``: where in
    ``touching`` the later triangles begin, the last of them first, that touch, cross or overlap each.
    """

    mesh: Any
    member: IntArray
    corner: Array
    plane: Array
    begin: IntArray
    touching: IntArray


def make_scene(tower: Tower) -> Scene:
    """The scene of a tower that stands on z = 0."""
    open3d = import_open3d()
    ground = tower.settings.floor_half_m * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([tower.vertices, ground])
    n = len(tower.vertices)
    triangles = np.concatenate([tower.triangles, [(n, n + 1, n + 2), (n, n + 2, n + 3)]])
    mesh = open3d.t.geometry.RaycastingScene(nthreads=1)
    tensor = open3d.core.Tensor.from_numpy
    mesh.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))
    corner = np.ascontiguousarray(vertices[triangles], dtype=np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    plane = np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)])
    begin, touching = _touching(corner, plane)
    return Scene(mesh, np.append(tower.triangle_member, [-1, -1, -1]), corner, plane, begin, touching)


@njit(cache=True)
def _touching(corner, plane):
    """See `Scene`; of those in one plane, all whose boxes overlap."""
    count, size = len(corner), 0
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        for k in range(3):
            low[i, k] = min(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) - TOUCH_M
            high[i, k] = max(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) + TOUCH_M
    begin, touching = np.zeros(count + 1, np.int64), np.empty(1024, np.int64)
    for i in range(count):
        for j in range(count - 1, i, -1):
            if (
                low[i, 0] <= high[j, 0] and low[j, 0] <= high[i, 0]
                and low[i, 1] <= high[j, 1] and low[j, 1] <= high[i, 1]
                and low[i, 2] <= high[j, 2] and low[j, 2] <= high[i, 2]
                and (_pierces(corner[i], corner[j], plane[j]) or _pierces(corner[j], corner[i], plane[i]))
            ):  # fmt: skip
                if size == len(touching):
                    touching = np.concatenate((touching, np.empty_like(touching)))
                touching[size] = j
                size += 1
        begin[i + 1] = size
    return begin, touching[:size].copy()


@njit(cache=True)
def _pierces(edges, corner, plane):
    """Whether an edge of a triangle ``edges (3, 3)`` meets another one, or all of them lie in its plane."""
    flat, place = True, np.empty(3)
    for k in range(3):
        a, b = edges[k], edges[(k + 1) % 3]
        from_a, from_b = _height(plane, a), _height(plane, b)
        flat = flat and abs(from_a) <= TOUCH_M
        if abs(from_a) > TOUCH_M and from_a * from_b > 0.0 and abs(from_b) > TOUCH_M:
            continue
        share = 0.0 if abs(from_a) <= TOUCH_M else min(max(from_a / (from_a - from_b), 0.0), 1.0)
        for i in range(3):
            place[i] = a[i] + share * (b[i] - a[i])
        if _holds(corner, plane, place):
            return True
    return flat


@njit(cache=True)
def _height(plane, place):
    """Of a place above a plane."""
    return plane[0] * place[0] + plane[1] * place[1] + plane[2] * place[2] - plane[3]


def cast_rays(scene: Scene, T_world_sensor: Array, ray: Array) -> tuple[np.ndarray, IntArray]:
    """Exact ranges ``(K, H, W)`` float32 in metres from K poses ``(K, 4, 4)``, infinite for no hit, and the member hit,
    −1 for the ground and for none. ``ray (H, W, 3)``: unit vectors in the sensor frame."""
    flat = ray.reshape(-1, 3).astype(np.float32)
    bundle = np.empty((len(T_world_sensor), len(flat), 6), dtype=np.float32)
    bundle[:, :, :3] = T_world_sensor[:, None, :3, 3]
    for k, T in enumerate(T_world_sensor):
        np.matmul(flat, T[:3, :3].T.astype(np.float32), out=bundle[k, :, 3:])
    hit, shape = cast_bundle(scene, bundle), (len(T_world_sensor), *ray.shape[:2])
    return hit.range_m.reshape(shape), hit.member.reshape(shape)


class Hits(NamedTuple):
    """``range_m (...)`` float32, infinite for no hit; ``member (...)``, −1 for the ground and for none; ``normal
    (..., 3)`` float32, unit normals of the triangles hit, of either sign, zero for no hit."""

    range_m: np.ndarray
    member: IntArray
    normal: np.ndarray


def cast_bundle(scene: Scene, bundle: np.ndarray) -> Hits:
    """What rays ``(..., 6)`` float32, origins and unit directions in the world frame, hit first.

    Embree's own distance holds the processor's approximate reciprocal, which differs from vendor to vendor. So only the
    triangle is Embree's, and of several that a ray hits in one place the last is taken; the distance is that to its
    plane, in float64, to the nearest 2⁻¹⁶ m (15 µm).
    """
    hit = scene.mesh.cast_rays(import_open3d().core.Tensor.from_numpy(bundle), nthreads=1)
    shape, triangle = bundle.shape[:-1], hit["primitive_ids"].numpy().ravel()
    range_m, normal = np.empty(len(triangle), np.float32), np.empty((len(triangle), 3), np.float32)
    member = np.empty(len(triangle), np.int64)
    _measure(bundle.reshape(-1, 6), triangle, *scene[1:], range_m, member, normal)
    return Hits(range_m.reshape(shape), member.reshape(shape), normal.reshape(*shape, 3))


@njit(cache=True)
def _measure(bundle, triangle, member_of, corner, plane, begin, touching, range_m, member, normal):
    """Fill in `Hits` of the rays ``bundle (N, 6)`` and the ``triangle (N,)`` each hits, beyond the last for none."""
    ray, place = np.empty(6), np.empty(3)
    for i in range(len(triangle)):
        t = np.int64(triangle[i])
        if t >= len(corner):
            range_m[i], member[i] = np.inf, -1
            normal[i, 0] = normal[i, 1] = normal[i, 2] = 0.0
            continue
        for k in range(6):
            ray[k] = bundle[i, k]
        distance = _distance(ray, corner[t], plane[t])
        for k in range(3):
            place[k] = ray[k] + distance * ray[3 + k]
        for s in range(begin[t], begin[t + 1]):
            other = touching[s]
            if abs(_height(plane[other], place)) < TOUCH_M and _holds(corner[other], plane[other], place):
                t, distance = other, _distance(ray, corner[other], plane[other])
                break
        range_m[i] = max(math.floor(distance * STEPS_PER_M + 0.5) / STEPS_PER_M, 0.0)
        member[i] = member_of[t]
        for k in range(3):
            normal[i, k] = plane[t, k]


@njit(cache=True)
def _distance(ray, corner, plane):
    """Distance along a ``ray (6,)`` to a plane; no nearer or farther than the triangle, of which the ray hits a corner
    where it grazes."""
    nearest, farthest = np.inf, -np.inf
    for k in range(3):
        along = 0.0
        for i in range(3):
            along += (corner[k, i] - ray[i]) * ray[3 + i]
        nearest, farthest = min(nearest, along), max(farthest, along)
    slope = plane[0] * ray[3] + plane[1] * ray[4] + plane[2] * ray[5]
    if slope == 0.0:
        return nearest
    return min(max(-_height(plane, ray) / slope, nearest), farthest)


@njit(cache=True)
def _holds(corner, plane, place):
    """Whether a place in the plane of a triangle lies in it, or on its edge. Its corners run to the left about the
    normal."""
    for k in range(3):
        a, b = corner[k], corner[(k + 1) % 3]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        px, py, pz = place[0] - a[0], place[1] - a[1], place[2] - a[2]
        left = (ey * pz - ez * py) * plane[0] + (ez * px - ex * pz) * plane[1] + (ex * py - ey * px) * plane[2]
        if left < -TOUCH_M * math.sqrt(ex * ex + ey * ey + ez * ez):
            return False
    return True
