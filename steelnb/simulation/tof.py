"""A Time-of-Flight camera on a flight, by ray casting against the tower's mesh (Open3D, Embree) on one thread."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from steelnb import rng
from steelnb.libraries import import_open3d
from steelnb.settings import TofSettings
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SliceCounter, Visibility
from steelnb.types import Array, IntArray, RangeScans, Scan, Trajectory

SCANS_AT_ONCE = 8
EDGE_M = 0.1
"""Neighbouring ranges further apart than this make a depth edge, where flying pixels live."""
RANGE_MIN_M = 0.1
"""Nearer returns saturate the sensor."""
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
) -> tuple[RangeScans, Visibility]:
    """Range images along a true trajectory, and which part of each member gave returns.

    Parameters
    ----------
    tower: world frame.
    trajectory: true poses of the drone at even steps of time, the first at t = 0.
    T_drone_sensor: ``(4, 4)``, the mount; the optical axis is the sensor's x axis.
    settings: pinhole, rate, noise and limits of the sensor.
    seed: noise comes from the stream ``("tof", k)`` for scan k, so that a longer flight begins with the scans of a
        shorter one.

    Returns K = duration × rate scans; ranges in metres along the ray, NaN for no return.
    """
    scans, counter = CastScans(tower, trajectory, T_drone_sensor, settings, seed), SliceCounter(tower.axes)
    range_m = np.empty((len(scans), settings.rows, settings.columns), dtype=np.float32)
    for k, (image, exact, member, T) in enumerate(scans.cast()):
        range_m[k] = image
        steel = np.flatnonzero(np.isfinite(image) & (member >= 0))
        distance, along = exact.ravel()[steel], scans.ray.reshape(-1, 3)[steel] @ T[:3, :3].T
        counter.add(T[:3, 3] + distance[:, None] * along, member.ravel()[steel])
    return RangeScans(scans.stamp_s, range_m, scans.ray), counter.visibility()


class CastScans(Sequence[Scan]):
    """The scans of `scan_flight`, cast anew whenever they are iterated over, so that only a few are in memory.

    ``stamp_s (K,)``; ``ray (H, W, 3)`` unit vectors in the sensor frame. An index costs as much as all scans before it.
    """

    def __init__(
        self, tower: Tower, trajectory: Trajectory, T_drone_sensor: Array, settings: TofSettings, seed: int
    ) -> None:
        step_s = float(trajectory.stamp_s[1] - trajectory.stamp_s[0])
        index = np.round(np.arange(0, trajectory.stamp_s[-1] + 1e-9, 1 / settings.rate_hz) / step_s).astype(int)
        index = index[index < len(trajectory) - 1] if len(index) > 1 else index
        self.stamp_s, self.ray = trajectory.stamp_s[index], rays(settings)
        self._tower, self._settings, self._seed = tower, settings, seed
        self._T_world_sensor = trajectory.T_world_drone[index] @ T_drone_sensor

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        found = list(itertools.islice(self, range(len(self))[index] + 1)) if isinstance(index, int) else list(self)
        return found[-1] if isinstance(index, int) else found[index]

    def __iter__(self) -> Iterator[Scan]:
        for stamp_s, (image, *_) in zip(self.stamp_s.tolist(), self.cast(), strict=True):
            yield Scan(stamp_s, image[..., None] * self.ray)

    def cast(self) -> Iterator[tuple[np.ndarray, np.ndarray, IntArray, Array]]:
        """Of each scan measured and exact ranges ``(H, W)`` float32, the members hit, and ``T_world_sensor``."""
        scene = make_scene(self._tower)
        for begin in range(0, len(self), SCANS_AT_ONCE):
            T_world_sensor = self._T_world_sensor[begin : begin + SCANS_AT_ONCE]
            exact, member = cast_rays(scene, T_world_sensor, self.ray)
            for k, T in enumerate(T_world_sensor):
                image = measured_ranges(exact[k], self._settings, rng.stream(self._seed, "tof", begin + k))
                if any(first <= self.stamp_s[begin + k] < last for first, last in self._settings.blind_s):
                    image[:] = np.nan
                yield image, exact[k], member[k], T


def measured_ranges(exact_m: np.ndarray, settings: TofSettings, noise: np.random.Generator) -> np.ndarray:
    """Measured range image ``(H, W)`` float32 from the exact one, metres, infinite where nothing is hit.

    Flying pixels first (between two surfaces there is one wrong range, not two noisy ones), then Gaussian noise,
    dropouts, and the sensor's limits; NaN for no return.
    """
    result = exact_m.astype(np.float32)
    if settings.flying_pixel_probability > 0:
        result = _flying_pixels(result, settings.flying_pixel_probability, noise)
    seen = np.flatnonzero((result >= RANGE_MIN_M) & (result <= settings.range_max_m))
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


class Scene(NamedTuple):
    """The mesh of a tower on the ground plane as Open3D casts rays on it, and the member of each triangle, −1 for the
    ground and, as the last entry, for no hit."""

    mesh: Any
    member: IntArray


def make_scene(tower: Tower) -> Scene:
    """The scene of a tower that stands on z = 0."""
    open3d = import_open3d()
    corners = GROUND_M * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    vertices = np.concatenate([tower.vertices, corners]).astype(np.float32)
    n = len(tower.vertices)
    triangles = np.concatenate([tower.triangles, [(n, n + 1, n + 2), (n, n + 2, n + 3)]]).astype(np.uint32)
    mesh = open3d.t.geometry.RaycastingScene(nthreads=1)
    mesh.add_triangles(open3d.core.Tensor.from_numpy(vertices), open3d.core.Tensor.from_numpy(triangles))
    return Scene(mesh, np.append(tower.triangle_member, [-1, -1, -1]))


def cast_rays(scene: Scene, T_world_sensor: Array, ray: Array) -> tuple[np.ndarray, IntArray]:
    """Exact ranges ``(K, H, W)`` float32 in metres from K poses ``(K, 4, 4)``, infinite for no hit, and the member hit,
    −1 for the ground and for none. ``ray (H, W, 3)``: unit vectors in the sensor frame."""
    open3d = import_open3d()
    flat = ray.reshape(-1, 3).astype(np.float32)
    bundle = np.empty((len(T_world_sensor), len(flat), 6), dtype=np.float32)
    bundle[:, :, :3] = T_world_sensor[:, None, :3, 3]
    for k, T in enumerate(T_world_sensor):
        np.matmul(flat, T[:3, :3].T.astype(np.float32), out=bundle[k, :, 3:])
    hit = scene.mesh.cast_rays(open3d.core.Tensor.from_numpy(bundle), nthreads=1)
    shape = (len(T_world_sensor), *ray.shape[:2])
    # Open3D's number for no hit is the largest of its type: the last entry.
    triangle = np.minimum(hit["primitive_ids"].numpy(), len(scene.member) - 1).astype(np.int64)
    return hit["t_hit"].numpy().reshape(shape), scene.member[triangle].reshape(shape)
