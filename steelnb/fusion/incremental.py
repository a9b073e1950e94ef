"""The report's incremental reconstruction: the bars of a map so far, tied at joints."""

import numpy as np

from steelnb.fusion.joints import find_joints
from steelnb.fusion.segment_map import SegmentMap
from steelnb.fusion.structure import Structure

SIGHTINGS_MIN, FORGET_FRAMES = 5, 50
"""A bar counts from its fifth sighting on, after a second of flight. One with fewer is dropped after ten seconds out of
sight."""


def structure_of(bars: SegmentMap) -> Structure:
    """The bars of a map with at least `SIGHTINGS_MIN` sightings, tied at joints (`find_joints`). An empty structure
    states the reason.

    The axis of a bar runs through the middle of its points, so on the near side of its section; its width is NaN.
    ``sigma_m``: spread of the points over the root of the sightings, since errors within one sighting are correlated.
    """
    chosen = bars.sightings >= SIGHTINGS_MIN
    segments, sightings = bars.segments.take(chosen), bars.sightings[chosen]
    if not len(segments):
        return Structure.empty(f"none of {len(bars)} bars was seen {SIGHTINGS_MIN} times")
    joint, tie, led = find_joints(segments, 2 * segments.radius)
    return Structure(led, np.full(len(led), np.nan), sightings, segments.radius / np.sqrt(sightings), joint, tie)
