"""One exposure of a phase-measuring Time-of-Flight camera with the faults of a real one.

Nine rays per pixel are spread over its footprint and over the exposure time. Each return is a phasor, whose phase is
proportional to the length of its path. Its amplitude is ρ·cos θ / r² for reflectivity ρ, incidence angle θ and range r
(Lambertian surfaces). A pixel measures the phase of the sum (Lange, Seitz, "Solid-state time-of-flight range camera",
IEEE Journal of Quantum Electronics 37, 2001). A mixed pixel, which sees two depths, therefore measures a range between
them, and a pixel in a corner measures a range that is too long. The noise depends on the amplitude of the sum. Its
standard deviation is that of the data sheet's target at the range where it returns this amplitude (shot noise, ibid.).

Not modelled: multipath by the ground or by more than one other surface, occlusion of that surface, specular reflection,
stray light in the lens, phase unwrapping errors, and errors of the intrinsics.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.kernels import njit
from steelnb.core.types import Array, Floats, IntArray
from steelnb.settings import TofFault, TofSettings
from steelnb.simulation.mesh import GROUND
from steelnb.simulation.raycasting import RayScene, cast_bundle, rays

_MAGIC = np.array([8, 1, 6, 3, 5, 7, 4, 9, 2])
MOMENTS = (_MAGIC - 5) / 9
"""Times of a pixel's nine rays, relative to the middle of the exposure and in units of the exposure time. The rays form
a 3 × 3 grid, row by row. The magic square keeps rows and columns uncorrelated with time and gives the centre ray the
middle moment. Such cameras also take nine raw images per scan (eight phases and a dark one)."""
MIDDLE = 4
"""Index of a pixel's centre ray."""
WIGGLE_PERIOD_M = 0.625
"""A quarter of the 2.5 m period at 60 MHz: the light's odd harmonics, sampled at four phases (Lindner, Schiller, Kolb,
Koch, "Time-of-Flight sensor calibration for accurate range sensing", CVIU 114, 2010)."""


@dataclass(frozen=True)
class Faults:
    """Sizes of the faults of one camera. The defaults are those of a faultless camera.

    ``footprint_px``: width of a pixel's footprint, which makes mixed pixels at depth edges; ``lateral_px``: standard
    deviation of the footprint's position; ``exposure_s``: exposure time of a scan, centred on its stamp; ``multipath``:
    scale of the light that travels via a second surface, 1 for Lambertian surfaces; ``reflectivity`` of all
    surfaces relative to the data sheet's target; ``sigma_max_m``: pixels with more noise than this, as predicted from
    their amplitude, are dropped; ``wiggle_m`` and ``phase_rad`` of the error that is periodic in the range;
    ``offset_m`` and ``scale_error`` of the range.
    """

    footprint_px: float = 0.0
    lateral_px: float = 0.0
    exposure_s: float = 0.0
    multipath: float = 0.0
    reflectivity: float = 1.0
    sigma_max_m: float = 1.0
    wiggle_m: float = 0.0
    phase_rad: float = 0.0
    offset_m: float = 0.0
    scale_error: float = 0.0


REFLECTIVITY = 0.5
"""Reflectivity of weathered zinc in the near infrared, relative to a white target (assumed)."""
STARLING2_FAULTS: dict[TofFault, dict[str, float]] = {
    # A pixel sees its own square; lens blur is not modelled. Lateral noise is assumed: 1/sqrt(12), that of positions
    # rounded to pixels. Nguyen, Izadi, Lovell (3DIMPVT 2012) measure 0.8 with structured light.
    "footprint": {"footprint_px": 1.0, "lateral_px": 0.3},
    # Assumed: 8 + 1 raw images of up to 2 ms at 5 Hz (pmd Royale, MODE_9_5FPS_2000), each read out in about 1.3 ms.
    "exposure": {"exposure_s": 0.03},
    "multipath": {"multipath": 1.0, "reflectivity": REFLECTIVITY},  # Lambertian surfaces
    "amplitude": {"reflectivity": REFLECTIVITY, "sigma_max_m": 0.07},  # pmd Royale, NoiseThreshold
    # Assumed: calibration leaves a few mm to 1 cm; the form is that of Lindner, Schiller, Kolb, Koch (CVIU 114, 2010).
    "wiggle": {"wiggle_m": 0.005},
    # Standard deviations between cameras of this type. The data sheet's error of 1 % from 0.5 to 4 m allows 5 mm at
    # 0.5 m and, taken as three standard deviations, 0.3 % of the range.
    "calibration": {"offset_m": 0.005, "scale_error": 0.003},
}
"""Size of each fault for the camera of a Starling 2. "Assumed": no data sheet or paper gives it for this camera."""


