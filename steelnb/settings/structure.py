"""Settings of reconstruction: what counts as a bar. Lengths in metres, angles in radians."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import Positive, Settings


class StructureSettings(Settings):
    """The final reconstruction (`steelnb.fusion.reconstruct`).

    Points below ``floor_m`` or further from the sensor than ``range_max_m`` are left out. ``adjust``: poses and bars
    are adjusted together.
    """

    floor_m: Annotated[float, Field(allow_inf_nan=False)] = 0.2
    range_max_m: Positive = 6.0
    adjust: bool = True
