"""Poses of Path messages: some topics send a path that grows, and others the latest poses only."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io.messages import stamped_pose
from steelnb.io.scanning import Raw

SAME_PLACE_M = 0.05
"""Largest distance of poses of one stamp in messages of one path."""


class PathMessages:
    """The ``longest`` Path of a topic, the last of its length, and rows of stamp and pose of some ``earlier`` ones that
    did not grow."""

    def __init__(self, decode: Callable[[Raw], Any]) -> None:
        self._decode = decode
        self.longest: Raw | None = None
        self.earlier: list[Array] = []
        self._until_next = 0

    def add(self, raw: Raw) -> None:
        """Keep the longest Path. Those that do not grow have lost their first poses: of them, one is decoded for every
        eighth of its poses, since decoding all takes the square of their number."""
        self._until_next -= 1
        if self.longest is not None and len(raw.data) <= len(self.longest.data) and self._until_next <= 0:
            with suppress(InputError):
                for path in (raw,) if self.earlier else (self.longest, raw):
                    rows = self._rows(path)
                    self.earlier.append(rows)
                    self._until_next = len(rows) // 8
        if self.longest is None or len(raw.data) >= len(self.longest.data):
            self.longest = raw

    def poses(self, raw: Raw) -> tuple[Array, int]:
        """Rows ``(N, 8)`` of the path that ends with this message, rising by stamp, and how many are its own: of the
        ``earlier`` ones what they had before, back to the first that shares no stamp with those after it or has other
        places. Raises `InputError`."""
        found = last = self._rows(raw)
        for rows in reversed(self.earlier):
            _, ours, theirs = np.intersect1d(found[:, 0], rows[:, 0], return_indices=True)
            if not len(ours) or np.abs(found[ours, 1:4] - rows[theirs, 1:4]).max() > SAME_PLACE_M:
                break
            found = np.concatenate([found, rows[~np.isin(rows[:, 0], found[:, 0])]])
        return found[np.argsort(found[:, 0], kind="stable")] if self.earlier else found, len(last)

    def _rows(self, raw: Raw) -> Array:
        return np.array([stamped_pose(each) for each in self._decode(raw).poses], dtype=float).reshape(-1, 8)
