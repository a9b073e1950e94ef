"""Grey values of the surfaces of a scene.

All surfaces share one tile of periodic noise. Each member has its own offset in the tile and its own brightness. The
tile is sampled from a mipmap, interpolated between the two levels nearest to the size of the pixel's patch (Williams,
"Pyramidal parametrics", SIGGRAPH 1983), so distant textures do not flicker. Nothing here depends on the seed of a run.
"""

import functools
import math
from typing import NamedTuple

import numpy as np

from steelnb.core import rng
from steelnb.core.kernels import njit
from steelnb.core.types import Array, Floats
from steelnb.simulation.members import ON_PLATE
from steelnb.simulation.raycasting import Hits
from steelnb.simulation.tower import Tower

SIZE = 1024
TEXEL_M = 0.004
GROUND_TEXEL_M = 0.016
ROUGHNESS_M = (0.012, 0.25)
"""Shortest and longest period of the texture of steel; all octaves between them have equal power."""
SUN = np.array([0.36, -0.48, 0.8])
AMBIENT = 0.55
STEEL, GROUND_GREY = (95.0, 140.0), 130.0
"""Grey levels in full light. Each member draws its own from the range of steel; plates have the range's mean."""
STEEL_CONTRAST, GROUND_CONTRAST = 0.38, 0.15


class Texture(NamedTuple):
    """``pyramid``: the mipmap levels of the tile, −1 to 1, one after the other. For each of the M members: ``frame
    (M, 3, 3)`` with rows along axis and flanges, ``origin (M, 3)``, ``tile_offset (M, 2)`` in texels, ``grey (M,)``."""

    pyramid: Floats
    frame: Array
    origin: Array
    tile_offset: Array
    grey: Array


def make_texture(tower: Tower) -> Texture:
    """The texture of a tower; it is deterministic."""
    axes, random = tower.axes, rng.stream(0, "texture-members")
    along = axes[:, 1] - axes[:, 0]
    along = along / np.linalg.norm(along, axis=1)[:, None]
    flanges = np.array([(member.flange_a, member.flange_b) for member in tower.members])
    frame = np.concatenate([along[:, None], flanges], axis=1)
    tile_offset = random.uniform(0, SIZE, (len(axes), 2))
    return Texture(_pyramid(), frame, axes[:, 0], tile_offset, random.uniform(*STEEL, len(axes)))


@functools.cache
def _pyramid() -> Floats:
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)) / TEXEL_M
    low, high = (1 / length for length in reversed(ROUGHNESS_M))
    with np.errstate(divide="ignore"):
        band = np.where((frequency >= low) & (frequency <= high), 1 / frequency, 0.0)
    white = np.fft.rfft2(rng.stream(0, "texture").standard_normal((SIZE, SIZE)))
    noise = np.fft.irfft2(band * white, s=(SIZE, SIZE))
    tile = np.tanh(1.5 * noise / noise.std())  # sharpens the noise into blotches, like rust and paint
    levels = [tile]
    while len(tile) > 1:
        tile = tile.reshape(len(tile) // 2, 2, len(tile) // 2, 2).mean(axis=(1, 3))
        levels.append(tile)
    return np.concatenate([level.ravel() for level in levels]).astype(np.float32)


def shade(texture: Texture, bundle: Floats, hit: Hits, pixel_rad: float) -> Floats:
    """Grey levels ``(N,)`` at the hits of rays ``bundle (N, 6)`` that are ``pixel_rad`` apart."""
    grey = np.empty(len(bundle), dtype=np.float32)
    _shade(*texture, bundle, hit.range_m.ravel(), hit.member.ravel(), hit.normal.reshape(-1, 3), pixel_rad, grey)
    return grey


@njit(cache=True)
def _shade(pyramid, frame, origin, tile_offset, grey, bundle, range_m, member, normal, pixel_rad, out):
    local = np.empty(3)
    for n in range(len(out)):
        if not np.isfinite(range_m[n]):
            out[n] = 190.0 + 50.0 * max(bundle[n, 5], 0.0)  # sky
            continue
        incidence, light = 0.0, 0.0
        for i in range(3):
            incidence += normal[n, i] * bundle[n, 3 + i]
            light += normal[n, i] * SUN[i]
        # Geometric mean of the patch's width and of its length, which grows with oblique incidence.
        patch_m = range_m[n] * pixel_rad / math.sqrt(max(abs(incidence), 0.05))
        m = member[n]
        if m < 0:
            first, second = _projection_axes(normal[n])
            texel_m = TEXEL_M if m == ON_PLATE else GROUND_TEXEL_M
            u = (bundle[n, first] + range_m[n] * bundle[n, 3 + first]) / texel_m
            v = (bundle[n, second] + range_m[n] * bundle[n, 3 + second]) / texel_m
            value = _sample_tile(pyramid, u, v, patch_m / texel_m)
            base, contrast = GROUND_GREY, GROUND_CONTRAST
            if m == ON_PLATE:
                base, contrast = 0.5 * (STEEL[0] + STEEL[1]), STEEL_CONTRAST
        else:
            surface, most = 0, 0.0
            for j in range(3):
                local[j], along = 0.0, 0.0
                for i in range(3):
                    local[j] += frame[m, j, i] * (bundle[n, i] + range_m[n] * bundle[n, 3 + i] - origin[m, i])
                    along += frame[m, j, i] * normal[n, i]
                if abs(along) > most:
                    surface, most = j, abs(along)
            first, second = (1, 2) if surface == 0 else (0, 3 - surface)
            u = tile_offset[m, 0] + local[first] / TEXEL_M
            v = tile_offset[m, 1] + local[second] / TEXEL_M + 331.0 * surface
            value = _sample_tile(pyramid, u, v, patch_m / TEXEL_M)
            base, contrast = grey[m], STEEL_CONTRAST
        out[n] = base * (AMBIENT + (1 - AMBIENT) * abs(light)) * (1 + contrast * value)


@njit(cache=True)
def _projection_axes(normal):
    """The two world axes most parallel to the surface with this normal."""
    x, y, z = abs(normal[0]), abs(normal[1]), abs(normal[2])
    if z >= x and z >= y:
        return 0, 1
    return (1, 2) if x >= y else (0, 2)


@njit(cache=True)
def _sample_tile(pyramid, u, v, patch):
    """Value of the tile at (u, v) texels, averaged over about ``patch`` texels."""
    level = min(max(math.log2(max(patch, 1e-6)), 0.0), math.log2(SIZE) - 1.0)
    low = int(level)
    weight = level - low
    begin, size = 0, SIZE
    for _ in range(low):
        begin += size * size
        size //= 2
    scale = 1.0 / (1 << low)
    value = _bilinear(pyramid, begin, size, u * scale, v * scale)
    if weight > 0:
        coarse = _bilinear(pyramid, begin + size * size, size // 2, 0.5 * u * scale, 0.5 * v * scale)
        value += weight * (coarse - value)
    return value


@njit(cache=True)
def _bilinear(pyramid, begin, size, u, v):
    u, v = u - 0.5, v - 0.5
    column, row = math.floor(u), math.floor(v)
    right, below = u - column, v - row
    a, b = int(column) % size, int(row) % size
    c, d = (a + 1) % size, (b + 1) % size
    upper = (1 - right) * pyramid[begin + b * size + a] + right * pyramid[begin + b * size + c]
    lower = (1 - right) * pyramid[begin + d * size + a] + right * pyramid[begin + d * size + c]
    return (1 - below) * upper + below * lower
