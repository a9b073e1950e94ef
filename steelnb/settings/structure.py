"""Settings of reconstruction. Lengths in metres."""

from steelnb.settings.base import Finite, Positive, Settings


class StructureSettings(Settings):
    """The final reconstruction (`steelnb.fusion.reconstruct`).

    Points below ``floor_m`` or farther from the sensor than ``range_max_m`` are ignored. ``adjust``: adjust poses and
    bars together first, for poses that were corrected and not smoothed.
    """

    floor_m: Finite = 0.2
    range_max_m: Positive = 6.0
    adjust: bool = False