def draw_faults(settings: TofSettings, random: np.random.Generator) -> Faults | None:
    """Draw one camera of this type, with the faults that the settings name; None if they name none."""
    sizes = [STARLING2_FAULTS[fault] for fault in settings.faults if fault in STARLING2_FAULTS]
    if not sizes:
        return None
    faults = Faults(**{name: size for each in sizes for name, size in each.items()})
    offset, scale = random.standard_normal(2)
    return replace(faults, offset_m=faults.offset_m * offset, scale_error=faults.scale_error * scale,
                   phase_rad=random.uniform(0, 2 * math.pi))  # fmt: skip


MOUNT_SIGMA_RAD, MOUNT_SIGMA_M, LATE_S = math.radians(1.0), 0.01, 0.02
"""Standard deviations, per axis, of the mount of a camera on a bracket about the stated one, and the time by which a
driver that stamps on arrival is late (assumed: read-out and transport of one image)."""


def draw_mount(settings: TofSettings, random: np.random.Generator) -> Array:
    """The true mount ``(4, 4)`` of a camera: the stated one, unless ``"mount"`` is among its faults."""
    T_drone_sensor = settings.T_drone_sensor
    if "mount" in settings.faults:
        turn, shift = random.standard_normal((2, 3))
        T_drone_sensor[:3, :3] = Rotation.from_rotvec(MOUNT_SIGMA_RAD * turn).as_matrix() @ T_drone_sensor[:3, :3]
        T_drone_sensor[:3, 3] += MOUNT_SIGMA_M * shift
    return T_drone_sensor


class Exposure(NamedTuple):
    """Images ``(H, W)``: ``range_m`` float32 as measured, but without noise, infinite without light;
    ``equivalent_range_m``, the range from which the data sheet's target, seen perpendicularly, returns as much light;
    ``exact_m`` and ``member`` of each pixel's centre ray, as from `cast_rays`."""

    range_m: Floats
    equivalent_range_m: Floats
    exact_m: Floats
    member: IntArray


