"""PNG files ↔ pixels, by Pillow; what it raises for broken files is wrapped."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import FileContentError

MOST_PIXELS = 1 << 26


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Numbers ``(H, W)`` of a 16-bit grey PNG file. Raises `FileContentError` and FileNotFoundError."""
    image = _pixels(path)
    if image.ndim != 2 or image.dtype.kind not in "iu" or image.dtype.itemsize < 2:
        raise FileContentError(f"{path}: {image.dtype} pixels of shape {image.shape}; expected a 16-bit grey PNG")
    return image.astype(np.uint16)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Pixels ``(H, W, 3)`` RGB or ``(H, W)`` grey. Raises `FileContentError` and FileNotFoundError."""
    return _pixels(path, "RGB").astype(np.uint8)


def write_png(path: Path, pixels: NDArray) -> None:
    """Write uint16 depths or uint8 pixels."""
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(pixels)).save(path)


def size_of(path: Path) -> tuple[int, int]:
    """Rows and columns of an image, from its header. Raises as `read_depth`."""
    return _pixels(path, header_only=True).shape[:2]  # type: ignore[return-value]


def _pixels(path: Path, mode: str | None = None, header_only: bool = False) -> NDArray:
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.width * image.height > MOST_PIXELS:
                raise FileContentError(f"{path}: {image.width} × {image.height} pixels; expected at most {MOST_PIXELS}")
            if header_only:
                return np.broadcast_to(np.uint8(0), (image.height, image.width))
            return np.asarray(image.convert(mode) if mode and image.mode not in ("L", mode) else image)
    except (FileContentError, FileNotFoundError):
        raise
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError, MemoryError) as fault:
        said = (str(fault).splitlines() or [type(fault).__name__])[0].replace(str(path), "it")[:80]
        raise FileContentError(f"{path}: no whole image: {said}") from None
