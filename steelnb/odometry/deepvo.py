"""Learned odometry: a small convolutional network estimates the translation between two range images.

After Wang, Clark, Wen and Trigoni, "DeepVO: Towards end-to-end visual odometry with deep recurrent convolutional neural
networks" (ICRA 2017), for range images instead of colour, and without its recurrent part.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from steelnb.core.errors import InputError
from steelnb.core.files import new_file, reading
from steelnb.core.types import Array, Scan
from steelnb.odometry.base import BaseOdometry, FoundPose, Stopwatch
from steelnb.settings import DeepVoSettings, OdometrySettings
from steelnb.settings.presets import PRESETS

VERSION = "steelnb-deepvo-1"
"""Version of the weights' file format and of the network's input and output."""
STRIDES = (2, 2, 1, 2, 2)
SHAPES = (
    (8, 4, 5, 5), (24, 8, 3, 3), (32, 24, 3, 3), (48, 32, 3, 3), (64, 48, 3, 3), (96, 768), (6, 96),
)  # fmt: skip
"""Strides of the convolutions, and shapes of all weights: kernels ``(C_out, C_in, k, k)``, then matrices."""
NAMES = (*(f"kernel_{k}" for k in range(len(STRIDES))), "matrix_0", "matrix_1")
WEIGHTS = PRESETS / "deepvo.npz"


class Network(NamedTuple):
    """Convolutions, each followed by a ReLU: ``kernel (C_out, C_in, k, k)`` and ``bias (C_out,)``; then matrices
    ``(out, in)`` with biases ``(out,)`` and a ReLU in between. All float32."""

    kernels: tuple[tuple[np.ndarray, np.ndarray], ...]
    matrices: tuple[tuple[np.ndarray, np.ndarray], ...]

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Outputs ``(B, out)`` float32 for a batch ``(B, C, H, W)``."""
        x = np.ascontiguousarray(images.transpose(0, 2, 3, 1), dtype=np.float32)
        for (kernel, bias), stride in zip(self.kernels, STRIDES, strict=True):
            x = np.maximum(convolved(x, kernel, stride) + bias, 0)
        flat = x.transpose(0, 3, 1, 2).reshape(len(x), -1)
        for k, (matrix, bias) in enumerate(self.matrices):
            flat = (np.maximum(flat, 0) if k else flat) @ matrix.T + bias
        return flat


