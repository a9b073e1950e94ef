"""Ray casting against a tower's mesh (Open3D, Embree) on one thread.

Results are bit-identical on every processor; `cast_bundle` explains how.
"""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.open3d import import_open3d
from steelnb.core.types import Array, IntArray
from steelnb.settings import CameraSettings
from steelnb.simulation.mesh import TOUCH_M
from steelnb.simulation.tower import Tower


class Triangles(NamedTuple):
    """T triangles in the world frame, metres.

    ``corner (T, 3, 3)``; ``plane (T, 4)``: unit normal n and offset d of n · x = d.
    ``touching[begin[t] : begin[t + 1]]``: triangles that touch, cross or overlap triangle t, descending.
    """

    corner: Array
    plane: Array
    begin: IntArray
    touching: IntArray


def make_triangles(corner: Array) -> Triangles:
    """Triangles with corners ``(T, 3, 3)``, metres, world frame."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    plane = np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)])
    one, other = _touching_pairs(corner, plane).T
    one, other = np.append(one, other), np.append(other, one)
    order = np.lexsort((-other, one))
    begin = np.searchsorted(one[order], np.arange(len(corner) + 1))
    return Triangles(corner, plane, begin, other[order])


@njit(cache=True)
def _touching_pairs(corner, plane):
    """Pairs ``(P, 2)`` of triangles that touch, cross or overlap. Coplanar ones count if their boxes overlap."""
    count, size = len(corner), 0
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        for k in range(3):
            low[i, k] = min(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) - TOUCH_M
            high[i, k] = max(corner[i, 0, k], corner[i, 1, k], corner[i, 2, k]) + TOUCH_M
    pair = np.empty((1024, 2), np.int64)
    along_z = np.argsort(low[:, 2])  # a triangle can only touch those that begin before it ends; a tower is tall
    for place in range(count):
        i = along_z[place]
        for later in range(place + 1, count):
            j = along_z[later]
            if low[j, 2] > high[i, 2]:
                break
            if (
                low[i, 0] <= high[j, 0] and low[j, 0] <= high[i, 0]
                and low[i, 1] <= high[j, 1] and low[j, 1] <= high[i, 1]
                and (_edge_meets(corner, plane, i, j) or _edge_meets(corner, plane, j, i))
            ):  # fmt: skip
                if size == len(pair):
                    pair = np.concatenate((pair, np.empty_like(pair)))
                pair[size, 0], pair[size, 1] = i, j
                size += 1
    return pair[:size].copy()


@njit(cache=True)
def _edge_meets(corner, plane, i, j):
    """Whether an edge of triangle ``i`` meets triangle ``j``, or the two are coplanar."""
    flat = True
    for k in range(3):
        a, b = corner[i, k], corner[i, (k + 1) % 3]
        from_a, from_b = signed_distance(plane[j], a), signed_distance(plane[j], b)
        flat = flat and abs(from_a) <= TOUCH_M
        if abs(from_a) > TOUCH_M and from_a * from_b > 0.0 and abs(from_b) > TOUCH_M:
            continue
        share = 0.0 if abs(from_a) <= TOUCH_M else min(max(from_a / (from_a - from_b), 0.0), 1.0)
        point = a + share * (b - a)
        if contains(corner, plane, j, point[0], point[1], point[2]):
            return True
    return flat


@njit(cache=True)
def signed_distance(plane, point):
    """Signed distance of a point to a plane."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] - plane[3]


@njit(cache=True)
def ray_distance(ray, corner, plane):
    """Distance along a ``ray (6,)`` to a plane, clamped to the range of the triangle's corners, for grazing rays."""
    nearest, farthest = np.inf, -np.inf
    for k in range(3):
        along = 0.0
        for i in range(3):
            along += (corner[k, i] - ray[i]) * ray[3 + i]
        nearest, farthest = min(nearest, along), max(farthest, along)
    slope = plane[0] * ray[3] + plane[1] * ray[4] + plane[2] * ray[5]
    if slope == 0.0:
        return nearest
    return min(max(-signed_distance(plane, ray) / slope, nearest), farthest)


@njit(cache=True)
def contains(corner, plane, t, x, y, z):
    """Whether a point in the plane of triangle ``t`` is inside it, or outside by at most `TOUCH_M`. The corners run
    anticlockwise about the normal."""
    for k in range(3):
        n = (k + 1) % 3
        ax, ay, az = corner[t, k, 0], corner[t, k, 1], corner[t, k, 2]
        ex, ey, ez = corner[t, n, 0] - ax, corner[t, n, 1] - ay, corner[t, n, 2] - az
        px, py, pz = x - ax, y - ay, z - az
        left = (ey * pz - ez * py) * plane[t, 0] + (ez * px - ex * pz) * plane[t, 1] + (ex * py - ey * px) * plane[t, 2]
        if left < 0.0 and left * left > TOUCH_M * TOUCH_M * (ex * ex + ey * ey + ez * ez):
            return False
    return True


