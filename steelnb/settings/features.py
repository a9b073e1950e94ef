"""Settings of odometry by features of images. Lengths in metres."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import Positive, Settings


class OrbSettings(Settings):
    """Visual odometry by ORB features (`steelnb.odometry.orb`, which holds what need not be set).

    At most ``features`` are found in an image. New landmarks are taken every ``keyframe_m`` of the path, or half a
    radian a metre of it.
    """

    features: Annotated[int, Field(ge=10, le=10_000)] = 800
    keyframe_m: Positive = 0.1
