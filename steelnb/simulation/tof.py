"""A Time-of-Flight camera on a flight: ideal, or with the faults of a real one."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from steelnb import rng
from steelnb.settings import TofSettings
from steelnb.simulation.exposure import MOMENTS, Exposure, draw_camera, expose
from steelnb.simulation.scene import Scene, cast_rays, make_scene, rays
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SliceCounter, Visibility
from steelnb.types import Array, IntArray, RangeScans, Scan, Trajectory

SCANS_AT_ONCE = 8
EDGE_M = 0.1
"""Neighbouring ranges further apart than this make a depth edge, where flying pixels live."""
RANGE_MIN_M = 0.1
"""Nearer returns saturate the sensor."""
AMPLITUDE_SCATTER = 0.1
"""Relative standard deviation of the noise that a driver reckons with from a pixel's amplitude, itself measured."""


def scan_flight(
    tower: Tower, trajectory: Trajectory, T_drone_sensor: Array, settings: TofSettings, seed: int
) -> tuple[RangeScans, Visibility]:
    """Range images along a true trajectory, and which part of each member gave returns.

    Parameters
    ----------
    tower: world frame.
    trajectory: true poses of the drone at even steps of time, the first at t = 0.
    T_drone_sensor: ``(4, 4)``, the mount; the optical axis is the sensor's x axis.
    settings: pinhole, rate, noise, limits and faults of the sensor.
    seed: noise comes from the stream ``("tof", k)`` for scan k, so that a longer flight begins with the scans of a
        shorter one; with faults, the camera from ``("tof-camera",)`` and its rays from ``("tof-rays", k)``.

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
        self._T_exposed = np.broadcast_to(self._T_world_sensor[:, None], (len(index), len(MOMENTS), 4, 4))
        if settings.faults and settings.faults.exposure_s > 0:
            stamp_s = self.stamp_s[:, None] + settings.faults.exposure_s * MOMENTS
            self._T_exposed = trajectory.between(stamp_s) @ T_drone_sensor

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
        exposures = self._exposures(make_scene(self._tower))
        for k, (seen, T) in enumerate(zip(exposures, self._T_world_sensor, strict=True)):
            image = _scan_image(seen, self._settings, self._seed, k, float(self.stamp_s[k]))
            yield image, seen.exact_m, seen.member, T

    def _exposures(self, scene: Scene) -> Iterator[Exposure]:
        """Each scan without noise."""
        if self._settings.faults:
            camera = draw_camera(self._settings.faults, rng.stream(self._seed, "tof-camera"))
            for k, T_exposed in enumerate(self._T_exposed):
                yield expose(scene, self._settings, camera, T_exposed, rng.stream(self._seed, "tof-rays", k))
            return
        for begin in range(0, len(self), SCANS_AT_ONCE):
            exact, member = cast_rays(scene, self._T_world_sensor[begin : begin + SCANS_AT_ONCE], self.ray)
            for image, hit in zip(exact, member, strict=True):
                yield Exposure(image, None, image, hit)


class LiveCamera:
    """The scans of `CastScans` one by one, on a flight that is not yet at its end: to the bit the same."""

    def __init__(self, tower: Tower, settings: TofSettings, seed: int) -> None:
        self._scene, self._settings, self._seed, self._ray = make_scene(tower), settings, seed, rays(settings)
        self._faults = settings.faults
        self._camera = draw_camera(self._faults, rng.stream(seed, "tof-camera")) if self._faults else None

    @property
    def latency_s(self) -> float:
        """From the stamp of a scan to the end of its exposure."""
        return self._faults.exposure_s * float(MOMENTS.max()) if self._faults else 0.0

    def scan(self, k: int, stamp_s: float, around: Trajectory) -> Scan:
        """Scan number k, taken at a stamp of the true poses ``around`` it, which cover its exposure."""
        mount, faults = self._settings.T_drone_sensor, self._faults
        T_world_sensor = around.at(np.array([stamp_s])).T_world_drone @ mount
        if faults and self._camera:
            T_exposed = np.broadcast_to(T_world_sensor, (len(MOMENTS), 4, 4))
            if faults.exposure_s > 0:
                T_exposed = around.between(stamp_s + faults.exposure_s * MOMENTS) @ mount
            seen = expose(self._scene, self._settings, self._camera, T_exposed, rng.stream(self._seed, "tof-rays", k))
        else:
            exact, member = cast_rays(self._scene, T_world_sensor, self._ray)
            seen = Exposure(exact[0], None, exact[0], member[0])
        return Scan(stamp_s, _scan_image(seen, self._settings, self._seed, k, stamp_s)[..., None] * self._ray)


def _scan_image(seen: Exposure, settings: TofSettings, seed: int, k: int, stamp_s: float) -> np.ndarray:
    """Measured ranges ``(H, W)`` of exposure k, none in the intervals in which the sensor is blind."""
    image = measured_ranges(seen.range_m, settings, rng.stream(seed, "tof", k), as_far_as_m=seen.as_far_as_m)
    if any(first <= stamp_s < last for first, last in settings.blind_s):
        image[:] = np.nan
    return image


def measured_ranges(
    exact_m: np.ndarray, settings: TofSettings, noise: np.random.Generator, as_far_as_m: np.ndarray | None = None
) -> np.ndarray:
    """Measured range image ``(H, W)`` float32 from the exact one, metres, infinite where nothing is hit.

    Flying pixels first (between two surfaces there is one wrong range, not two noisy ones), then Gaussian noise,
    dropouts, and the sensor's limits; NaN for no return. The noise is that of the ranges ``as_far_as_m`` (default: the
    exact ones).
    """
    result = exact_m.astype(np.float32)
    if settings.flying_pixel_probability > 0:
        result = _flying_pixels(result, settings.flying_pixel_probability, noise)
    seen = np.flatnonzero((result >= RANGE_MIN_M) & (result <= settings.range_max_m))
    value = result.ravel()[seen]
    far = value if as_far_as_m is None else as_far_as_m.ravel()[seen]
    sigma = np.maximum(np.float32(settings.sigma_floor_m), np.float32(settings.sigma_relative) * far)
    value = value + sigma * noise.standard_normal(len(value), dtype=np.float32)
    if settings.faults:
        reckoned = sigma * (1 + AMPLITUDE_SCATTER * noise.standard_normal(len(value), dtype=np.float32))
        value[reckoned > settings.faults.sigma_max_m] = np.nan
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
