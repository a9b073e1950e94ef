"""The files beside KITTI's poses: the stamps in times.txt, and in calib.txt the place of the scanner."""

from pathlib import Path

import numpy as np

from steelnb.core.types import Array
from steelnb.io.table_form import read_table
from steelnb.io.text import Table


def times_beside(path: Path) -> Table:
    """The table of times.txt beside the poses in ``path``: one column, the stamps. Raises ValueError."""
    beside = path.with_name("times.txt")
    if not beside.is_file():
        raise ValueError("12 numbers per line (KITTI) without stamps; expected them in times.txt beside it")
    times = read_table(beside)
    if times.columns != 1:
        raise ValueError(f"times.txt beside it has {times.columns} numbers a line; expected one, the stamp")
    return times


def of_scanner(path: Path, rows: Array) -> Array:
    """Poses of the scanner in its first frame, ``(N, 12)`` as ``T[:3]``, from those in ``path``, ``rows (N, 12)``.

    KITTI's are those of the left camera, whose z axis is ahead, and ``Tr`` in calib.txt leads from scanner to camera.
    Without calib.txt they stay as they are. Raises ValueError.
    """
    beside = path.with_name("calib.txt")
    text = beside.read_text("utf-8", "replace") if beside.is_file() else ""
    lines = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    if not {"P0", "Tr", "Tr_velo_to_cam"} & {*lines}:
        return rows
    numbers = lines.get("Tr", lines.get("Tr_velo_to_cam", "")).split()
    if len(numbers) != 12:
        raise ValueError("poses of a camera (KITTI), and calib.txt beside it has no Tr; expected its 12 numbers")
    T, T_camera_scanner = np.tile(np.eye(4), (len(rows), 1, 1)), np.eye(4)
    T[:, :3], T_camera_scanner[:3] = rows.reshape(-1, 3, 4), np.array(numbers, dtype=float).reshape(3, 4)
    return (np.linalg.inv(T_camera_scanner) @ T @ T_camera_scanner)[:, :3].reshape(-1, 12)