STEPS_PER_M = 65536.0
"""Ranges are rounded to this resolution."""
MARGIN_M = 2e-5
"""Embree's triangles are enlarged by this margin on each side."""
RESTART_M = np.float32(4e-6)
"""A ray that has missed a triangle restarts this far behind it: twice the rounding of float32 at 16 m."""


def rays(camera: CameraSettings, origin_px: float = 0.5) -> Array:
    """Unit viewing rays ``(rows, columns, 3)`` in the sensor frame: x along the optical axis, y left, z up.

    ``origin_px``: the point of each pixel, from its upper left corner (0) to its lower right one (1).
    """
    fov_rad = camera.fov_horizontal_rad, camera.fov_vertical_rad
    return _rays(camera.columns, camera.rows, *fov_rad, origin_px).copy()  # the caller's own


@functools.lru_cache(maxsize=8)  # each scan needs them several times
def _rays(columns: int, rows: int, fov_horizontal_rad: float, fov_vertical_rad: float, origin_px: float) -> Array:
    u = (np.arange(columns) + origin_px) / columns * 2 - 1
    v = (np.arange(rows) + origin_px) / rows * 2 - 1
    ray = np.ones((rows, columns, 3))
    ray[..., 1] = -np.tan(fov_horizontal_rad / 2) * u
    ray[..., 2] = -np.tan(fov_vertical_rad / 2) * v[:, None]
    return np.asarray(ray / np.linalg.norm(ray, axis=2, keepdims=True))


class RayScene(NamedTuple):
    """The T triangles of a tower and of the ground under it, in the world frame, metres.

    ``mesh``: Open3D's scene of the triangles, enlarged by `MARGIN_M`; ``triangles``: as they are; ``member (T + 1,)``
    of each triangle, −1 for the ground and, as the last entry, for no hit.
    """

    mesh: Any
    triangles: Triangles
    member: IntArray


@functools.lru_cache(maxsize=2)  # a second or more, and each flight of a notebook asks for it
def make_scene(tower: Tower) -> RayScene:
    """The scene of a tower on the ground at z = 0. Flights share that of the same tower."""
    open3d = import_open3d()
    ground = tower.settings.floor_half_m * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    corner = np.concatenate([tower.vertices[tower.triangles], ground[[(0, 1, 2), (0, 2, 3)]]]).astype(np.float64)
    count = len(corner)
    mesh = open3d.t.geometry.RaycastingScene(nthreads=1)
    tensor, number = open3d.core.Tensor.from_numpy, np.arange(3 * count, dtype=np.uint32)
    mesh.add_triangles(tensor(_enlarged(corner).reshape(-1, 3).astype(np.float32)), tensor(number.reshape(-1, 3)))
    return RayScene(mesh, make_triangles(corner), np.append(tower.triangle_member, [-1, -1, -1]))


def _enlarged(corner: Array) -> Array:
    """Triangles ``(T, 3, 3)`` scaled about their incentres so that each edge moves out by `MARGIN_M`."""
    side = np.linalg.norm(np.roll(corner, -1, axis=1) - np.roll(corner, 1, axis=1), axis=2)  # opposite each corner
    perimeter = side.sum(axis=1)
    centre = (side[..., None] * corner).sum(axis=1) / perimeter[:, None]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    factor = 1 + MARGIN_M * perimeter / (2 * area)  # inradius = 2 area / perimeter
    return np.asarray(centre[:, None] + factor[:, None, None] * (corner - centre[:, None]))


def cast_rays(scene: RayScene, T_world_sensor: Array, ray: Array) -> tuple[np.ndarray, IntArray]:
    """Exact ranges ``(K, H, W)`` float32 in metres from K poses ``(K, 4, 4)``, infinite for no hit, and the member hit,
    −1 for the ground and for no hit. ``ray (H, W, 3)``: unit vectors in the sensor frame."""
    flat = ray.reshape(-1, 3).astype(np.float32)
    hit = cast_bundle(scene, world_rays(T_world_sensor, np.broadcast_to(flat, (len(T_world_sensor), *flat.shape))))
    shape = len(T_world_sensor), *ray.shape[:2]
    return hit.range_m.reshape(shape), hit.member.reshape(shape)


