"""Settings of reconstruction: what counts as a bar. Lengths in metres, angles in radians."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import NotNegative, Positive, Settings


class StructureSettings(Settings):
    """The final reconstruction (`steelnb.fusion.reconstruct`).

    Points below ``floor_m`` or further from the sensor than ``range_max_m`` are left out. ``adjust``: poses and bars
    are adjusted together.
    """

    floor_m: Annotated[float, Field(allow_inf_nan=False)] = 0.2
    range_max_m: Positive = 6.0
    adjust: bool = True


class Tolerance(Settings):
    """How two structures are compared. Up to ``offset_m``, ``angle_deg`` and ``end_m`` a bar has not moved, and up to
    ``joint_m`` a joint."""

    offset_m: NotNegative = 0.01
    angle_deg: NotNegative = 0.5
    end_m: NotNegative = 0.03
    joint_m: NotNegative = 0.02
