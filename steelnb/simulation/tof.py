"""A Time-of-Flight camera on a flight, by ray casting against the tower's mesh (Open3D, Embree) on one thread."""

import os

import numpy as np

from steelnb import rng
from steelnb.config import TofSettings
from steelnb.datatypes import Array, IntArray, RangeScans, Trajectory
from steelnb.simulation.tower import Tower

SCANS_AT_ONCE = 8
EDGE_M = 0.1
"""Neighbouring ranges further apart than this make a depth edge, where flying pixels live."""
GROUND_M = 60.0


def rays(settings: TofSettings) -> Array:
    """Unit viewing rays ``(rows, columns, 3)`` in the sensor frame: x along the optical axis, y left, z up."""
    u = (np.arange(settings.columns) + 0.5) / settings.columns * 2 - 1
    v = (np.arange(settings.rows) + 0.5) / settings.rows * 2 - 1
    ray = np.ones((settings.rows, settings.columns, 3))
    ray[..., 1] = -np.tan(settings.fov_horizontal_rad / 2) * u
    ray[..., 2] = -np.tan(settings.fov_vertical_rad / 2) * v[:, None]
    return np.asarray(ray / np.linalg.norm(ray, axis=2, keepdims=True))


def scan_flight(
    tower: Tower, trajectory: Trajectory, T_drone_sensor: Array, settings: TofSettings, seed: int
) -> tuple[RangeScans, IntArray]:
    """Scans along a true trajectory at the sensor's rate, and how many returns each member of the tower gave ``(M,)``.

    Noise comes from one stream a scan, so that a longer flight begins with the scans of a shorter one.
    """
    index = np.round(np.arange(0, trajectory.stamp_s[-1] + 1e-9, 1 / settings.rate_hz) / _step(trajectory)).astype(int)
    index = index[index < len(trajectory) - 1] if len(index) > 1 else index
    scene = _scene(tower)
    ray = rays(settings)
    owner = np.append(tower.triangle_member, [len(tower.members)] * 2)
    range_m = np.empty((len(index), settings.rows, settings.columns), dtype=np.float32)
    hits = np.zeros(len(tower.members), dtype=np.int64)
    for begin in range(0, len(index), SCANS_AT_ONCE):
        some = index[begin : begin + SCANS_AT_ONCE]
        exact, triangle = _cast(scene, trajectory.T_world_drone[some] @ T_drone_sensor, ray)
        for k in range(len(some)):
            noise = rng.stream(seed, "tof", begin + k)
            range_m[begin + k] = measure(exact[k], settings, noise)
            stamp = trajectory.stamp_s[some[k]]
            if any(first <= stamp < last for first, last in settings.blind_s):
                range_m[begin + k] = np.nan
            returned = triangle[k][np.isfinite(range_m[begin + k])]
            hits += np.bincount(owner[returned], minlength=len(hits) + 1)[:-1]
    return RangeScans(trajectory.stamp_s[index], range_m, ray), hits


def measure(exact_m: np.ndarray, settings: TofSettings, noise: np.random.Generator) -> np.ndarray:
    """Measured range image ``(H, W)`` float32 from the exact one, infinite where nothing is hit.

    Flying pixels first (between two surfaces there is one wrong range, not two noisy ones), then Gaussian noise,
    dropouts, and the sensor's limits; NaN for no return.
    """
    result = exact_m.astype(np.float32)
    if settings.flying_pixel_probability > 0:
        result = _flying_pixels(result, settings.flying_pixel_probability, noise)
    seen = np.flatnonzero((result >= settings.range_min_m) & (result <= settings.range_max_m))
    value = result.ravel()[seen]
    sigma = np.maximum(np.float32(settings.sigma_floor_m), np.float32(settings.sigma_relative) * value)
    value = value + sigma * noise.standard_normal(len(value), dtype=np.float32)
    if settings.dropout_probability > 0:
        value[noise.random(len(value)) < settings.dropout_probability] = np.nan
    result.fill(np.nan)
    result.ravel()[seen] = value
    return result


def _flying_pixels(exact: np.ndarray, probability: float, noise: np.random.Generator) -> np.ndarray:
    """Replace pixels beside a depth edge by a range between theirs and the neighbour's that differs most."""
    other = exact.copy()
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        neighbour = np.roll(exact, shift, axis)
        edge: list[slice | int] = [slice(None), slice(None)]
        edge[axis] = 0 if shift == 1 else -1
        neighbour[tuple(edge)] = np.inf
        with np.errstate(invalid="ignore"):
            further = np.isfinite(neighbour) & (np.abs(neighbour - exact) > np.abs(other - exact))
        other[further] = neighbour[further]
    with np.errstate(invalid="ignore"):
        flying = (np.abs(other - exact) > EDGE_M) & np.isfinite(exact) & (noise.random(exact.shape) < probability)
    share = noise.random(exact.shape, dtype=np.float32)
    other[flying] = exact[flying] + share[flying] * (other[flying] - exact[flying])
    return np.where(flying, other, exact)


def _step(trajectory: Trajectory) -> float:
    return float(trajectory.stamp_s[1] - trajectory.stamp_s[0])


def _scene(tower: Tower):  # type: ignore[no-untyped-def]
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    import open3d

    corners = GROUND_M * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([tower.vertices, corners]).astype(np.float32)
    n = len(tower.vertices)
    triangles = np.concatenate([tower.triangles, [(n, n + 1, n + 2), (n, n + 2, n + 3)]]).astype(np.uint32)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor.from_numpy(vertices), open3d.core.Tensor.from_numpy(triangles))
    return scene


def _cast(scene, T_world_sensor: Array, ray: Array) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Exact ranges ``(K, H, W)``, infinite for no hit, and the triangle hit, −1 for none."""
    import open3d

    flat = ray.reshape(-1, 3).astype(np.float32)
    bundle = np.empty((len(T_world_sensor), len(flat), 6), dtype=np.float32)
    bundle[:, :, :3] = T_world_sensor[:, None, :3, 3]
    for k, T in enumerate(T_world_sensor):
        np.matmul(flat, T[:3, :3].T.astype(np.float32), out=bundle[k, :, 3:])
    answer = scene.cast_rays(open3d.core.Tensor.from_numpy(bundle), nthreads=1)
    shape = (len(T_world_sensor), *ray.shape[:2])
    return answer["t_hit"].numpy().reshape(shape), answer["primitive_ids"].numpy().reshape(shape)
