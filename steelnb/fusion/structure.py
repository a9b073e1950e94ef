"""The result of a reconstruction: bars and joints."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steelnb.core.checks import check_length, checked_array, checked_integers, checked_sizes, set_checked
from steelnb.core.errors import InputError
from steelnb.core.types import Array, IntArray, Segments


@dataclass(frozen=True, eq=False)
class Structure:
    """Bars and joints in the world frame, metres, z up.

    ``segments``: axes of the B bars; ``width_m (B,)``: width of the flange, or diameter of a round tube, NaN if
    unknown; ``sightings (B,)``: number of scans that observed a bar; ``sigma_m (B,)``: standard deviation of its
    axis's position across. ``joint (J, 3)``; ``tie (T, 2)``: (joint, bar), one row for each bar that a joint ties.
    ``reason``: why the structure is empty, else empty. ``opening (B, 3)``: unit vectors across the bars from the corner
    of the angle section to between its flanges, NaN if unknown; None if all are unknown. ``tube (B,)``: mask of the
    round tubes; None if none is known.
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

    def __post_init__(self) -> None:
        bars = len(self.segments)
        set_checked(
            self,
            width_m=checked_sizes(self.width_m, "Structure.width_m", bars),
            sightings=checked_integers(self.sightings, "Structure.sightings", (bars,), 0),
            sigma_m=checked_sizes(self.sigma_m, "Structure.sigma_m", bars),
            joint=checked_array(self.joint, "Structure.joint", ("J", 3)),
            tie=checked_integers(self.tie, "Structure.tie", ("T", 2), 0),
        )
        for name in ("opening", "tube"):
            if getattr(self, name) is not None:
                check_length(getattr(self, name), f"Structure.{name}", bars, "one a bar")
        if not (self.tie < (len(self.joint), bars)).all():
            raise InputError(f"Structure.tie: expected numbers of {len(self.joint)} joints and {bars} bars")

    def __len__(self) -> int:
        return len(self.segments)

    def __repr__(self) -> str:
        why = f": {self.reason}" if self.reason else ""
        return f"Structure({len(self)} bars, {self.segments.length.sum():.2f} m in all, {len(self.joint)} joints{why})"

    @staticmethod
    def of(bars: Segments, reason: str = "") -> "Structure":
        """Bars without joints, of unknown width and accuracy, each observed once."""
        unknown = np.full(len(bars), np.nan)
        ones = np.ones(len(bars), dtype=np.int64)
        return Structure(bars, unknown, ones, unknown, np.zeros((0, 3)), np.zeros((0, 2), np.int64), reason)

    @staticmethod
    def empty(reason: str = "") -> "Structure":
        return Structure.of(Segments.empty(), reason)

    def moved(self, by: Array) -> "Structure":
        """The structure translated by ``by (3,)``, metres."""
        return replace(self, segments=self.segments.moved(by), joint=self.joint + by)

    def pieces(self) -> IntArray:
        """Pieces of bars between neighbouring joints ``(P, 3)``: (joint, joint, bar)."""
        found: list[tuple[int, int, int]] = []
        for bar in range(len(self)):
            tied = self.tie[self.tie[:, 1] == bar, 0]
            along = (self.joint[tied] - self.segments.start[bar]) @ self.segments.direction[bar]
            found += [(a, b, bar) for a, b in itertools.pairwise(tied[np.argsort(along, kind="stable")].tolist())]
        return np.array(found, dtype=np.int64).reshape(-1, 3)
