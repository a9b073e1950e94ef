"""The truth about a flight, for metrics and figures only: trajectory, tower, and the observed part of each member."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, IntArray, Trajectory
from steelnb.simulation.tower import Tower

SLICE_M = 0.05
RETURNS_MIN, LENGTH_MIN_M = 100, 0.3
"""A member is observed if it has at least this many returns over at least this length."""
SCAN_RETURNS_MIN = 30
"""Minimum number of returns in a single scan. With 100, half of the members that detectors find in a scan of 43,200
pixels would not count as observed, and all but one to five at an eighth of that density."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """Number of returns from each of the M members of a tower: ``slices`` holds, per member, the counts ``(S,)`` in
    slices of 5 cm along its axis, starting at its first joint."""

    slices: tuple[IntArray, ...]

    def __repr__(self) -> str:
        return f"Visibility({np.count_nonzero(self.observed())} of {len(self.slices)} members observed)"

    @property
    def returns(self) -> IntArray:
        """Returns from each member ``(M,)``."""
        return np.array([part.sum() for part in self.slices], dtype=np.int64)

    @property
    def length_m(self) -> Array:
        """Observed length of each member ``(M,)``, metres: that of all slices with a return."""
        return np.array([SLICE_M * np.count_nonzero(part) for part in self.slices])

    def observed(self, returns_min: int = RETURNS_MIN) -> NDArray[np.bool_]:
        """Mask ``(M,)`` of the members with enough returns over enough length. Every recall refers to these members."""
        return (self.returns >= returns_min) & (self.length_m >= LENGTH_MIN_M - 1e-9)


class SliceCounter:
    """Counts returns by member and slice, for members with axes ``(M, 2, 3)`` in the world frame."""

    def __init__(self, axes: Array) -> None:
        length = np.linalg.norm(axes[:, 1] - axes[:, 0], axis=1)
        self._begin, self._axis = axes[:, 0], (axes[:, 1] - axes[:, 0]) / length[:, None]
        self._size = np.ceil(length / SLICE_M - 1e-9).astype(np.int64)
        self._first = np.concatenate([[0], np.cumsum(self._size)])
        self._count = np.zeros(self._first[-1], dtype=np.int64)

    def add(self, points: Array, member: IntArray) -> None:
        """Count surface points ``(N, 3)``, world frame, of the members ``(N,)``."""
        along = np.einsum("ni,ni->n", points - self._begin[member], self._axis[member])
        slice_index = np.clip((along / SLICE_M).astype(np.int64), 0, self._size[member] - 1)
        self._count += np.bincount(self._first[member] + slice_index, minlength=len(self._count))

    def visibility(self) -> Visibility:
        """The counts so far."""
        return Visibility(tuple(np.split(self._count.copy(), self._first[1:-1])))


@dataclass(frozen=True, eq=False)
class Truth:
    """True ``trajectory`` at 125 Hz, the ``tower``, and the ``visibility`` of its members in the scans."""

    trajectory: Trajectory
    tower: Tower
    visibility: Visibility

    def __repr__(self) -> str:
        return f"Truth({self.trajectory!r}, {self.tower!r}, {self.visibility!r})"
