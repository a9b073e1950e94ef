"""Images in recordings: depths, and grey levels of cameras, which are read one at a time."""

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import FileContentError, SteelnbError
from steelnb.files import reading
from steelnb.images import GreyImage
from steelnb.types import Array

PIXELS_MAX = 1 << 23
"""Pixels of an image: a few more than 3840 × 2160."""
DEPTHS = {"16UC1": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Type and unit in metres of the encodings of depth images (REP 118)."""
GREYS = {"mono8": 1, "rgb8": 3, "bgr8": 3}
"""Bytes a pixel of the encodings that grey levels are made from."""
FILES = ("JPEG", "PNG")


class RecordedImages(Sequence[GreyImage | None]):
    """Images in files, read anew whenever they are asked for; None for one that cannot be read.

    ``walk`` begins a pass over all images, in which each is read by a call. In rising order, one pass reads them all.
    """

    def __init__(self, count: int, walk: Callable[[], Iterable[Callable[[], GreyImage]]]) -> None:
        self._count, self._walk = count, walk
        self._rest: Iterator[Callable[[], GreyImage]] = iter(())
        self._next = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        k = range(len(self))[index]
        if k < self._next:
            self._rest, self._next = iter(self._walk()), 0
        read = next(islice(self._rest, k - self._next, None), None)
        self._next = k + 1
        with suppress(SteelnbError):
            return read() if read else None


def decode_depth(message: Any, scale: float | None = None) -> Array:
    """Depths ``(H, W)`` of an Image in metres, as stored; ``scale``: metres a unit, if not REP 118's.

    Raises `FileContentError` for any other encoding, and where sizes do not fit.
    """
    kind, unit = DEPTHS[_encoding(message, DEPTHS)]
    stored = _pixels(message, np.dtype((">" if message.is_bigendian else "<") + kind))
    return np.asarray(stored * np.float64(unit if scale is None else scale))


def decode_grey(message: Any) -> GreyImage:
    """Grey levels ``(H, W)`` of an Image, or of a JPEG or PNG in a CompressedImage; colours as in `read_grey`.

    Raises `FileContentError` for any other encoding, and where sizes do not fit.
    """
    from PIL import Image

    if hasattr(message, "format"):
        return _grey(io.BytesIO(message.data), f"format {str(message.format)[:40]!r}")
    encoding = _encoding(message, GREYS)
    stored = _pixels(message, np.dtype(np.uint8), GREYS[encoding])
    if encoding == "mono8":
        return np.ascontiguousarray(stored)
    colours = stored if encoding == "rgb8" else stored[..., ::-1]
    return np.asarray(Image.fromarray(np.ascontiguousarray(colours)).convert("L"))


def read_grey(path: Path) -> GreyImage:
    """Grey levels ``(H, W)`` of a JPEG or PNG file, of colours their luma (ITU-R BT.601). Raises `FileContentError` and
    `FileMissingError`."""
    return _grey(path, str(path))


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Numbers ``(H, W)`` of a 16-bit grey PNG file. Raises `FileContentError` and `FileMissingError`."""
    with _opened(path, str(path), "a 16-bit grey PNG", ("PNG",)) as image:
        pixels = np.asarray(image)
    if pixels.ndim != 2 or pixels.dtype.kind not in "iu" or pixels.dtype.itemsize < 2:
        raise FileContentError(f"{path}: {pixels.dtype} pixels of shape {pixels.shape}; expected a 16-bit grey PNG")
    return pixels.astype(np.uint16)


def _grey(file: Path | io.BytesIO, name: str) -> GreyImage:
    with _opened(file, name, "a JPEG or PNG image", FILES) as image:
        if image.mode not in ("L", "RGB", "P", "RGBA"):
            raise FileContentError(f"{name}: pixels of mode {image.mode}; expected grey levels or colours of 8 bits")
        return np.array(image.convert("L"))


@contextmanager
def _opened(file: Path | io.BytesIO, name: str, form: str, formats: tuple[str, ...]) -> Iterator[Any]:
    """A picture of at most `PIXELS_MAX`, within the boundary of reading."""
    from PIL import Image

    with reading(name, form), Image.open(file, formats=formats) as image:
        if image.width * image.height > PIXELS_MAX:
            raise FileContentError(f"{name}: {image.width} × {image.height} pixels; expected at most {PIXELS_MAX}")
        yield image


def _encoding(message: Any, expected: Iterable[str]) -> str:
    if message.encoding not in expected:
        raise FileContentError(f"encoding {str(message.encoding)[:20]!r}; expected one of {', '.join(expected)}")
    return str(message.encoding)


def _pixels(message: Any, kind: np.dtype, channels: int = 1) -> NDArray:
    """The pixels of an Image where they lie, ``(H, W)``, or of several channels ``(H, W, C)``."""
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if rows < 1 or columns < 1 or rows * columns > PIXELS_MAX:
        raise FileContentError(f"an image of {columns} × {rows}; expected 1 to {PIXELS_MAX} pixels")
    size = channels * kind.itemsize
    if step < columns * size or len(message.data) < rows * step:
        raise FileContentError(
            f"{len(message.data)} bytes in rows of {step}; expected {rows} rows of at least {columns * size}"
        )
    data, shape, strides = np.frombuffer(message.data, np.uint8), (rows, columns), (step, size)
    inner = (channels,) if channels > 1 else ()
    return np.ndarray((*shape, *inner), kind, data, strides=(*strides, *(kind.itemsize for _ in inner)))
