"""Segmentations that several odometries on one flight share."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import numpy as np

from steelnb.core.types import Array
from steelnb.settings import HoughSettings

T = TypeVar("T")
_shared: ContextVar[dict[object, Any] | None] = ContextVar("shared", default=None)


@contextmanager
def shared_segments() -> Iterator[None]:
    """Within this context, equal points are segmented only once for all odometries with equal settings: several methods
    on one flight often have the same points. Each odometry reports the time of the first segmentation."""
    token = _shared.set({})
    try:
        yield
    finally:
        _shared.reset(token)


def timed(segment: Callable[[Array, HoughSettings], T], points: Array, settings: HoughSettings) -> tuple[T, float]:
    """What a function finds in points ``(N, 3)``, and its seconds; within `shared_segments`, those of its first call
    with these arguments."""
    begin, shared = time.perf_counter(), _shared.get()
    if shared is None:  # a single run needs no hash of its points
        return segment(points, settings), time.perf_counter() - begin
    key = segment, hashlib.sha256(np.ascontiguousarray(points).data).digest(), settings
    if key not in shared:
        begin = time.perf_counter()
        shared[key] = segment(points, settings), time.perf_counter() - begin
    found: tuple[T, float] = shared[key]
    return found
