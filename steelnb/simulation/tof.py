"""A Time-of-Flight camera on a flight: ideal, or with the faults of a real one."""

from dataclasses import dataclass

import numpy as np

from steelnb.core import rng
from steelnb.core.types import Array, IntArray, RangeScans, Scan, Trajectory
from steelnb.settings import PreprocessSettings, TofSettings
from steelnb.settings.world import fitted_calibration
from steelnb.simulation.mesh import GROUND
from steelnb.simulation.raycasting import cast_rays, make_scene, rays
from steelnb.simulation.tof_faults import (
    LATE_S,
    MIDDLE,
    MOMENTS,
    Exposure,
    Faults,
    draw_faults,
    draw_mount,
    expose,
    reported_range,
)
from steelnb.simulation.tower import Tower
from steelnb.simulation.truth import SliceCounter, Visibility

RANGE_MIN_M = 0.1
"""Nearer returns saturate the sensor."""
AMPLITUDE_SCATTER = 0.1
"""Relative standard deviation of a driver's noise estimate, which comes from a pixel's measured amplitude."""


def scan_flight(
    tower: Tower, trajectory: Trajectory, settings: TofSettings, seed: rng.Seed
) -> tuple[RangeScans, Visibility]:
    """Range images along a true trajectory, and the parts of the members that they show.

    Parameters
    ----------
    tower: world frame.
    trajectory: true poses of the drone at equal time steps, the first at t = 0.
    settings: pinhole, mount, rate, noise, limits and faults of the sensor, whose optical axis is its x axis.
    seed: scan k takes its noise from the stream ``("tof", k)``, so a longer flight begins with the scans of a shorter
        one, and ``draw`` k > 0 from ``("tof", k, "draw", draw)``. The faults of the camera come from
        ``("tof-camera",)``, its mount from ``("tof-mount",)``, its random rays from ``("tof-rays", k)``.

    Returns K = duration × rate scans; ranges in metres along the ray, NaN for no return.
    """
    step_s = float(trajectory.stamp_s[1] - trajectory.stamp_s[0])
    index = scan_steps(settings, float(trajectory.stamp_s[-1]), step_s)
    index = index[index < len(trajectory) - 1] if len(index) > 1 else index
    stamp_s, camera, counter = trajectory.stamp_s[index], TofCamera(tower, settings, seed), SliceCounter(tower.axes)
    range_m = np.empty((len(index), settings.rows, settings.columns), dtype=np.float32)
    poses = camera.exposure_poses(trajectory, stamp_s)
    for k, T in enumerate(poses[:, MIDDLE]):
        range_m[k], exposure = camera.scan_image(k, float(stamp_s[k]), poses[k])
        steel = np.flatnonzero(np.isfinite(range_m[k]) & (exposure.member >= 0))
        distance, direction = exposure.exact_m.ravel()[steel], camera.ray.reshape(-1, 3)[steel] @ T[:3, :3].T
        counter.add(T[:3, 3] + distance[:, None] * direction, exposure.member.ravel()[steel])
    return RangeScans(stamp_s, range_m, camera.reported_ray), counter.visibility()


def scan_steps(settings: TofSettings, last_s: float, step_s: float) -> IntArray:
    """Indices of the time steps, counted from t = 0, at which scans are taken, up to ``last_s``."""
    steps = settings.sample_steps()
    if len(steps):
        return steps[(steps * step_s >= settings.start_s - 1e-9) & (steps * step_s <= last_s + 1e-9)]
    since_s = np.arange(0, last_s - settings.start_s + 1e-9, 1 / settings.rate_hz)
    return np.round((settings.start_s + since_s) / step_s).astype(int)


