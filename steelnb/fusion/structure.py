"""The result of a reconstruction: bars, and the joints that tie them."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.types import Array, IntArray, Segments


@dataclass(frozen=True)
class Structure:
    """Bars and joints in the world frame, metres, z up.

    ``segments``: axes of the B bars from end to end, with their point counts and radii; ``width_m (B,)``: width of the
    flange of a bar, of a round tube its diameter, NaN where it is not known; ``sightings (B,)``: number of scans that
    saw it; ``sigma_m (B,)``: standard deviation of the position of its axis across. ``joint (J, 3)``; ``tie (T, 2)``:
    (joint, bar), a row for each bar that a joint ties. ``reason`` says why a structure is empty, and is itself empty if
    it is not.
    ``opening (B, 3)``: unit vectors across the bars, from the corner of each angle section to between its flanges, NaN
    where that is not known; None where it is known of no bar.
    ``tube (B,)``: which bars are round tubes; None if no bar is known to be one.
    """

    segments: Segments
    width_m: Array
    sightings: IntArray
    sigma_m: Array
    joint: Array
    tie: IntArray
    reason: str = ""
    opening: Array | None = None
    tube: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.segments)

    @staticmethod
    def empty(reason: str = "") -> "Structure":
        none = np.zeros(0)
        return Structure(
            Segments.empty(), none, np.zeros(0, np.int64), none, np.zeros((0, 3)), np.zeros((0, 2), np.int64), reason
        )

    def moved(self, by: Array) -> "Structure":
        """The same structure with ``by (3,)``, metres, added to its coordinates."""
        return replace(self, segments=self.segments.moved(by), joint=self.joint + by)

    def pieces(self) -> IntArray:
        """Pieces of bars between neighbouring joints ``(P, 3)``: (joint, joint, bar). A bar with fewer than two joints
        has none."""
        found: list[tuple[int, int, int]] = []
        for bar in range(len(self)):
            tied = self.tie[self.tie[:, 1] == bar, 0]
            along = (self.joint[tied] - self.segments.start[bar]) @ self.segments.direction[bar]
            found += [(a, b, bar) for a, b in itertools.pairwise(tied[np.argsort(along, kind="stable")].tolist())]
        return np.array(found, dtype=np.int64).reshape(-1, 3)