def world_rays(T_world_sensor: Array, ray: np.ndarray) -> np.ndarray:
    """Origins and directions ``(K, N, 6)`` float32, world frame, of rays ``(K, N, 3)`` float32 in the sensor frame,
    cast from the poses ``(K, 4, 4)``."""
    bundle = np.empty((*ray.shape[:2], 6), dtype=np.float32)
    bundle[:, :, :3] = T_world_sensor[:, None, :3, 3]
    for k, T in enumerate(T_world_sensor):
        np.matmul(ray[k], T[:3, :3].T.astype(np.float32), out=bundle[k, :, 3:])
    return bundle


class Hits(NamedTuple):
    """``range_m (...)`` float32, infinite for no hit; ``member (...)``, −1 for the ground and for no hit; ``normal
    (..., 3)`` float32, unit normals of either sign, zero for no hit; ``triangle (...)``, its index, or T for no hit
    (`RayScene`)."""

    range_m: np.ndarray
    member: IntArray
    normal: np.ndarray
    triangle: IntArray


def cast_bundle(scene: RayScene, bundle: np.ndarray) -> Hits:
    """The first hits of rays ``(..., 6)`` float32: origins and unit directions in the world frame.

    Embree uses the processor's approximate reciprocal, which differs between vendors. It therefore only proposes
    triangles, from a slightly enlarged mesh. A float64 test decides whether the ray hits the true triangle; if not, the
    ray restarts behind it. If a ray hits several triangles at one point, the one with the highest index counts. The
    range is the distance to its plane, rounded to 2⁻¹⁶ m (15 µm).
    """
    tensor, shape = import_open3d().core.Tensor.from_numpy, bundle.shape[:-1]
    ray = bundle.reshape(-1, 6)
    hit = Hits(np.empty(len(ray), np.float32), np.empty(len(ray), np.int64), np.empty((len(ray), 3), np.float32),
               np.empty(len(ray), np.int64))  # fmt: skip
    pending, onward = np.arange(len(ray)), ray
    while len(pending):
        proposed = scene.mesh.cast_rays(tensor(onward), nthreads=1)
        missed = resolve_hits(ray, pending, proposed["primitive_ids"].numpy(), scene.triangles, scene.member, hit)
        pending, onward, behind_m = pending[missed], onward[missed], proposed["t_hit"].numpy()[missed] + RESTART_M
        onward[:, :3] += behind_m[:, None] * onward[:, 3:]
    return Hits(*(array.reshape(*shape, *array.shape[1:]) for array in hit))


@njit(cache=True)
def resolve_hits(rays, pending, proposed, triangles, member_of, hit):
    """Fill in the `Hits` of ``rays (N, 6)`` with indices ``pending (L,)``. ``proposed (L,)``: the triangle proposed for
    each, or an index beyond the last for no hit. ``member_of``: of the `RayScene`. Returns the indices into ``pending``
    of the rays that miss."""
    corner, plane, begin, touching = triangles
    range_m, member, normal, triangle = hit
    ray = np.empty(6)
    missed, count = np.empty(len(pending), np.int64), 0
    for m in range(len(pending)):
        i, t = pending[m], np.int64(proposed[m])
        if t >= len(corner):
            range_m[i], member[i], triangle[i] = np.inf, -1, len(corner)
            normal[i, 0] = normal[i, 1] = normal[i, 2] = 0.0
            continue
        for k in range(6):
            ray[k] = rays[i, k]
        distance = ray_distance(ray, corner[t], plane[t])
        x, y, z = ray[0] + distance * ray[3], ray[1] + distance * ray[4], ray[2] + distance * ray[5]
        found, s, t_is_checked = np.int64(-1), begin[t], False
        while s < begin[t + 1] and found < 0:
            u = touching[s]
            if u < t and not t_is_checked:
                t_is_checked = True
                if contains(corner, plane, t, x, y, z):
                    break
            height = plane[u, 0] * x + plane[u, 1] * y + plane[u, 2] * z - plane[u, 3]
            if abs(height) < TOUCH_M and contains(corner, plane, u, x, y, z):
                found = u
            s += 1
        if found < 0 and contains(corner, plane, t, x, y, z):
            found = t
        if found < 0:
            missed[count] = m
            count += 1
            continue
        if found != t:
            distance = ray_distance(ray, corner[found], plane[found])
        range_m[i] = max(math.floor(distance * STEPS_PER_M + 0.5) / STEPS_PER_M, 0.0)
        member[i], triangle[i] = member_of[found], found
        for k in range(3):
            normal[i, k] = plane[found, k]
    return missed[:count]