class TofCamera:
    """Takes scans of a tower from any pose. The ``seed`` determines the camera's faults and noise.

    ``latency_s``: time from the stamp of a scan to the end of its exposure.
    """

    def __init__(self, tower: Tower, settings: TofSettings, seed: rng.Seed) -> None:
        self.settings, self.ray, self._scene, self._seed = settings, rays(settings), make_scene(tower), seed
        self.reported_ray = reported_rays(settings)
        self._faults = draw_faults(settings, rng.stream(seed, "tof-camera"))
        self._exposure_s = self._faults.exposure_s if self._faults else 0.0
        self._late_s = LATE_S if "latency" in settings.faults else 0.0
        self._T_drone_sensor = draw_mount(settings, rng.stream(seed, "tof-mount"))
        self.latency_s = max(self._exposure_s * float(MOMENTS.max()) - self._late_s, 0.0)

    def exposure_poses(self, trajectory: Trajectory, stamp_s: Array) -> Array:
        """True poses of the sensor ``(K, 9, 4, 4)`` at the nine moments of each exposure, centred on ``stamp_s
        (K,)``, or earlier if the stamps are late."""
        if self._exposure_s > 0 or self._late_s > 0:
            moments_s = stamp_s[:, None] - self._late_s + self._exposure_s * MOMENTS
            return trajectory.between(moments_s) @ self._T_drone_sensor
        T_world_sensor = trajectory.at(stamp_s).T_world_drone @ self._T_drone_sensor
        return np.broadcast_to(T_world_sensor[:, None], (len(stamp_s), len(MOMENTS), 4, 4))

    def measure(
        self, T_world_sensor: Array, noise: np.random.Generator, random: np.random.Generator
    ) -> tuple[np.ndarray, Exposure]:
        """Measured ranges ``(H, W)`` from the poses ``(9, 4, 4)`` at the moments of an exposure, and the exposure
        without noise. Without faults, only the middle pose is used, and nothing is drawn from ``random``."""
        if self._faults:
            exposure = expose(self._scene, self.settings, self._faults, T_world_sensor, random)
        else:
            (exact,), (member,) = cast_rays(self._scene, T_world_sensor[MIDDLE : MIDDLE + 1], self.ray)
            exposure = Exposure(exact, exact, exact, member)
        image = measured_ranges(exposure.range_m, self.settings, noise, self._faults, exposure.equivalent_range_m)
        return image, exposure

    def scan_image(self, k: int, stamp_s: float, T_world_sensor: Array) -> tuple[np.ndarray, Exposure]:
        """Scan k by `measure`; all NaN while the sensor is blind."""
        streams = _noise_stream(self.settings, self._seed, k), rng.stream(self._seed, "tof-rays", k)
        image, exposure = self.measure(T_world_sensor, *streams)
        if any(first <= stamp_s < last for first, last in self.settings.blind_s):
            image[:] = np.nan
        return image, exposure

    def scan(self, k: int, stamp_s: float, trajectory: Trajectory) -> Scan:
        """Scan k during a flight, bit-identical to `scan_flight`. The true ``trajectory`` must cover its exposure."""
        (poses,) = self.exposure_poses(trajectory, np.array([stamp_s]))
        return Scan(stamp_s, self.scan_image(k, stamp_s, poses)[0][..., None] * self.reported_ray)


@dataclass(frozen=True)
class View:
    """Returns of one scan in the world frame: ``points (N, 3)`` as measured, ``surface (N, 3)``, their true positions,
    and ``member (N,)``, the member that each lies on, or `ON_PLATE`. ``across (3,)``: horizontal unit vector to the
    right."""

    points: Array
    surface: Array
    member: IntArray
    across: Array


def take_view(camera: TofCamera, T_world_sensor: Array, noise: np.random.Generator) -> View:
    """One scan at rest from a pose ``(4, 4)``, without the ground and points measured below the usual floor."""
    measured, exposure = camera.measure(np.tile(T_world_sensor, (len(MOMENTS), 1, 1)), noise, noise)
    returned = np.isfinite(measured) & np.isfinite(exposure.exact_m)
    member, rotation = exposure.member[returned], T_world_sensor[:3, :3]
    points, surface = (
        ranges[returned][:, None].astype(np.float64) * (ray[returned] @ rotation.T) + T_world_sensor[:3, 3]
        for ranges, ray in ((measured, camera.reported_ray), (exposure.exact_m, camera.ray))
    )
    kept = (member != GROUND) & (points[:, 2] >= PreprocessSettings().floor_m)
    level = np.array([-rotation[0, 1], -rotation[1, 1], 0.0])
    return View(points[kept], surface[kept], member[kept], level / np.linalg.norm(level))


