"""Settings of odometry by features of images."""

from typing import Literal

from steelnb.settings.base import Settings


class OrbSettings(Settings):
    """Visual odometry by ORB features (`steelnb.odometry.orb`, which holds what need not be set).

    ``depth``: the depths of landmarks are the Time-of-Flight ``sensor``'s, or ``triangulated`` from two images
    (`steelnb.odometry.monocular`), whose scale is then that of the drifting prior.
    """

    depth: Literal["sensor", "triangulated"] = "sensor"
