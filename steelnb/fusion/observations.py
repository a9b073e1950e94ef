"""The points of a flight on the bars of its structure, as an adjustment takes them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from steelnb.types import Array, IntArray


class Observations(NamedTuple):
    """Points of K scans on bars: ``point (N, 3)`` float32, sensor frame, metres, and its ``bar (N,)``, sorted by scan:
    those of scan k are ``first[k]`` to ``first[k + 1]``. The bars of scan k are ``pair_bar[pair_first[k]]`` to
    ``pair_bar[pair_first[k + 1] - 1]``."""

    point: np.ndarray
    bar: IntArray
    first: IntArray
    pair_bar: IntArray
    pair_first: IntArray

    @property
    def pair_scan(self) -> IntArray:
        """The scan of each pair of a scan and a bar ``(P,)``."""
        return np.repeat(np.arange(len(self.pair_first) - 1), np.diff(self.pair_first))

    @classmethod
    def gathered(cls, scans: Iterable[tuple[int, Array, IntArray]], T_world_sensor: Array) -> "Observations":
        """From points in the world frame at given poses, as `fusion.reconstruct` yields them scan by scan."""
        points, bars, pairs = [], [], []
        count, pair_count = np.zeros((2, len(T_world_sensor)), dtype=np.int64)
        for k, point, bar in scans:
            R, t = T_world_sensor[k, :3, :3], T_world_sensor[k, :3, 3]
            points.append(((point - t) @ R).astype(np.float32))
            bars.append(bar.astype(np.int32))
            pairs.append(np.unique(bar))
            count[k], pair_count[k] = len(bar), len(pairs[-1])
        first, pair_first = (np.concatenate([[0], np.cumsum(number)]) for number in (count, pair_count))
        return cls(
            np.concatenate([np.zeros((0, 3), np.float32), *points]),
            np.concatenate([np.zeros(0, np.int32), *bars]),
            first,
            np.concatenate([np.zeros(0, np.int64), *pairs]),
            pair_first,
        )
