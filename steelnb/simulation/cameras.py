"""Grey-value cameras on a flight: images by ray casting, with texture, motion blur and noise."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steelnb import rng
from steelnb.images import CameraImages, GreyImage
from steelnb.settings.base import mount
from steelnb.simulation.scene import Hits, Scene, cast_bundle, make_scene, rays, world_rays
from steelnb.simulation.sections import GROUND
from steelnb.simulation.texture import Floats, Texture, make_texture, shade
from steelnb.simulation.tower import Tower
from steelnb.types import Array, IntArray, Trajectory

RATE_HZ = 10.0
"""Images a second."""
EXPOSURE_S = 0.002
READ_NOISE, GAIN = 1.0, 0.03
"""The variance of a pixel is READ_NOISE² + GAIN · grey, in grey levels of 255. The gain is in levels per photoelectron
(EMVA Standard 1288)."""
SPREAD_PX = 0.35
"""Distance of a pixel's outer rays from its centre ray."""
BLUR_PX = 0.5
"""With more motion than this during the exposure, all rays of every pixel are cast."""
EDGE = 0.03
"""Relative difference of neighbouring ranges that counts as an edge."""


@dataclass(frozen=True)
class CameraModel:
    """A global-shutter pinhole camera with square pixels, optical axis along the camera's x axis, y left, z up.

    ``samples`` rays per pixel are spread over its area and over the exposure time, which is centred on the stamp. They
    smooth edges and give motion blur. ``mount_m`` and ``mount_rpy_deg`` (roll, pitch, yaw about the drone's axes) place
    the camera on the drone.
    """

    columns: int
    rows: int
    fov_horizontal_rad: float
    mount_m: tuple[float, float, float]
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    samples: int = 4

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, the same along both axes."""
        return self.columns / (2 * math.tan(self.fov_horizontal_rad / 2))

    @property
    def fov_vertical_rad(self) -> float:
        """Vertical field of view; it follows from square pixels."""
        return 2 * math.atan(self.rows / (2 * self.focal_px))

    @property
    def K(self) -> Array:
        """Intrinsics ``(3, 3)``, in pixels, as in `steelnb.images.CameraImages`."""
        f = self.focal_px
        return np.array([[f, 0, (self.columns - 1) / 2], [0, f, (self.rows - 1) / 2], [0, 0, 1]])

    @property
    def T_drone_camera(self) -> Array:
        """The camera's mount, ``(4, 4)``."""
        return mount(self.mount_m, self.mount_rpy_deg)


FORWARD = CameraModel(422, 320, 1.74, (0.06, 0.0, 0.02))
TRACKING = CameraModel(640, 480, 2.32, (0.06, 0.0, -0.02), (0.0, 45.0, 0.0))
"""The two cameras of the report's drone; the second one looks down."""


class Rendered(NamedTuple):
    """Images ``(H, W)``: ``grey`` float32 without noise; ``range_m`` along the centre ray of each pixel, infinite for
    no hit; and the ``member`` that it hits, −1 for the ground and for no hit."""

    grey: Floats
    range_m: Floats
    member: IntArray


def photograph(tower: Tower, trajectory: Trajectory, model: CameraModel, seed: rng.Seed) -> CameraImages:
    """Images along a true trajectory, each rendered on access.

    ``trajectory``: true poses of the drone, world frame, the first at t = 0. The noise of image k comes from the stream
    ``("camera", k)`` of the seed, so the order of access does not matter.
    """
    step_s = float(trajectory.stamp_s[1] - trajectory.stamp_s[0])  # image stamps are pose stamps, as for scans
    index = np.round(np.arange(0, trajectory.stamp_s[-1] + 1e-9, 1 / RATE_HZ) / step_s).astype(int)
    stamp_s = trajectory.stamp_s[index]
    images = _Images(tower, trajectory, model, seed, stamp_s)
    return CameraImages(stamp_s, images, model.K, model.T_drone_camera)


class Camera:
    """Renders views of a tower from any pose."""

    def __init__(self, tower: Tower, model: CameraModel) -> None:
        self.model = model
        self._scene: Scene = make_scene(tower)
        self._texture: Texture = make_texture(tower)
        ray, count = rays(model), model.samples - 1
        plane = (ray / ray[..., :1]).reshape(-1, 3)
        angle = 2 * np.pi * np.arange(count) / max(count, 1) + 0.3
        offset = np.zeros((count + 1, 3))  # the first ray is the centre of the pixel, the others lie around it
        offset[1:, 1:] = SPREAD_PX / model.focal_px * np.column_stack([np.cos(angle), np.sin(angle)])
        direction = plane + offset[:, None]
        self._direction = (direction / np.linalg.norm(direction, axis=2)[..., None]).astype(np.float32)
        self.moments_s = EXPOSURE_S * np.append(0.0, np.linspace(-0.5, 0.5, count))

    def render(self, T_world_camera: Array) -> Rendered:
        """An image without noise from the poses ``T_world_camera (S, 4, 4)`` at the times `moments_s` from its stamp.

        At edges, and everywhere if the image is blurred, all rays of a pixel are cast; elsewhere only the centre ray.
        """
        shape = self.model.rows, self.model.columns
        grey, hit = self._cast(T_world_camera[:1], self._direction[:1])
        range_m, member = hit.range_m.reshape(shape), hit.member.reshape(shape)
        if len(T_world_camera) > 1:
            blurred = self._motion_px(T_world_camera) > BLUR_PX
            chosen = np.arange(grey.size) if blurred else np.flatnonzero(_edges(range_m, member))
            more, _ = self._cast(T_world_camera[1:], self._direction[1:, chosen])
            grey[0, chosen] = (grey[0, chosen] + more.sum(axis=0)) / len(T_world_camera)
        return Rendered(grey.reshape(shape), range_m, member)

    def _cast(self, T_world_camera: Array, direction: Floats) -> tuple[Floats, Hits]:
        """Grey levels ``(S, N)`` and hits of rays ``(S, N, 3)`` from the poses ``(S, 4, 4)``."""
        bundle = world_rays(T_world_camera, direction)
        hit = cast_bundle(self._scene, bundle)
        grey = shade(self._texture, bundle.reshape(-1, 6), hit, 1 / self.model.focal_px)
        return grey.reshape(direction.shape[:2]), hit

    def _motion_px(self, T_world_camera: Array) -> float:
        """Image motion, in pixels, of a surface 1 m away during the exposure."""
        first, last = T_world_camera[1], T_world_camera[-1]
        turned = 0.5 * np.linalg.norm(first[:3, :3] - last[:3, :3])
        return float(self.model.focal_px * (turned + np.linalg.norm(first[:3, 3] - last[:3, 3])))

    def exposed(self, grey: Floats, noise: np.random.Generator) -> GreyImage:
        """Add noise to an image ``(H, W)`` and quantise it to 8 bits."""
        sigma = np.sqrt(np.float32(READ_NOISE**2) + np.float32(GAIN) * grey)
        read = grey + sigma * noise.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(read), 0, 255).astype(np.uint8)


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
    model: CameraModel
    seed: rng.Seed
    stamp_s: Array

    @functools.cached_property
    def camera(self) -> Camera:
        return Camera(self.tower, self.model)

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __getitem__(self, index: int) -> GreyImage:  # type: ignore[override]
        k = range(len(self))[index]
        noise = rng.stream(self.seed, "camera", k)
        T_world_drone = self.trajectory.between(float(self.stamp_s[k]) + self.camera.moments_s)
        return self.camera.exposed(self.camera.render(T_world_drone @ self.model.T_drone_camera).grey, noise)
