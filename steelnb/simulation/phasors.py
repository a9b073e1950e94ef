"""The kernels of an exposure (`steelnb.simulation.tof_faults`): rays of mixed pixels, amplitudes, scattered light, and
the phase of the sum."""

import math

import numpy as np

from steelnb.core.kernels import njit

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
