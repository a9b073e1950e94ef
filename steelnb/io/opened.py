"""What a reader of recordings gives: the parts of a `Flight`, whose scans are still in their files."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
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


def joined_parts(parts: list[Callable[[], Array]]) -> Array:
    """The points of all parts of a scan that can be read. Raises `InputError` if there are none."""
    if len(parts) == 1:
        return parts[0]()
    found, faults = list[Array](), list[InputError]()
    for part in parts:
        try:
            found.append(part().reshape(-1, 3))
        except InputError as fault:
            faults.append(fault)
    if not found:
        raise faults[0]
    return np.concatenate(found)
