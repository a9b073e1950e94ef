"""One exposure of a phase-measuring Time-of-Flight camera with the faults of a real one.

Of each pixel nine rays are cast, spread over the patch that it sees and over the time of the exposure. A return is a
phasor: its phase is the length of its path, its amplitude ρ·cos θ / r² for reflectivity, incidence and range (matt
surfaces). A pixel measures the phase of the sum (Lange, Seitz, "Solid-state time-of-flight range camera", IEEE Journal
of Quantum Electronics 37, 2001), so one that sees two depths measures a range between them, and one in a corner a range
too long. The sum's amplitude also gives the noise, as the range from which the data sheet's target returns that much
light: where the light itself makes the noise, its standard deviation goes with that range (as there).

Left out: light by way of the ground or of more than one other surface, shadow on that surface, gloss, stray light in
the lens, wrong multiples of the ambiguity, errors of the lens's calibration, and a time stamp that is off.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.settings import TofFault, TofSettings
from steelnb.simulation.scene import Scene, cast_bundle, rays
from steelnb.simulation.sections import GROUND
from steelnb.types import Array, IntArray

Floats = NDArray[np.float32]

_MAGIC = np.array([8, 1, 6, 3, 5, 7, 4, 9, 2])
MOMENTS = (_MAGIC - 5) / 9
"""When each of the nine rays of a pixel is cast, in lengths of the exposure from its middle. They stand in a 3 × 3
square, row by row; as it is magic, neither rows nor columns go with time, and the middle one has the middle moment.
Cameras of this kind take nine raw images a scan, too (eight phases and a dark one)."""
MIDDLE = 4
AMBIGUITY_M = 7.5
"""Range of one period of the phase that tells near from far: half the wavelength of 20 MHz, the difference of the 60
and 80 MHz of such cameras. Returns that lie less than half of it apart mix to a range between them."""
WIGGLE_PERIOD_M = 0.625
"""A quarter of the period at 60 MHz: odd harmonics of the light, sampled at four phases (Lindner, Schiller, Kolb, Koch,
"Time-of-Flight sensor calibration for accurate range sensing", CVIU 114, 2010)."""
_LIFT_M = 1e-3


@dataclass(frozen=True)
class Faults:
    """Sizes of the faults of a kind of camera; the defaults are those of a faultless one.

    ``footprint_px``: width of the patch that a pixel sees, in pixels, which makes mixed pixels at depth edges;
    ``lateral_px``: standard deviation of its place across the ray; ``exposure_s``: time over which a scan is taken,
    centred on its stamp; ``multipath``: share of the light that goes on from one surface to the next, where 1 is a
    matt surface; ``reflectivity``: that of all surfaces by that of the data sheet's target; ``sigma_max_m``: a pixel is
    dropped where the noise that its amplitude promises is higher. ``wiggle_m``: amplitude of the error that is periodic
    in the range. ``offset_sigma_m`` and ``scale_sigma``: standard deviations, over the cameras of a kind, of a constant
    error of the range and of one in proportion to it; each seed has a camera of its own.
    """

    footprint_px: float = 0.0
    lateral_px: float = 0.0
    exposure_s: float = 0.0
    multipath: float = 0.0
    reflectivity: float = 1.0
    sigma_max_m: float = 1.0
    wiggle_m: float = 0.0
    offset_sigma_m: float = 0.0
    scale_sigma: float = 0.0


REFLECTIVITY = 0.5
"""Of weathered zinc by a white target, in the near infrared: assumed."""
REAL: dict[TofFault, dict[str, float]] = {
    # A pixel sees its whole square; blur of the lens is left out. Lateral noise is assumed: 1/sqrt(12), a place known
    # to the pixel; Nguyen, Izadi, Lovell (3DIMPVT 2012) have 0.8 with structured light.
    "footprint": {"footprint_px": 1.0, "lateral_px": 0.3},
    # Assumed: 8 + 1 raw images of up to 2 ms at 5 Hz (pmd Royale, MODE_9_5FPS_2000), each read out in about 1.3 ms.
    "exposure": {"exposure_s": 0.03},
    "multipath": {"multipath": 1.0, "reflectivity": REFLECTIVITY},  # matt surfaces
    "amplitude": {"reflectivity": REFLECTIVITY, "sigma_max_m": 0.07},  # pmd Royale, NoiseThreshold
    # Assumed: calibration leaves a few mm to 1 cm; its form as in Lindner, Schiller, Kolb, Koch (CVIU 114, 2010).
    "wiggle": {"wiggle_m": 0.005},
    # The data sheet's error of 1 % within 0.5 to 4 m leaves room for 5 mm at 0.5 m and, as a limit of three standard
    # deviations, for 0.3 % of the range.
    "calibration": {"offset_sigma_m": 0.005, "scale_sigma": 0.003},
}
"""Fault → its size for the camera of a Starling 2. "Assumed" is what no data sheet or paper says of this camera."""


def faults_of(settings: TofSettings) -> Faults | None:
    """The sizes of the settings' faults, None for none."""
    sizes = {name: size for fault in settings.faults for name, size in REAL[fault].items()}
    return Faults(**sizes) if sizes else None


