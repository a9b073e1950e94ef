"""One scan ↔ one file: PLY, PCD, LAS, LAZ or NPY, with every point that the file can hold, valid or not."""

from pathlib import Path

import numpy as np

from steelnb.datatypes import Array
from steelnb.errors import FileContentError, UnsupportedFormatError
from steelnb.recordings.headers import read_pcd_image, read_ply
from steelnb.recordings.las import read_las, write_las


def read_npy(path: Path) -> Array:
    """Points ``(N, 3)`` or ``(H, W, 3)`` of a NumPy file; further columns are ignored. Raises `FileContentError`."""
    try:
        values = np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception as fault:  # its header is read as Python, so a damaged one raises whatever Python's parts do
        said = (str(fault).splitlines() or [type(fault).__name__])[0][:100]
        raise FileContentError(f"{path}: no whole NumPy file: {said}") from None
    good = isinstance(values, np.ndarray) and values.ndim in (2, 3) and values.shape[-1] >= 3
    if not good or values.dtype.kind not in "fiu":
        what = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else "several arrays"
        raise FileContentError(f"{path}: holds {what}; expected numbers of shape (N, 3) or (H, W, 3)")
    return np.ascontiguousarray(values[..., :3], dtype=np.float64)


def write_npy(path: Path, points: Array) -> None:
    """Write points as they are, image or not, in double precision."""
    np.save(path, np.asarray(points, dtype=np.float64), allow_pickle=False)


def write_ply(path: Path, points: Array) -> None:
    """Write the finite points, binary in single precision."""
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())


def write_pcd(path: Path, points: Array) -> None:
    """Write all points, binary in single precision, NaN where there is none; images keep their rows."""
    rows, columns = points.shape[:2] if points.ndim == 3 else (1, len(points))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {columns}\nHEIGHT {rows}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {rows * columns}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())


READERS = {".ply": read_ply, ".pcd": read_pcd_image, ".las": read_las, ".laz": read_las, ".npy": read_npy}
WRITERS = {".ply": write_ply, ".pcd": write_pcd, ".las": write_las, ".laz": write_las, ".npy": write_npy}


def read_points(path: Path) -> Array:
    """Points ``(N, 3)`` or, where the file tells of rows, ``(H, W, 3)``, float64, NaN rows for invalid ones.

    Raises `FileContentError`, `EmptyCloudError`, `UnsupportedFormatError` and OSError.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise UnsupportedFormatError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(READERS)}")
    points = reader(path)
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return points
