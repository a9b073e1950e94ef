"""Scans kept on disk for those who want them again in any order: the final reconstruction goes through them often."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from steelnb.datatypes import Array, Scan
from steelnb.odometry import Odometry
from steelnb.replay.offline import Frame

BYTES_MAX = 4 * 10**9


class Spool(Sequence[Scan]):
    """Scans in a file, in single precision; where all would take more than ``bytes_max``, one in so many of them.

    ``number`` lists the numbers of those kept. The file goes when the spool is closed.
    """

    def __init__(self, path: Path, total: int, bytes_max: int = BYTES_MAX) -> None:
        self._path, self._total, self._bytes_max = path, total, bytes_max
        self._file = path.open("w+b", buffering=0)
        self._places: list[tuple[int, tuple[int, ...], float]] = []
        self._end, self._every = 0, 1
        self.number: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()
        self._path.unlink(missing_ok=True)

    def add(self, k: int, scan: Scan) -> None:
        """Keep scan number ``k`` of the flight, or leave it out."""
        data = np.ascontiguousarray(scan.points, dtype=np.float32)
        if not self._end and data.nbytes:  # the first scan with points says how much room all of them want
            self._every = math.ceil(data.nbytes * self._total / self._bytes_max)
        if k % self._every:
            return
        self.number.append(k)
        self._places.append((self._end, data.shape, scan.stamp_s))
        self._file.write(data.data)
        self._end += data.nbytes

    def observe(self, frame: Frame, _: Odometry) -> None:
        """Keep the scan of a frame, as an observer of a replay."""
        self.add(frame.index, frame.scan)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        begin, shape, stamp_s = self._places[index]
        data = os.pread(self._file.fileno(), 4 * math.prod(shape), begin)
        points: Array = np.frombuffer(data, dtype=np.float32).reshape(shape).astype(np.float64)
        return Scan(stamp_s, points)
