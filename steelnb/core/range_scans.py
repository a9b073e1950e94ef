"""Simulated scans in memory."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, Scan


class RangeScans(Sequence[Scan]):
    """Scans stored as range images, in a sixth of the memory; their points are computed on access.

    ``stamp_s (K,)``; ``range_m (K, H, W)`` float32 along the ray, NaN for no return; ``ray (H, W, 3)`` unit vectors in
    the sensor frame, whose x axis is the optical axis.
    """

    def __init__(self, stamp_s: Array, range_m: NDArray[np.float32], ray: Array) -> None:
        self.stamp_s, self.range_m, self.ray = stamp_s, range_m, ray

    def __getstate__(self) -> tuple[NDArray[Any], ...]:
        # Only the returns are stored, as most rays miss the structure.
        returned = ~np.isnan(self.range_m)
        return self.stamp_s, self.ray, np.packbits(returned), np.array(returned.shape), self.range_m[returned]

    def __setstate__(self, state: tuple[NDArray[Any], ...]) -> None:
        self.stamp_s, self.ray, bits, shape, returns_m = state
        self.range_m = np.full(shape, np.nan, np.float32)
        self.range_m[np.unpackbits(bits, count=self.range_m.size).reshape(shape).astype(bool)] = returns_m

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        if isinstance(index, slice):
            return RangeScans(self.stamp_s[index], self.range_m[index], self.ray)
        return Scan(float(self.stamp_s[index]), self.range_m[index][..., None] * self.ray)
