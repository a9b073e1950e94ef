"""The incremental reconstruction, frame by frame as in the report: the map of segments → `Structure`, at any time."""

from collections.abc import Sequence

import numpy as np

from steelnb.config import StructureSettings
from steelnb.datatypes import Segments
from steelnb.fusion.joints import find_joints
from steelnb.fusion.segment_map import SegmentMap
from steelnb.fusion.structure import Structure

SIGHTINGS_MIN = 5
"""A bar counts from the fifth sighting on: a second of flight. Chosen on seed 11."""
FORGET_FRAMES = 50
"""Bars seen less often are dropped after ten seconds without a sighting."""


def insert_batch(bars: SegmentMap, frames: Sequence[Segments]) -> None:
    """Add the segments of several frames, world frame, to a map at once; their order does not matter, to the last bit.

    What the map knew before decides where each segment belongs; those that start a bar are merged with each other
    afterwards. Sums of floating-point numbers depend on the order of their terms, so segments are sorted first.
    """
    frames = [frame for frame in frames if len(frame)]
    if frames:
        new = Segments.joined(frames)
        keys = np.column_stack([new.start, new.end, new.count, new.radius])
        bars.insert(new.take(np.lexsort(keys.T)))


def structure_of(
    bars: SegmentMap, sightings_min: int = SIGHTINGS_MIN, settings: StructureSettings | None = None
) -> Structure:
    """Bars that a map has seen at least ``sightings_min`` times, tied at joints where they come close to each other.

    The axis of a bar runs in the middle of the points seen, so on the near side of its section; its width is not known
    (NaN). ``sigma_m`` is the spread of the points over the root of the sightings, for the points of one sighting err
    together. Joints, and which ends are led to them, are those of `fusion.joints.find_joints`, from ``settings``.
    """
    s = settings or StructureSettings()
    seen = bars.sightings >= sightings_min
    segments, sightings = bars.segments.take(seen), bars.sightings[seen]
    if not len(segments):
        return Structure.empty(f"none of {len(bars)} bars was seen {sightings_min} times")
    joint, tie, led = find_joints(segments, 2 * segments.radius, s.slack_m, s.reach_m, s.same_m, s.bend_m)
    unknown = np.full(len(led), np.nan)
    return Structure(led, unknown, sightings, segments.radius / np.sqrt(sightings), joint, tie)
