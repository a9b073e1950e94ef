"""The report's incremental reconstruction: the bars of a map that grew scan by scan, tied at joints."""

import numpy as np

from steelnb.fusion.joints import find_joints
from steelnb.fusion.segment_map import SegmentMap
from steelnb.fusion.structure import Structure

SIGHTINGS_MIN = 5
"""A bar counts from the fifth sighting on: a second of flight. Chosen on seed 11."""
FORGET_FRAMES = 50
"""Bars with fewer sightings are dropped after ten seconds without one."""


def structure_of(bars: SegmentMap) -> Structure:
    """The report's incremental reconstruction: the bars of a map with at least `SIGHTINGS_MIN` sightings, tied at
    joints where they come close to each other (`fusion.joints.find_joints`).

    World frame, metres. The axis of a bar runs in the middle of its points, so on the near side of its section; its
    width is not known (NaN). ``sigma_m``: the spread of the points over the root of the sightings, since the points of
    one sighting err together. An empty structure says why it is empty.
    """
    seen = bars.sightings >= SIGHTINGS_MIN
    segments, sightings = bars.segments.take(seen), bars.sightings[seen]
    if not len(segments):
        return Structure.empty(f"none of {len(bars)} bars was seen {SIGHTINGS_MIN} times")
    joint, tie, led = find_joints(segments, 2 * segments.radius)
    return Structure(led, np.full(len(led), np.nan), sightings, segments.radius / np.sqrt(sightings), joint, tie)