def convolved(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    """Cross-correlation ``(B, H', W', C_out)`` of images ``(B, H, W, C_in)`` with a ``kernel (C_out, C_in, k, k)``,
    padded with ``k // 2`` zeros on each side, as one matrix product over all windows."""
    size = kernel.shape[-1]
    pad = size // 2
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    window = sliding_window_view(x, (size, size), axis=(1, 2))[:, ::stride, ::stride]  # (B, H', W', C_in, k, k)
    rows = window.transpose(0, 1, 2, 4, 5, 3).reshape(*window.shape[:3], -1)  # channels last, for contiguous copies
    return rows @ kernel.transpose(2, 3, 1, 0).reshape(-1, len(kernel))


def read_network(path: Path = WEIGHTS) -> Network:
    """Read a network from a weights file. Raises `InputError`, also for another version or architecture."""
    form = f"weights of version {VERSION!r}"
    with reading(path, form), np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    found = str(arrays.pop("version", "none"))
    if found != VERSION:
        raise InputError(f"{path}: weights of version {found!r}; expected {VERSION!r}")
    layers = []
    for name, shape in zip(NAMES, SHAPES, strict=True):
        pair = [arrays.get(each, np.zeros(0)) for each in (name, f"bias_{name}")]
        if pair[0].shape != shape or pair[1].shape != shape[:1] or not all(np.isfinite(each).all() for each in pair):
            shapes = " and ".join(f"{each.shape}" for each in pair)
            raise InputError(f"{path}: {name} and bias_{name} {shapes}; expected {form}, {shape} and {shape[:1]}")
        layers.append((pair[0].astype(np.float32), pair[1].astype(np.float32)))
    return Network(tuple(layers[: len(STRIDES)]), tuple(layers[len(STRIDES) :]))


def write_network(path: Path, network: Network) -> None:
    """Write a network's weights to a file, as float16."""
    arrays = {"version": np.array(VERSION)}
    for name, (weight, bias) in zip(NAMES, (*network.kernels, *network.matrices), strict=True):
        arrays |= {name: weight.astype(np.float16), f"bias_{name}": bias.astype(np.float16)}
    with new_file(path) as target, target.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


COLUMNS, ROWS = 48, 64
TAN_HALF_WIDTH, TAN_HALF_HEIGHT = 0.9325, 1.327
"""Size of a derotated image, and tangents of half its fields of view, as for a Starling 2's sensor."""
COVERAGE_MIN = 0.01
"""Minimum share of pixels with returns; scans with fewer are skipped."""
GAP_MAX_S = 0.65
"""Maximum time between the scans of a pair. In training, it was up to three periods of 0.2 s."""
UNIT_M = 0.1
"""Unit of length of the network's output."""
MIRROR = np.array([1.0, -1.0, 1.0])
"""Signs of the translation between mirrored images."""


def derotated(points: Array, R_level_sensor: Array) -> np.ndarray:
    """Range image ``(2, ROWS, COLUMNS)`` float32 as seen by a levelled camera: the share of each pixel that has
    returns, and this share times their mean inverse range, 1/m.

    ``points (N, 3)`` or ``(H, W, 3)``, sensor frame, metres, NaN for no return. Each point is distributed over the four
    pixels around it with bilinear weights, which preserves sub-pixel edges.
    """
    count = points.size // 3 if points.ndim == 3 else 240 * 180
    points = points.reshape(-1, 3)
    x, y, z = (points[np.isfinite(points[:, 0])] @ R_level_sensor.T).T
    ahead = x > 0.05
    x, y, z = x[ahead], y[ahead], z[ahead]
    column, row = (1 - y / x / TAN_HALF_WIDTH) * (COLUMNS / 2) - 0.5, (1 - z / x / TAN_HALF_HEIGHT) * (ROWS / 2) - 0.5
    inside = (column > -1) & (column < COLUMNS) & (row > -1) & (row < ROWS)
    column, row = column[inside], row[inside]
    inverse = 1 / np.sqrt(x[inside] ** 2 + y[inside] ** 2 + z[inside] ** 2)
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    right, down = column - left, row - top
    width = COLUMNS + 2
    cell = (top + 1) * width + left + 1
    image = np.zeros((2, (ROWS + 2) * width))
    for by_row, share_row in ((0, 1 - down), (1, down)):
        for by_column, share_column in ((0, 1 - right), (1, right)):
            weight, at = share_row * share_column, cell + by_row * width + by_column
            image[0] += np.bincount(at, weight, image.shape[1])
            image[1] += np.bincount(at, weight * inverse, image.shape[1])
    image *= ROWS * COLUMNS / max(count, 1)
    return image.reshape(2, ROWS + 2, width)[:, 1:-1, 1:-1].astype(np.float32)


def level_pair(points: tuple[Array, Array], R_world_sensor: tuple[Array, Array]) -> tuple[np.ndarray, Array]:
    """Derotated images ``(4, ROWS, COLUMNS)`` of two scans with the attitudes ``R_world_sensor``, each ``(3, 3)``, as
    seen by a levelled camera with the mean of their headings; and that camera's attitude ``R_world_level (3, 3)``."""
    ahead = R_world_sensor[0][:2, 0] + R_world_sensor[1][:2, 0]
    c, s = ahead / max(float(np.hypot(*ahead)), 1e-9)
    R_world_level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    images = [derotated(p, R_world_level.T @ R) for p, R in zip(points, R_world_sensor, strict=True)]
    return np.concatenate(images), R_world_level


def motions(network: Network, images: np.ndarray) -> tuple[Array, Array]:
    """Translations ``(B, 3)`` of the sensor from the first to the second image of pairs ``(B, 4, ROWS, COLUMNS)``,
    ahead, left and up in metres, and their standard deviations ``(B, 3)``.

    They are means of four evaluations: forwards and backwards in time, plain and mirrored. Identical images therefore
    give zero translation, whatever the weights.
    """
    swapped = images[:, [2, 3, 0, 1]]
    output = network(np.concatenate([images, swapped, images[..., ::-1], swapped[..., ::-1]])).reshape(4, -1, 6)
    sign = np.stack([np.ones(3), -np.ones(3), MIRROR, -MIRROR])[:, None]
    translation, log_sigma = (sign * output[..., :3]).mean(axis=0), output[..., 3:].mean(axis=0)
    return UNIT_M * translation, UNIT_M * np.exp(log_sigma.astype(np.float64))


class DeepVoOdometry(BaseOdometry):
    """Integrates the translations that a network estimates from the derotated range images of two scans.

    It uses the prior's first pose and its attitudes, but not its later positions. There is no map, so the errors
    accumulate. The ``matches`` of a step are the pixels with returns in both images. Raises `InputError` for weights
    that cannot be used.
    """

    kind, method = DeepVoSettings, "deepvo"
    stages = "image", "network"
    settings: DeepVoSettings

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        super().__init__(settings, T_drone_sensor)
        packaged = PRESETS / self.settings.weights
        self.network = read_network(packaged if packaged.is_file() else Path(self.settings.weights))
        self._last: tuple[float, Array, Array] | None = None  # stamp, points and attitude of the last scan with returns
        self._position: Array | None = None  # position of the sensor, world frame

    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        T_world_sensor = prior @ self.T_drone_sensor
        R, lever = T_world_sensor[:3, :3], prior[:3, :3] @ self.T_drone_sensor[:3, 3]
        if self._position is None:
            self._position = T_world_sensor[:3, 3]
        reason, matches, last = "", 0, self._last
        images, R_world_level = level_pair((last[1] if last else scan.points, scan.points), (last[2] if last else R, R))
        watch.lap("image")
        has_returns = images[[0, 2]].reshape(2, -1) > 0.1
        too_few = has_returns[1].mean() < COVERAGE_MIN
        if too_few:
            reason = "too few returns"
        elif last is None:
            reason = "first scan"
        elif abs(scan.stamp_s - last[0]) > GAP_MAX_S:
            reason = f"{abs(scan.stamp_s - last[0]):.2f} s since the last scan with returns"
        else:
            matches = int(np.count_nonzero(has_returns.all(axis=0)))
            (translation,), _ = motions(self.network, images[None])
            self._position = self._position + R_world_level @ translation
        if not too_few:
            self._last = scan.stamp_s, scan.points, R
        T_world_drone = prior.copy()
        T_world_drone[:3, 3] = self._position - lever
        watch.lap("network")
        return T_world_drone, reason, matches, 0