def measured_ranges(
    exact_m: np.ndarray, settings: TofSettings, noise: np.random.Generator, faults: Faults | None = None,
    equivalent_range_m: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Measured range image ``(H, W)`` float32, metres, NaN for no return: `limited_ranges` with noise.

    Gaussian noise has the standard deviation at the ranges ``equivalent_range_m`` (default: the exact ones). With
    faults, pixels whose estimated noise is too high are dropped.
    """
    return _with_noise(limited_ranges(exact_m, settings), settings, noise, faults, equivalent_range_m)


def limited_ranges(exact_m: np.ndarray, settings: TofSettings) -> np.ndarray:
    """Range image ``(H, W)`` float32 without noise, metres along `reported_rays`, NaN beyond the sensor's limits.

    ``exact_m``: ranges along the rays through the centres of the pixels, infinite for no hit. The limits apply to the
    range, or to the depth along the optical axis if ``noise_on`` is ``"depth"``.
    """
    cosine = rays(settings)[..., 0].astype(np.float32)
    limited = exact_m.astype(np.float32) * (cosine if settings.noise_on == "depth" else np.float32(1))
    with np.errstate(invalid="ignore"):
        limited[~((limited >= RANGE_MIN_M) & (limited <= settings.range_max_m))] = np.nan
    if settings.noise_on == "depth":
        return np.asarray(limited / _reported_cosine(settings))
    return limited if settings.pixel_origin == "centre" else np.asarray(limited * (cosine / _reported_cosine(settings)))


def reported_rays(settings: TofSettings) -> Array:
    """Unit rays ``(rows, columns, 3)`` along which the driver places its points, sensor frame (`pixel_origin`)."""
    return rays(settings, 0.5 if settings.pixel_origin == "centre" else 0.0)


def _reported_cosine(settings: TofSettings) -> np.ndarray:
    return np.asarray(reported_rays(settings)[..., 0].astype(np.float32))


def _with_noise(
    range_m: np.ndarray, settings: TofSettings, noise: np.random.Generator, faults: Faults | None = None,
    equivalent_range_m: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Add noise to a range image of `limited_ranges`; arguments as for `measured_ranges`."""
    if not (settings.sigma_floor_m or settings.sigma_relative or faults):
        return range_m
    cosine = _reported_cosine(settings) if settings.noise_on == "depth" else np.float32(1)
    result = range_m * cosine
    inside = np.flatnonzero(np.isfinite(result))
    value = result.ravel()[inside]
    equivalent = value if equivalent_range_m is None else (equivalent_range_m * cosine).ravel()[inside]
    sigma = np.maximum(np.float32(settings.sigma_floor_m), np.float32(settings.sigma_relative) * equivalent)
    value = value + sigma * noise.standard_normal(len(value), dtype=np.float32)
    if faults:
        estimated = sigma * (1 + AMPLITUDE_SCATTER * noise.standard_normal(len(value), dtype=np.float32))
        value[estimated > faults.sigma_max_m] = np.nan
    result.ravel()[inside] = value
    return result / cosine


def add_noise(scans: RangeScans, settings: TofSettings, seed: rng.Seed) -> RangeScans:
    """The scans of `scan_flight` with noise, from those without (`noise_free`), for a sensor without faults."""
    images = [
        _with_noise(image, settings, _noise_stream(settings, seed, k)) for k, image in enumerate(scans.range_m)
    ]  # fmt: skip
    return RangeScans(scans.stamp_s, np.array(images, dtype=np.float32).reshape(scans.range_m.shape), scans.ray)


def noise_free(settings: TofSettings) -> TofSettings:
    """The settings of the same sensor without noise. Flights that differ in their noise alone share its scans."""
    return settings.replace(sigma_floor_m=0.0, sigma_relative=0.0, draw=0)


def _noise_stream(settings: TofSettings, seed: rng.Seed, k: int) -> np.random.Generator:
    """The random stream of the noise of scan k."""
    return rng.stream(seed, "tof", k, *(("draw", settings.draw) if settings.draw else ()))


DISTANCES_M = np.arange(0.5, 4.01, 0.25)
"""Of the wall from the camera: 15 tape marks. Their step is no multiple of the wiggle's period, so it averages out."""
TAPE_SIGMA_M = 0.001
"""Standard deviation of a distance by tape."""
PIXELS = 400
"""Number of pixels around the optical axis whose ranges are averaged at each distance."""


def measure_calibration(settings: TofSettings, seed: rng.Seed) -> dict[str, float]:
    """Scale and offset of the camera of a seed, with their standard deviations, as overrides of `TofSettings`: a line
    fitted to mean ranges at `DISTANCES_M`.

    The ranges have the camera's offset, scale and wiggle, and white noise. A wall seen at right angles has neither
    mixed pixels nor multipath. Standard deviations come from the residuals, so they contain the wiggle.
    """
    random, faults = rng.stream(seed, "tof-calibration"), draw_faults(settings, rng.stream(seed, "tof-camera"))
    tape_m, noise = random.standard_normal((2, len(DISTANCES_M)))
    sigma_m = np.maximum(settings.sigma_floor_m, settings.sigma_relative * DISTANCES_M) / np.sqrt(PIXELS)
    range_m = DISTANCES_M if faults is None else reported_range(DISTANCES_M, faults)
    return fitted_calibration(DISTANCES_M + TAPE_SIGMA_M * tape_m, range_m + sigma_m * noise)
