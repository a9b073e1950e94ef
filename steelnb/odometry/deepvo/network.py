"""A small convolutional network in NumPy, and its weights file. ``scripts/train-deepvo`` trains it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from steelnb.core.errors import InputError
from steelnb.core.files import new_file, reading
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
