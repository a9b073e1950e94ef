"""Grey-value cameras on a flight: images by ray casting, with texture, motion blur and noise."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.core import rng
from steelnb.core.arguments import checks_arguments
from steelnb.core.types import Array, CameraImages, Floats, GreyImage, IntArray, Trajectory
from steelnb.settings import CameraSettings
from steelnb.simulation.camera_texture import make_texture, shade
from steelnb.simulation.members import GROUND
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


FORWARD = CameraSettings(columns=422, rows=320, fov_horizontal_rad=1.74, mount_m=(0.06, 0.0, 0.02))
FORWARD = FORWARD.replace(fov_vertical_rad=2 * math.atan(FORWARD.rows / (2 * focal_px(FORWARD))))
"""The forward camera of the report's drone, with square pixels and a global shutter."""


@checks_arguments
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
