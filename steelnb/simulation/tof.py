"""A Time-of-Flight camera on a flight: ideal, or with the faults of a real one."""

import numpy as np

from steelnb import rng
from steelnb.settings import TofSettings
from steelnb.simulation.exposure import MIDDLE, MOMENTS, Exposure, Faults, draw_camera, expose, faults_of
from steelnb.simulation.scene import cast_rays, make_scene, rays
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SliceCounter, Visibility
from steelnb.types import Array, IntArray, RangeScans, Scan, Trajectory

RANGE_MIN_M = 0.1
"""Nearer returns saturate the sensor."""
AMPLITUDE_SCATTER = 0.1
"""Relative standard deviation of the noise that a driver reckons with from a pixel's amplitude, itself measured."""


def scan_flight(
    tower: Tower, trajectory: Trajectory, T_drone_sensor: Array, settings: TofSettings, seed: rng.Seed
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
    step_s = float(trajectory.stamp_s[1] - trajectory.stamp_s[0])
    index = scan_steps(settings, float(trajectory.stamp_s[-1]), step_s)
    index = index[index < len(trajectory) - 1] if len(index) > 1 else index
    stamp_s, camera, counter = trajectory.stamp_s[index], TofCamera(tower, settings, seed), SliceCounter(tower.axes)
    T_world_sensor = trajectory.T_world_drone[index] @ T_drone_sensor
    T_exposed = exposed_poses(trajectory, stamp_s, T_drone_sensor, settings)
    range_m = np.empty((len(index), settings.rows, settings.columns), dtype=np.float32)
    for k, T in enumerate(T_world_sensor):
        range_m[k], seen = camera.measure(k, float(stamp_s[k]), T_exposed[k])
        steel = np.flatnonzero(np.isfinite(range_m[k]) & (seen.member >= 0))
        distance, along = seen.exact_m.ravel()[steel], camera.ray.reshape(-1, 3)[steel] @ T[:3, :3].T
        counter.add(T[:3, 3] + distance[:, None] * along, seen.member.ravel()[steel])
    return RangeScans(stamp_s, range_m, camera.ray), counter.visibility()


def scan_steps(settings: TofSettings, last_s: float, step_s: float) -> IntArray:
    """Steps of time at which scans are taken up to ``last_s``."""
    since_s = np.arange(0, last_s - settings.start_s + 1e-9, 1 / settings.rate_hz)
    return np.round((settings.start_s + since_s) / step_s).astype(int)


def exposed_poses(trajectory: Trajectory, stamp_s: Array, T_drone_sensor: Array, settings: TofSettings) -> Array:
    """True poses ``(K, 9, 4, 4)`` of the sensor at the moments of the exposures at ``stamp_s (K,)``."""
    faults = faults_of(settings)
    if faults and faults.exposure_s > 0:
        return trajectory.between(stamp_s[:, None] + faults.exposure_s * MOMENTS) @ T_drone_sensor
    T_world_sensor = trajectory.at(stamp_s).T_world_drone @ T_drone_sensor
    return np.broadcast_to(T_world_sensor[:, None], (len(stamp_s), len(MOMENTS), 4, 4))


class TofCamera:
    """A camera that can be held anywhere around a tower; its faults and its noise are those of a ``seed``."""

    def __init__(self, tower: Tower, settings: TofSettings, seed: rng.Seed) -> None:
        self.settings, self.ray, self._scene, self._seed = settings, rays(settings), make_scene(tower), seed
        self.faults = faults_of(settings)
        self._own = draw_camera(self.faults, rng.stream(seed, "tof-camera")) if self.faults else None

    @property
    def latency_s(self) -> float:
        """From the stamp of a scan to the end of its exposure."""
        return self.faults.exposure_s * float(MOMENTS.max()) if self.faults else 0.0

    def expose(self, T_world_sensor: Array, random: np.random.Generator) -> Exposure:
        """One exposure, without noise, from the poses ``(9, 4, 4)`` at its moments; without faults, from the middle
        one."""
        if self.faults and self._own:
            return expose(self._scene, self.settings, self.faults, self._own, T_world_sensor, random)
        exact, member = cast_rays(self._scene, T_world_sensor[MIDDLE : MIDDLE + 1], self.ray)
        return Exposure(exact[0], None, exact[0], member[0])

    def measure(self, k: int, stamp_s: float, T_world_sensor: Array) -> tuple[np.ndarray, Exposure]:
        """Measured ranges ``(H, W)`` of scan number k, none in the intervals in which the sensor is blind, and what it
        is measured from."""
        seen = self.expose(T_world_sensor, rng.stream(self._seed, "tof-rays", k))
        noise = rng.stream(self._seed, "tof", k)
        image = measured_ranges(seen.range_m, self.settings, noise, self.faults, seen.as_far_as_m)
        if any(first <= stamp_s < last for first, last in self.settings.blind_s):
            image[:] = np.nan
        return image, seen

    def scan(self, k: int, stamp_s: float, around: Trajectory) -> Scan:
        """Scan number k of `scan_flight`, to the bit, on a flight that is not yet at its end: true poses ``around`` its
        stamp cover its exposure."""
        poses = exposed_poses(around, np.array([stamp_s]), self.settings.T_drone_sensor, self.settings)
        return Scan(stamp_s, self.measure(k, stamp_s, poses[0])[0][..., None] * self.ray)


def measured_ranges(
    exact_m: np.ndarray, settings: TofSettings, noise: np.random.Generator, faults: Faults | None = None,
    as_far_as_m: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Measured range image ``(H, W)`` float32 from the exact one, metres, infinite where nothing is hit.

    Gaussian noise within the sensor's limits, NaN for no return; with faults, pixels whose noise is reckoned too high
    are dropped. The noise is that of the ranges ``as_far_as_m`` (default: the exact ones). Limits and noise are those
    of the range or of the depth, the range's part along the optical axis, as the settings say.
    """
    if settings.noise_on == "depth":
        ahead = rays(settings)[..., 0].astype(np.float32)
        far = None if as_far_as_m is None else as_far_as_m * ahead
        return measured_ranges(exact_m * ahead, settings.replace(noise_on="range"), noise, faults, far) / ahead
    result = exact_m.astype(np.float32)
    seen = np.flatnonzero((result >= RANGE_MIN_M) & (result <= settings.range_max_m))
    value = result.ravel()[seen]
    far = value if as_far_as_m is None else as_far_as_m.ravel()[seen]
    sigma = np.maximum(np.float32(settings.sigma_floor_m), np.float32(settings.sigma_relative) * far)
    value = value + sigma * noise.standard_normal(len(value), dtype=np.float32)
    if faults:
        reckoned = sigma * (1 + AMPLITUDE_SCATTER * noise.standard_normal(len(value), dtype=np.float32))
        value[reckoned > faults.sigma_max_m] = np.nan
    result.fill(np.nan)
    result.ravel()[seen] = value
    return result
