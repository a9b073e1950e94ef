"""Settings of odometry by features of images."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import Settings


class OrbSettings(Settings):
    """Visual odometry by ORB features (`steelnb.odometry.orb`, which holds what need not be set).

    At most ``features`` are found in an image.
    """

    features: Annotated[int, Field(ge=10, le=10_000)] = 800