class Camera(NamedTuple):
    """One camera of its kind: constant error of the range, its scale, and the phase of its wiggling, in radians."""

    offset_m: float
    scale: float
    phase_rad: float


class Exposure(NamedTuple):
    """Images ``(H, W)``: ``range_m`` float32 as measured but for noise, infinite for no light; ``as_far_as_m``, the
    range from which the data sheet's target, seen squarely, returns as much, None where that is the range itself; and
    of the ray in the middle the exact range ``exact_m`` and the ``member`` hit, as `cast_rays` gives them."""

    range_m: Floats
    as_far_as_m: Floats | None
    exact_m: Floats
    member: IntArray


def draw_camera(faults: Faults, random: np.random.Generator) -> Camera:
    """A camera of the kind that has the faults."""
    offset, scale = random.standard_normal(2)
    phase = random.uniform(0, 2 * math.pi)
    return Camera(faults.offset_sigma_m * offset, 1 + faults.scale_sigma * scale, phase)


def expose(
    scene: Scene, settings: TofSettings, faults: Faults, camera: Camera, T_world_sensor: Array,
    random: np.random.Generator,
) -> Exposure:  # fmt: skip
    """One exposure, without noise, from the poses ``T_world_sensor (9, 4, 4)`` at its nine moments (`MOMENTS`).

    ``random`` draws the lateral noise and the way that light goes on from a surface.
    """
    ray = rays(settings)
    plane = (ray[..., 1:] / ray[..., :1]).reshape(-1, 2)
    pixel = np.array([-math.tan(settings.fov_horizontal_rad / 2) * 2 / settings.columns,
                      -math.tan(settings.fov_vertical_rad / 2) * 2 / settings.rows])  # fmt: skip
    place = faults.footprint_px / 3 * (np.array([(i % 3, i // 3) for i in range(9)]) - 1)
    shift = faults.lateral_px * random.standard_normal(plane.shape) if faults.lateral_px else np.zeros(plane.shape)
    bundle = np.empty((9, len(plane), 6), np.float32)
    _aim(plane, place, shift, pixel, np.ascontiguousarray(T_world_sensor), bundle)
    hit = cast_bundle(scene, bundle)
    light, detour, detour_light = np.empty_like(hit.range_m), np.zeros_like(hit.range_m), np.zeros_like(hit.range_m)
    _reflect(bundle, hit.range_m, hit.normal, faults.reflectivity, light)
    near = np.flatnonzero((hit.member != GROUND) & (hit.range_m <= settings.range_max_m))
    if faults.multipath > 0 and len(near):
        # Each of a pixel's nine rays goes on within a ninth of the directions of its own, so that few draws are even.
        stratum = np.column_stack(np.divmod(near // len(plane), 3))
        drawn = (stratum + random.random((len(near), 2))) / 3
        onward = np.empty((len(near), 6), np.float32)
        _scatter(bundle.reshape(-1, 6), hit.range_m.ravel(), hit.normal.reshape(-1, 3), near, drawn, onward)
        second = cast_bundle(scene, onward)
        range_2_m = np.where(second.member != GROUND, second.range_m, np.float32(np.inf))
        share = faults.multipath * faults.reflectivity**2
        _return(bundle.reshape(-1, 6), hit.range_m.ravel(), near, onward, range_2_m, second.normal,
                share, detour.ravel(), detour_light.ravel())  # fmt: skip
    mixed, as_far_as = np.empty(len(plane)), np.empty(len(plane))
    _mix(hit.range_m, light, detour, detour_light, mixed, as_far_as)
    with np.errstate(invalid="ignore"):  # no light: an infinite range
        wiggle = faults.wiggle_m * np.sin(2 * math.pi * mixed / WIGGLE_PERIOD_M + camera.phase_rad)
    measured = np.where(np.isfinite(mixed), camera.scale * mixed + camera.offset_m + wiggle, np.inf)
    shape = ray.shape[:2]
    return Exposure(
        measured.astype(np.float32).reshape(shape), as_far_as.astype(np.float32).reshape(shape),
        hit.range_m[MIDDLE].reshape(shape), hit.member[MIDDLE].reshape(shape),
    )  # fmt: skip


@njit(cache=True)
def _aim(plane, place, shift, pixel, T, bundle):
    """Rays of each pixel ``plane (N, 2)``, moved by the ``place (9, 2)`` of each of its nine and by its own ``shift``,
    both in pixels."""
    for s in range(bundle.shape[0]):
        for n in range(bundle.shape[1]):
            y = plane[n, 0] + (place[s, 0] + shift[n, 0]) * pixel[0]
            z = plane[n, 1] + (place[s, 1] + shift[n, 1]) * pixel[1]
            length = math.sqrt(1 + y * y + z * z)
            for i in range(3):
                bundle[s, n, i] = T[s, i, 3]
                bundle[s, n, 3 + i] = (T[s, i, 0] + T[s, i, 1] * y + T[s, i, 2] * z) / length


@njit(cache=True)
def _reflect(bundle, range_m, normal, reflectivity, light):
    """Amplitude of each return: reflectivity · cos(incidence) / range², in 1/m²; 0 for none."""
    for s in range(range_m.shape[0]):
        for n in range(range_m.shape[1]):
            slope = 0.0
            for i in range(3):
                slope += normal[s, n, i] * bundle[s, n, 3 + i]
            light[s, n] = reflectivity * abs(slope) / range_m[s, n] ** 2


@njit(cache=True)
def _scatter(bundle, range_m, normal, near, uniform, onward):
    """A ray that goes on from each of the hits ``near (M,)``, its direction drawn by the cosine to the normal: the sum
    of the normal and of a random unit vector."""
    for m in range(len(near)):
        k = near[m]
        slope = 0.0
        for i in range(3):
            slope += normal[k, i] * bundle[k, 3 + i]
        side = -1.0 if slope > 0 else 1.0
        up, turn = 2 * uniform[m, 0] - 1, 2 * math.pi * uniform[m, 1]
        flat = math.sqrt(1 - up * up)
        x, y = side * normal[k, 0] + flat * math.cos(turn), side * normal[k, 1] + flat * math.sin(turn)
        z = side * normal[k, 2] + up
        length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        onward[m, 3], onward[m, 4], onward[m, 5] = x / length, y / length, z / length
        for i in range(3):  # off the surface, so that it is not hit again
            onward[m, i] = bundle[k, i] + range_m[k] * bundle[k, 3 + i] + _LIFT_M * side * normal[k, i]


@njit(cache=True)
def _return(bundle, range_m, near, onward, range_2_m, normal_2, share, detour, detour_light):
    """Half the length, and amplitude, of light that reached the hits ``near`` by way of a second surface.

    The directions are drawn by the cosine, so the light that a surface sends on is the mean of what the second ones
    send to it: ρ·cos θ₂ / r₂² each.
    """
    for m in range(len(near)):
        if not np.isfinite(range_2_m[m]):
            continue
        k = near[m]
        square, slope, facing = 0.0, 0.0, 0.0
        for i in range(3):
            back = bundle[k, i] - (onward[m, i] + range_2_m[m] * onward[m, 3 + i])  # to the sensor
            square += back * back
            slope += back * normal_2[m, i]
            facing += onward[m, 3 + i] * normal_2[m, i]
        distance = math.sqrt(square)
        cosine = (-slope if facing > 0 else slope) / distance
        if cosine > 0:
            detour[k] = 0.5 * (distance + range_2_m[m] + range_m[k])
            detour_light[k] = share * cosine / square


@njit(cache=True)
def _mix(range_m, light, detour, detour_light, mixed, as_far_as):
    """Range whose phase is that of the sum of a pixel's phasors, next to its strongest return, and the range from which
    the data sheet's target returns the amplitude of the sum; both infinite for no light."""
    rays_a_pixel, wave = range_m.shape[0], 2 * math.pi / AMBIGUITY_M
    for n in range(range_m.shape[1]):
        strongest = 0
        for s in range(rays_a_pixel):
            if light[s, n] > light[strongest, n]:
                strongest = s
        mixed[n] = as_far_as[n] = np.inf
        if light[strongest, n] <= 0:
            continue
        reference, real, imaginary = range_m[strongest, n], 0.0, 0.0
        for s in range(rays_a_pixel):
            if light[s, n] > 0:
                phase = wave * (range_m[s, n] - reference)
                real += light[s, n] * math.cos(phase)
                imaginary += light[s, n] * math.sin(phase)
            if detour_light[s, n] > 0:
                phase = wave * (detour[s, n] - reference)
                real += detour_light[s, n] * math.cos(phase)
                imaginary += detour_light[s, n] * math.sin(phase)
        mixed[n] = reference + math.atan2(imaginary, real) / wave
        as_far_as[n] = 1 / math.sqrt(max(math.hypot(real, imaginary) / rays_a_pixel, 1e-12))
