"""Viewing rays, and what they hit: ray casting against a tower's mesh (Open3D, Embree) on one thread."""

from typing import Any, NamedTuple, Protocol

import numpy as np

from steelnb.libraries import import_open3d
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray


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
    """The mesh of a tower on the ground plane as Open3D casts rays on it, and the member of each triangle, −1 for the
    ground and, as the last entry, for no hit."""

    mesh: Any
    member: IntArray


def make_scene(tower: Tower) -> Scene:
    """The scene of a tower that stands on z = 0."""
    open3d = import_open3d()
    corners = tower.settings.floor_half_m * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([tower.vertices, corners]).astype(np.float32)
    n = len(tower.vertices)
    triangles = np.concatenate([tower.triangles, [(n, n + 1, n + 2), (n, n + 2, n + 3)]]).astype(np.uint32)
    mesh = open3d.t.geometry.RaycastingScene(nthreads=1)
    mesh.add_triangles(open3d.core.Tensor.from_numpy(vertices), open3d.core.Tensor.from_numpy(triangles))
    return Scene(mesh, np.append(tower.triangle_member, [-1, -1, -1]))


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
    (..., 3)`` float32, unit normals of the triangles hit, of either sign."""

    range_m: np.ndarray
    member: IntArray
    normal: np.ndarray


def cast_bundle(scene: Scene, bundle: np.ndarray) -> Hits:
    """What rays ``(..., 6)`` float32, origins and unit directions in the world frame, hit first."""
    hit = scene.mesh.cast_rays(import_open3d().core.Tensor.from_numpy(bundle), nthreads=1)
    # Open3D's number for no hit is the largest of its type: the last entry.
    triangle = np.minimum(hit["primitive_ids"].numpy(), len(scene.member) - 1).astype(np.int64)
    return Hits(hit["t_hit"].numpy(), scene.member[triangle], hit["primitive_normals"].numpy())
