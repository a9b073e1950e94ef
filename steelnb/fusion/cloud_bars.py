"""The bars of a merged cloud, the surfaces that were left out, and what they leave."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from steelnb.core.types import Array, IntArray, Segments
from steelnb.fusion.objects import ALONE, HELD_MIN, at_bars, in_structures
from steelnb.fusion.refit import FIT_TUBES
from steelnb.hough.freedom import ALONG_M, nearest_bar
from steelnb.points.surfaces import Surface

WIDTH_MAX = 3.0
"""Maximum median width of bars that fit in a tube, in its radii."""
OFF_MIN = 0.05
"""A cloud with a smaller share of its points off all surfaces has no bars worth a search in other tubes."""


@dataclass(frozen=True, eq=False)
class CloudBars:
    """The bars of a cloud ``points (N, 3)``, strongest first, and the surfaces that were left out.

    ``freedom (B,)``: share of the points around a bar that lie on it, 0 to 1 (`freedom_of`); ``width_m (B,)``;
    ``surfaces``; ``surface (N,)``: number of the surface that each point of the cloud lies on, or −1;
    ``voxel_m``: edge of the voxels in which the points were accumulated; ``tube_m``: radius of the tubes;
    ``narrowest_m``: radius of the narrowest tubes in which bars of slim members were found, else ``tube_m``;
    ``typical_m``: median width of the bars before those were dropped that do not stand free, NaN if there were none;
    ``apart``: number of bars that were dropped as part of no structure (`in_structures`).
    """

    points: Array
    bars: Segments
    freedom: Array
    width_m: Array
    surfaces: list[Surface]
    surface: IntArray
    voxel_m: float
    tube_m: float
    narrowest_m: float
    typical_m: float
    apart: int = 0

    def take(self, index: IntArray) -> "CloudBars":
        """The same with some bars, in this order."""
        return replace(self, bars=self.bars.take(index), freedom=self.freedom[index], width_m=self.width_m[index])

    @property
    def fit_tubes(self) -> bool:
        """Whether bars were found, and most fit in the tube. In a wider bar, lines along its sides pass for bars."""
        return len(self.bars) > 0 and self.typical_m <= WIDTH_MAX * self.tube_m

    @property
    def is_lattice(self) -> bool:
        """Whether most bars end at other bars, by the measure of `in_structures`."""
        return len(self.bars) > ALONE and at_bars(self.bars, self.tube_m).all(axis=1).mean() >= HELD_MIN

    @property
    def all_on_surfaces(self) -> bool:
        """Whether less than `OFF_MIN` of the points lie on no surface."""
        return float((self.surface < 0).mean()) < OFF_MIN

    def share_inside(self, bars: Segments) -> float:
        """Share of the length of other bars that lies inside these: one wide bar may hold several lines along its
        sides. 1 if there are none."""
        if not len(bars):
            return 1.0
        ends = zip(bars.start, bars.end, bars.length, strict=True)
        along = np.concatenate([np.linspace(a, b, 2 + int(length / ALONG_M))[:-1] for a, b, length in ends])
        return float((nearest_bar(along, self.bars, 0.5 * WIDTH_MAX * self.tube_m, self.tube_m) >= 0).mean())

    def scaled(self, scale: float, points: Array) -> "CloudBars":
        """The same with all lengths multiplied; ``points (N, 3)``: the cloud at this scale."""
        bars = replace(
            self.bars, start=scale * self.bars.start, end=scale * self.bars.end, radius=scale * self.bars.radius
        )
        surfaces = [surface.scaled(scale) for surface in self.surfaces]
        lengths = {
            name: scale * getattr(self, name) for name in ("width_m", "voxel_m", "tube_m", "narrowest_m", "typical_m")
        }
        return replace(self, points=points, bars=bars, surfaces=surfaces, **lengths)

    @cached_property
    def steel(self) -> Array:
        """The points on no surface ``(M, 3)``."""
        return self.points[self.surface < 0]

    @cached_property
    def is_off(self) -> NDArray[np.bool_]:
        """Whether each of the points on no surface lies on no bar ``(M,)``."""
        return ~self.within(FIT_TUBES)

    def within(self, reach: float) -> NDArray[np.bool_]:
        """Whether each of the points on no surface lies within ``reach`` times the half-width of a bar, or times the
        tube if that is wider ``(M,)``."""
        reach_m = reach * np.maximum(0.5 * self.width_m, self.tube_m)
        return np.asarray(nearest_bar(self.steel, self.bars, reach_m, self.tube_m) >= 0)

    @property
    def share_off(self) -> float:
        """Share of the points on no surface that lie on no bar; 0 if all lie on surfaces."""
        return np.count_nonzero(self.is_off) / max(len(self.steel), 1)

    def joined(self, more: "CloudBars") -> "CloudBars":
        """These bars and those of other tubes, the strongest first."""
        bars = Segments.joined([self.bars, more.bars])
        order = np.argsort(-bars.count, kind="stable")
        freedom, width_m = np.append(self.freedom, more.freedom), np.append(self.width_m, more.width_m)
        first = self if len(self.bars) else more
        joined = replace(
            self, bars=bars, freedom=freedom, width_m=width_m, tube_m=first.tube_m, typical_m=first.typical_m,
            narrowest_m=min(self.narrowest_m, more.narrowest_m),
        )  # fmt: skip
        return joined.take(order)

    def of_structures(self) -> "CloudBars":
        """Those bars that belong to a structure."""
        belongs = in_structures(self.steel, ~self.is_off, self.bars, self.tube_m, self.points[self.surface >= 0])
        return replace(self.take(np.flatnonzero(belongs)), apart=int(np.count_nonzero(~belongs)))
