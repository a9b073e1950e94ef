"""Grey-value cameras on a flight: images by ray casting, with texture, motion blur and noise."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb.core import rng
from steelnb.core.kernels import njit
from steelnb.core.types import Array, CameraImages, Floats, GreyImage, IntArray, Trajectory
from steelnb.settings import CameraSettings
from steelnb.simulation.mesh import GROUND, ON_PLATE
from steelnb.simulation.raycasting import Hits, cast_bundle, make_scene, rays, world_rays
from steelnb.simulation.tower import Tower

RATE_HZ = 10.0
"""Images per second."""
EXPOSURE_S = 0.002
SAMPLES = 4
"""Rays per pixel, spread over its area and over the exposure time, which is centred on the stamp. They anti-alias edges
and produce motion blur."""
READ_NOISE, GAIN = 1.0, 0.03
"""The variance of a pixel is READ_NOISE² + GAIN · grey, in grey levels of 255. The gain is in levels per photoelectron
(EMVA Standard 1288)."""
SPREAD_PX = 0.35
"""Distance of a pixel's outer rays from its centre ray."""
BLUR_PX = 0.5
"""Image motion during the exposure, in pixels, above which all rays of every pixel are cast."""
EDGE = 0.03
"""Relative difference of neighbouring ranges that counts as an edge."""


def focal_px(camera: CameraSettings) -> float:
    """Focal length in pixels."""
    return camera.columns / (2 * math.tan(camera.fov_horizontal_rad / 2))


def intrinsics(camera: CameraSettings) -> Array:
    """Intrinsics ``K (3, 3)`` of a camera with square pixels, in pixels, as in `steelnb.core.types.CameraImages`."""
    f = focal_px(camera)
    return np.array([[f, 0, (camera.columns - 1) / 2], [0, f, (camera.rows - 1) / 2], [0, 0, 1]])


def with_square_pixels(camera: CameraSettings) -> CameraSettings:
    """The camera with the vertical field of view that makes its pixels square."""
    return camera.replace(fov_vertical_rad=2 * math.atan(camera.rows / (2 * focal_px(camera))))


FORWARD = with_square_pixels(CameraSettings(columns=422, rows=320, fov_horizontal_rad=1.74, mount_m=(0.06, 0.0, 0.02)))
"""The forward camera of the report's drone, with square pixels and a global shutter."""


def photograph(tower: Tower, trajectory: Trajectory, camera: CameraSettings, seed: rng.Seed) -> CameraImages:
    """Images along a true trajectory, each rendered on access.

    ``trajectory``: true poses of the drone, world frame, the first at t = 0. The noise of image k comes from the stream
    ``("camera", k)`` of the seed, so the order of access does not matter.
    """
    step_s = float(trajectory.stamp_s[1] - trajectory.stamp_s[0])  # image stamps are pose stamps, as for scans
    index = np.round(np.arange(0, trajectory.stamp_s[-1] + 1e-9, 1 / RATE_HZ) / step_s).astype(int)
    stamp_s = trajectory.stamp_s[index]
    images = _Images(tower, trajectory, camera, seed, stamp_s)
    return CameraImages(stamp_s, images, intrinsics(camera), camera.T_drone_sensor)


class Camera:
    """Renders views of a tower from any pose."""

    def __init__(self, tower: Tower, settings: CameraSettings) -> None:
        self._scene, self._texture, self._focal_px = make_scene(tower), make_texture(tower), focal_px(settings)
        ray = rays(settings)
        self._shape, count = ray.shape[:2], SAMPLES - 1
        angle = 2 * np.pi * np.arange(count) / max(count, 1) + 0.3
        offset = np.zeros((SAMPLES, 3))  # the first ray is the centre of the pixel, the others lie around it
        offset[1:, 1:] = SPREAD_PX / self._focal_px * np.column_stack([np.cos(angle), np.sin(angle)])
        direction = (ray / ray[..., :1]).reshape(-1, 3) + offset[:, None]
        self._direction = (direction / np.linalg.norm(direction, axis=2)[..., None]).astype(np.float32)
        self.moments_s = EXPOSURE_S * np.append(0.0, np.linspace(-0.5, 0.5, count))

    def render(self, T_world_camera: Array) -> Floats:
        """Grey levels ``(H, W)`` float32, without noise, from the poses ``T_world_camera (SAMPLES, 4, 4)`` at
        `moments_s` from the stamp.

        At edges, and everywhere if the image is blurred, all rays of a pixel are cast; elsewhere only the centre ray.
        """
        (grey,), hit = self._cast(T_world_camera[:1], self._direction[:1])
        range_m, member = hit.range_m.reshape(self._shape), hit.member.reshape(self._shape)
        blurred = self._motion_px(T_world_camera[1], T_world_camera[-1]) > BLUR_PX
        chosen = np.arange(grey.size) if blurred else np.flatnonzero(_edges(range_m, member))
        more, _ = self._cast(T_world_camera[1:], self._direction[1:, chosen])
        grey[chosen] = (grey[chosen] + more.sum(axis=0)) / SAMPLES
        return grey.reshape(self._shape)

    def _cast(self, T_world_camera: Array, direction: Floats) -> tuple[Floats, Hits]:
        """Grey levels ``(S, N)`` and hits of rays ``(S, N, 3)`` from the poses ``(S, 4, 4)``."""
        bundle = world_rays(T_world_camera, direction)
        hit = cast_bundle(self._scene, bundle)
        grey = shade(self._texture, bundle.reshape(-1, 6), hit, 1 / self._focal_px)
        return grey.reshape(direction.shape[:2]), hit

    def _motion_px(self, first: Array, last: Array) -> float:
        """Image motion, in pixels, of a surface 1 m away between two poses."""
        turned = 0.5 * np.linalg.norm(first[:3, :3] - last[:3, :3])
        return float(self._focal_px * (turned + np.linalg.norm(first[:3, 3] - last[:3, 3])))


def _edges(range_m: Floats, member: IntArray) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` whose neighbour shows another member or, off the ground, a jump in range."""
    edge = np.zeros(range_m.shape, dtype=bool)
    inverse = 1 / range_m  # 0 for no hit
    for this, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        jump = np.abs(inverse[this] - inverse[other]) > EDGE * inverse[this]
        differs = (member[this] != member[other]) | jump & (member[this] != GROUND)
        edge[this] |= differs
        edge[other] |= differs
    return edge


@dataclass(eq=False)
class _Images(Sequence[GreyImage]):
    """The images of `photograph`, rendered on access."""

    tower: Tower
    trajectory: Trajectory
    settings: CameraSettings
    seed: rng.Seed
    stamp_s: Array

    @functools.cached_property
    def camera(self) -> Camera:
        return Camera(self.tower, self.settings)

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __getitem__(self, index: int) -> GreyImage:  # type: ignore[override]
        k = range(len(self))[index]
        T_world_drone = self.trajectory.between(float(self.stamp_s[k]) + self.camera.moments_s)
        grey = self.camera.render(T_world_drone @ self.settings.T_drone_sensor)
        sigma = np.sqrt(np.float32(READ_NOISE**2) + np.float32(GAIN) * grey)
        noise = rng.stream(self.seed, "camera", k).standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey + sigma * noise), 0, 255).astype(np.uint8)


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
