"""Settings of reconstruction: what counts as a bar. Lengths in metres, angles in radians."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import Positive, Settings


class StructureSettings(Settings):
    """The final reconstruction (`steelnb.fusion.reconstruct`).

    ``tube_m``: radius of the tube about a bar that holds its points; all lengths of the method are in proportion to it
    (`fusion.scales`). ``min_votes``: fewest filtered points of a bar. ``copy_distance_m``: what mostly runs within it
    of a stronger bar, and hardly rises across that, is a copy of it (`fusion.merging`). Points below ``floor_m`` or
    further from the sensor than ``range_max_m`` are left out. ``adjust``: poses and bars are adjusted together. The
    defaults were chosen with those of `fusion.scales.Scales`.
    """

    tube_m: Positive = 0.06
    min_votes: Annotated[int, Field(ge=2)] = 8
    copy_distance_m: Positive = 0.2
    floor_m: Annotated[float, Field(allow_inf_nan=False)] = 0.2
    range_max_m: Positive = 6.0
    adjust: bool = True

    @classmethod
    def for_cloud(cls, tube_m: float) -> "StructureSettings":
        """For a plain cloud whose bars' points lie within ``tube_m``: no floor, and bars as near to each other as two
        tubes, since a coarse cloud does not tell the two flanges of a wide leg apart as a flight does."""
        return cls(tube_m=tube_m, floor_m=-1e6, copy_distance_m=2 * tube_m)
