"""sensor_msgs/Image ↔ pixels: 8-bit pictures, and depths in metres."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.errors import FileContentError

PICTURES = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "8UC3": 3, "mono8": 1, "8UC1": 1}
"""Channels of the encodings that are pictures; 8UC3 is OpenCV's, so blue comes first."""
DEPTHS = {"16UC1": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Type and unit, in metres, of the encodings that are depths (REP 118)."""


def decode_picture(message: Any) -> NDArray[np.uint8]:
    """``(H, W, 3)`` RGB or ``(H, W)`` grey. Raises `FileContentError` for an encoding that is no picture's."""
    channels = PICTURES.get(message.encoding)
    if channels is None:
        raise FileContentError(f"encoding {str(message.encoding)[:20]!r}; expected one of {', '.join(PICTURES)}")
    pixels = _pixels(message, np.dtype("u1"), channels)
    if channels == 1:
        return pixels[..., 0]
    return pixels[..., :3] if message.encoding.startswith("rgb") else pixels[..., 2::-1]


def decode_depth(message: Any, scale: float | None = None) -> Array:
    """Depths ``(H, W)`` in metres, as stored: 0 or NaN where there is none. ``scale``: metres a unit, if not REP 118's.

    Raises `FileContentError` for an encoding that is no depth's, and where sizes do not fit.
    """
    if message.encoding not in DEPTHS:
        raise FileContentError(f"encoding {str(message.encoding)[:20]!r}; expected one of {', '.join(DEPTHS)}")
    kind, unit = DEPTHS[message.encoding]
    order = ">" if message.is_bigendian else "<"
    return _pixels(message, np.dtype(order + kind), 1)[..., 0] * np.float64(unit if scale is None else scale)


def _pixels(message: Any, kind: np.dtype, channels: int) -> NDArray:
    """The pixels ``(H, W, channels)`` where they lie in the message."""
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if not 0 < rows < 2**16 or not 0 < columns < 2**16:
        raise FileContentError(f"an image of {columns} × {rows}; expected 1 to 65535 pixels each way")
    if step < columns * channels * kind.itemsize or len(message.data) < rows * step:
        raise FileContentError(
            f"{len(message.data)} bytes in rows of {step}; expected {rows} rows of at least "
            f"{columns * channels * kind.itemsize}"
        )
    strides = (step, channels * kind.itemsize, kind.itemsize)
    return np.ndarray((rows, columns, channels), kind, np.frombuffer(message.data, np.uint8), strides=strides)
