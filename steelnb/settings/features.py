"""Settings of odometry by features of images. Lengths in metres."""

from typing import Annotated

from pydantic import Field

from steelnb.settings.base import Positive, Settings


class OrbSettings(Settings):
    """Visual odometry by ORB features (`steelnb.odometry.orb`).

    At most ``features`` are found in an image. A landmark is sought within ``search_px`` of where the prediction sees
    it, among descriptors that differ in at most ``hamming_max`` of their 256 bits, the best in at most ``ratio`` of the
    bits of the second best. ``pixel_sigma`` is the standard deviation of a feature's place on the finest scale, pixels;
    ``robust_scale`` that of the Geman-McClure weights, in standard deviations. A scan with fewer than ``matches_min``
    corrects nothing. New landmarks are taken every ``keyframe_m`` of the path, or half a radian a metre of it; of more
    than ``landmarks_max`` those seen longest ago are dropped.
    """

    features: Annotated[int, Field(ge=10, le=10_000)] = 800
    search_px: Positive = 8.0
    hamming_max: Annotated[int, Field(ge=0, le=256)] = 60
    ratio: Annotated[float, Field(gt=0, le=1)] = 0.85
    pixel_sigma: Positive = 1.0
    robust_scale: Positive = 2.0
    matches_min: Annotated[int, Field(ge=4)] = 8
    keyframe_m: Positive = 0.1
    landmarks_max: Annotated[int, Field(ge=100)] = 10_000
