"""What a reader of recordings gives: the parts of a `Flight`, whose scans are still in their files."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

from steelnb.core.types import Array, Imu, IntArray, Trajectory

Walk = Callable[[IntArray], Iterator[Callable[[], Array]]]
"""Iterator over the decoders of the scans with these increasing numbers."""


class Opened(NamedTuple):
    """``stamp_s (N,)`` of all scans, NaN for those that are not used; ``walk`` over their decoders; poses of the drone;
    ``T_drone_sensor (4, 4)``; the facts for `Flight`; readings of an IMU; and counts of what was skipped."""

    stamp_s: Array
    walk: Walk
    prior: Trajectory
    T_drone_sensor: Array
    facts: dict[str, str]
    imu: Imu | None
    skipped: Counter[str]
