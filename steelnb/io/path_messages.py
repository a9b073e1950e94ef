"""Poses of Path messages: some topics send a path that grows, and others the latest poses only."""

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io.messages import POSE_STAMPED, pose_numbers, stamp_of
from steelnb.io.scanning import Raw

SAME_PLACE_M = 0.05
"""Largest distance of poses of one stamp in messages of one path."""
LENGTH_MIN = 12 + 7 * 8
"""Bytes of the stamp and of the last pose of a Path."""


class PathMessages:
    """The ``longest`` Path of a topic, the last of its length, and rows of stamp and pose of some ``earlier`` ones that
    did not grow. ``note`` is told what is unusual."""

    def __init__(self, decode: Callable[[Raw], Any], note: Callable[[str], None]) -> None:
        self._decode, self._note = decode, note
        self._ends: list[Array] = []
        self.longest: Raw | None = None
        self.earlier: list[Array] = []
        self._until_next = 0

    def add(self, raw: Raw) -> None:
        """Keep the longest Path. Those that do not grow have lost their first poses: of them, one is decoded for every
        eighth of its poses, since decoding all takes the square of their number."""
        if len(raw.data) >= LENGTH_MIN:
            ends = bytes(raw.data[:12]) + bytes(raw.data[-56:])  # a stamp after four bytes; seven numbers
            order = ">" if raw.encoding == "cdr" and not ends[1] & 1 else "<"
            second, part, *pose = struct.unpack(f"{order}4x2I7d", ends)
            self._ends.append(np.array([(second * 10**9 + part) / 10**9, *pose]))
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
        places. Raises `InputError`, also if the poses have no stamps of their own and the path does not grow."""
        found = last = self._rows(raw)
        if len(found) > 1 and not np.ptp(found[:, 0]):
            return self._ended(raw.topic, found), len(self._ends)
        for rows in reversed(self.earlier):
            _, ours, theirs = np.intersect1d(found[:, 0], rows[:, 0], return_indices=True)
            if not len(ours) or np.abs(found[ours, 1:4] - rows[theirs, 1:4]).max() > SAME_PLACE_M:
                break
            found = np.concatenate([found, rows[~np.isin(rows[:, 0], found[:, 0])]])
        return found[np.argsort(found[:, 0], kind="stable")] if self.earlier else found, len(last)

    def _ended(self, topic: str, rows: Array) -> Array:
        """The last pose of each message with the stamp of the message, if all are among the ``rows`` of a path that
        grows, one after the other: that of a planned path is its goal."""
        number = {row[1:].tobytes(): k for k, row in enumerate(rows)}
        among = [number.get(end[1:].tobytes(), -1) for end in self._ends]
        if -1 in among or among != sorted(among) or len({*among}) < 2:
            what = f"{topic}: {len(rows)} poses with one stamp, {rows[0, 0]:.3f} s"
            raise InputError(f"{what}; expected that of each, or another topic of poses (--poses)")
        note = f"poses of {topic} have no stamps of their own; each has that of the message that ends with it"
        self._note(note)
        return np.array(self._ends)

    def _rows(self, raw: Raw) -> Array:
        poses = [(stamp_of(each), *pose_numbers(each, POSE_STAMPED)) for each in self._decode(raw).poses]
        return np.array(poses, dtype=float).reshape(-1, 8)
