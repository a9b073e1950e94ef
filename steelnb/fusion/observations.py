"""The points of a flight on the bars of its structure, as an adjustment takes them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from steelnb.types import Array, IntArray


class Observations(NamedTuple):
    """Points of scans on bars, pair by pair of a scan and a bar that it sees.

    ``point (N, 3)`` float32, sensor frame, metres: those of pair p are ``first[p]`` to ``first[p + 1]``, seen by the
    scan ``pair_scan[p]`` on the bar ``pair_bar[p]``. Pairs are sorted by scan.
    """

    point: np.ndarray
    first: IntArray
    pair_scan: IntArray
    pair_bar: IntArray

    @classmethod
    def gathered(cls, scans: Iterable[tuple[int, Array, IntArray]]) -> "Observations":
        """From points in the sensor frame and their bars, scan by scan, as `fusion.reconstruct` yields them."""
        points, counts = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int64)]
        for k, point, bar in scans:
            count = np.bincount(bar)
            name = np.flatnonzero(count)
            points.append(point[np.argsort(bar, kind="stable")].astype(np.float32))
            counts.append(np.column_stack([np.full(len(name), k), name, count[name]]))
        scan, bar, count = np.concatenate(counts).T
        return cls(np.concatenate(points), np.append(0, np.cumsum(count)), scan.copy(), bar.copy())