def expose(
    scene: RayScene, settings: TofSettings, faults: Faults, T_world_sensor: Array, random: np.random.Generator
) -> Exposure:
    """One exposure, without noise, from the poses ``T_world_sensor (9, 4, 4)`` at its nine moments (`MOMENTS`).

    ``random`` draws the lateral noise and the directions of scattered light.
    """
    bundle = _bundle(settings, faults, T_world_sensor, random)
    hit, count = cast_bundle(scene, bundle), bundle.shape[1]
    amplitude = amplitudes(bundle, hit.range_m, hit.normal, faults.reflectivity)
    multipath_m, multipath_amplitude = np.zeros_like(hit.range_m), np.zeros_like(hit.range_m)
    near = np.flatnonzero((hit.member != GROUND) & (hit.range_m <= settings.range_max_m))
    if faults.multipath > 0 and len(near):
        # Stratified: each of a pixel's nine rays is scattered into its own ninth of the directions.
        stratum = np.column_stack(np.divmod(near // count, 3))
        drawn = (stratum + random.random((len(near), 2))) / 3
        onward = np.empty((len(near), 6), np.float32)
        first = bundle.reshape(-1, 6), hit.range_m.ravel()
        scattered_rays(*first, hit.normal.reshape(-1, 3), near, drawn, onward)
        second = cast_bundle(scene, onward)
        range_2_m = np.where(second.member != GROUND, second.range_m, np.float32(np.inf))
        share = faults.multipath * faults.reflectivity**2
        multipath(*first, near, onward, range_2_m, second.normal, share, multipath_m.ravel(),
                   multipath_amplitude.ravel())  # fmt: skip
    mixed, equivalent = np.empty(count), np.empty(count)
    mix_phasors(hit.range_m, amplitude, multipath_m, multipath_amplitude, mixed, equivalent)
    measured = reported_range(mixed, faults)
    shape = settings.rows, settings.columns
    return Exposure(
        measured.astype(np.float32).reshape(shape), equivalent.astype(np.float32).reshape(shape),
        hit.range_m[MIDDLE].reshape(shape), hit.member[MIDDLE].reshape(shape),
    )  # fmt: skip


def reported_range(range_m: Array, faults: Faults) -> Array:
    """Ranges ``(N,)`` as the camera reports them, metres: with its wiggle, scale and offset; infinite without light."""
    with np.errstate(invalid="ignore"):
        wiggle = faults.wiggle_m * np.sin(2 * math.pi * range_m / WIGGLE_PERIOD_M + faults.phase_rad)
    return np.where(np.isfinite(range_m), (1 + faults.scale_error) * range_m + faults.offset_m + wiggle, np.inf)


def _bundle(settings: TofSettings, faults: Faults, T_world_sensor: Array, random: np.random.Generator) -> Floats:
    """Nine rays ``(9, N, 6)``, world frame, for each of N pixels, whose footprints have lateral noise."""
    ray = rays(settings)
    plane = (ray[..., 1:] / ray[..., :1]).reshape(-1, 2)
    pixel = np.array([-math.tan(settings.fov_horizontal_rad / 2) * 2 / settings.columns,
                      -math.tan(settings.fov_vertical_rad / 2) * 2 / settings.rows])  # fmt: skip
    grid_px = faults.footprint_px / 3 * (np.array([(i % 3, i // 3) for i in range(9)]) - 1)
    lateral_px = faults.lateral_px * random.standard_normal(plane.shape) if faults.lateral_px else np.zeros(plane.shape)
    bundle = np.empty((len(grid_px), len(plane), 6), np.float32)
    fill_bundle(np.ascontiguousarray(T_world_sensor), plane, grid_px, lateral_px, pixel, bundle)
    return bundle


AMBIGUITY_M = 7.5
"""Unambiguous range: half the wavelength at 20 MHz, the difference between the 60 and 80 MHz that such cameras use. Two
returns less than half of it apart mix to a range between them."""
_OFFSET_M = 1e-3
"""Scattered rays start this far off the surface, so that they do not hit it again."""


@njit(cache=True)
def fill_bundle(T, plane, grid_px, lateral_px, pixel, bundle):
    """Write the rays of all pixels ``plane (N, 2)``, displaced in the image by ``grid_px (9, 2)`` and ``lateral_px
    (N, 2)``, to ``bundle (9, N, 6)``."""
    for s in range(len(grid_px)):
        for n in range(len(plane)):
            y = plane[n, 0] + (grid_px[s, 0] + lateral_px[n, 0]) * pixel[0]
            z = plane[n, 1] + (grid_px[s, 1] + lateral_px[n, 1]) * pixel[1]
            length = math.sqrt(1 + y * y + z * z)
            for i in range(3):
                bundle[s, n, i] = T[s, i, 3]
                bundle[s, n, 3 + i] = (T[s, i, 0] + T[s, i, 1] * y + T[s, i, 2] * z) / length


@njit(cache=True)
def amplitudes(bundle, range_m, normal, reflectivity):
    """Amplitudes ``(9, N)`` float32 of the first returns, 1/m², 0 for no return."""
    amplitude = np.zeros(range_m.shape, np.float32)
    for s in range(range_m.shape[0]):
        for n in range(range_m.shape[1]):
            if np.isfinite(range_m[s, n]):
                cosine = 0.0
                for i in range(3):
                    cosine += np.float64(np.float32(normal[s, n, i] * bundle[s, n, 3 + i]))
                square = np.float64(np.float32(range_m[s, n] * range_m[s, n]))
                amplitude[s, n] = reflectivity * abs(cosine) / square
    return amplitude


@njit(cache=True)
def scattered_rays(bundle, range_m, normal, near, uniform, onward):
    """Write a scattered ray from each of the hits ``near (M,)`` to ``onward``. Its direction, the normal plus a random
    unit vector, is cosine-distributed (Lambert)."""
    for m in range(len(near)):
        k = near[m]
        cosine = 0.0
        for i in range(3):
            cosine += normal[k, i] * bundle[k, 3 + i]
        side = -1.0 if cosine > 0 else 1.0
        up, turn = 2 * uniform[m, 0] - 1, 2 * math.pi * uniform[m, 1]
        flat = math.sqrt(1 - up * up)
        x, y = side * normal[k, 0] + flat * math.cos(turn), side * normal[k, 1] + flat * math.sin(turn)
        z = side * normal[k, 2] + up
        length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        onward[m, 3], onward[m, 4], onward[m, 5] = x / length, y / length, z / length
        for i in range(3):
            onward[m, i] = bundle[k, i] + range_m[k] * bundle[k, 3 + i] + _OFFSET_M * side * normal[k, i]


@njit(cache=True)
def multipath(bundle, range_m, near, onward, range_2_m, normal_2, share, multipath_m, multipath_amplitude):
    """Write half the path length and the amplitude of light that travels via the hits ``near`` and a second surface.

    As scattered directions are cosine-distributed, a pixel's amplitude is the mean of ρ²·cos θ₂ / r₂² over its rays.
    """
    for m in range(len(near)):
        if not np.isfinite(range_2_m[m]):
            continue
        k = near[m]
        square, projection, facing = 0.0, 0.0, 0.0
        for i in range(3):
            back = bundle[k, i] - (onward[m, i] + range_2_m[m] * onward[m, 3 + i])  # from the second hit to the sensor
            square += back * back
            projection += back * normal_2[m, i]
            facing += onward[m, 3 + i] * normal_2[m, i]
        distance = math.sqrt(square)
        cosine = (-projection if facing > 0 else projection) / distance
        if cosine > 0:
            multipath_m[k] = 0.5 * (distance + range_2_m[m] + range_m[k])
            multipath_amplitude[k] = share * cosine / square


@njit(cache=True)
def mix_phasors(range_m, amplitude, multipath_m, multipath_amplitude, mixed, equivalent):
    """Write the range from the phase of a pixel's summed phasors, in the period around its strongest return, and the
    equivalent range (`Exposure`) of their mean amplitude. Both are infinite without light."""
    rays_a_pixel, wave = range_m.shape[0], 2 * math.pi / AMBIGUITY_M
    for n in range(range_m.shape[1]):
        strongest = 0
        for s in range(rays_a_pixel):
            if amplitude[s, n] > amplitude[strongest, n]:
                strongest = s
        mixed[n] = equivalent[n] = np.inf
        if amplitude[strongest, n] <= 0:
            continue
        reference, real, imaginary = range_m[strongest, n], 0.0, 0.0
        for s in range(rays_a_pixel):
            if amplitude[s, n] > 0:
                phase = wave * (range_m[s, n] - reference)
                real += amplitude[s, n] * math.cos(phase)
                imaginary += amplitude[s, n] * math.sin(phase)
            if multipath_amplitude[s, n] > 0:
                phase = wave * (multipath_m[s, n] - reference)
                real += multipath_amplitude[s, n] * math.cos(phase)
                imaginary += multipath_amplitude[s, n] * math.sin(phase)
        mixed[n] = reference + math.atan2(imaginary, real) / wave
        equivalent[n] = 1 / math.sqrt(max(math.hypot(real, imaginary) / rays_a_pixel, 1e-12))
