"""One pass over the small messages of a bag and the headers of its scans."""

import itertools
from array import array
from collections import Counter, defaultdict
from contextlib import suppress
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io import messages as ros
from steelnb.io.clocks import OF_BAG, ONE_CLOCK, Clock, ahead_of, far_stamps, rising_stamps
from steelnb.io.containers import Container
from steelnb.io.layouts import cloud_layout, depth_layout
from steelnb.io.path_messages import PathMessages
from steelnb.io.pose_rows import are_valid, jump_m
from steelnb.io.scanning import Raw
from steelnb.io.trajectories import trajectory_of
from steelnb.io.transforms import STILL, Link, Tree, frame_name

STEP_SHARE_MIN = 0.05
"""Minimum interval of stamps, as a share of that of the times of recording; a simulation may be slow."""
JUMP_M = 0.05
"""Poses that jump to and fro by more are noted."""
SWAPPED_SHARE, SWAPPED_BY = 0.05, 2
"""Messages are sorted by stamp if more than this share of the stamps go back, as when two threads send them, and none
by more than so many places. A clock that is set back goes back once."""


Pair = tuple[str, str]
"""Frame and child frame of a message."""


class Headers:
    """Stamps and frames of the scans, and the values of small messages, by a ``clock``.

    ``frames_of``: frame and child frame of the messages of each topic; ``scan_frames``: frame of each scan;
    ``repeated``: numbers of those with the stamp, frame and data of one before; ``shape``: rows and columns of the
    first; ``cameras`` of topics, each with the stamp from which it holds and its frame; ``paths``: Path messages;
    ``notes`` on what contradicted itself; ``faults``: of each topic the first message that cannot be decoded;
    ``skipped``: counts of what is left out; ``unstamped``: frames on moving transforms without stamps, and a text on
    each.
    """

    def __init__(self, bag: Container, clock: Clock) -> None:
        self._bag, self._clock = bag, clock
        self._table: dict[Any, array[float]] = defaultdict(lambda: array("d"))
        self.frames_of: dict[str, Counter[Pair]] = defaultdict(Counter)
        self.scan_frames: list[str] = []
        self.repeated: set[int] = set()
        self._of_stamp: list[Any] = []
        self._span: dict[tuple[str, Pair], list[int]] = {}
        self._clock_of: dict[Any, Array] = {}
        self.shape: tuple[int, int] | None = None
        self.cameras: dict[str, list[tuple[float, str, ros.CameraInfo]]] = defaultdict(list)
        self.notes: dict[str, None] = {}
        self.paths = PathMessages(bag.decode, self.note)
        self.faults: dict[str, InputError] = {}
        self.skipped = Counter[str]()
        self.unstamped: dict[str, str] = {}

    def read(self, scans: str, *others: str) -> None:
        """Store the values of small messages, and stamps and frames of the scans. Raises `InputError`."""
        for raw in self._bag.messages(scans, *others):
            if raw.kind == ros.PATH:  # decoding each message of a path that grows takes the square of its length
                self.paths.add(raw)
                continue
            try:
                self._store(raw, self._bag.decode(raw), raw.topic == scans)
            except InputError as fault:
                self.faults.setdefault(raw.topic, fault)
                self.skipped[f"{raw.kind.rpartition('/')[2]} message that cannot be decoded"] += 1
                if raw.topic == scans:  # it keeps its number
                    self._table[scans].extend((np.nan, raw.log_ns / 1e9))
                    self.scan_frames.append("")
        if np.isnan(self._table[scans][::2]).all():
            raise self.fault_of(scans)

    def note(self, *texts: str) -> None:
        """Add to the ``notes``, each once."""
        self.notes |= dict.fromkeys(texts)

    def fault_of(self, topic: str) -> InputError:
        """Why no message of a topic can be read."""
        why = f" ({'; '.join(self._bag.notes)})" if self._bag.notes else ""
        return self.faults.get(topic) or InputError(f"no message of {topic} can be read{why}")

    def _store(self, raw: Raw, message: Any, is_scan: bool) -> None:
        if raw.kind in ros.TF:
            for each in message.transforms:
                names = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
                key = Link(*names, raw.topic.endswith("tf_static"))
                self._table[key].extend((*self.times(raw, each), *ros.pose_numbers(each, ros.TRANSFORM)))
            return
        pair = frame_name(message.header.frame_id), frame_name(getattr(message, "child_frame_id", ""))
        self.frames_of[raw.topic][pair] += 1
        self._span.setdefault((raw.topic, pair), [raw.log_ns, raw.log_ns])[1] = raw.log_ns
        if raw.kind == ros.CAMERA:
            camera = ros.camera_of(message)
            latest = next((each for _, frame, each in reversed(self.cameras[raw.topic]) if frame == pair[0]), None)
            if latest is None or not camera.equals(latest):
                self.cameras[raw.topic].append((self.times(raw, message)[0], pair[0], camera))
            return
        table = self._table[raw.topic if is_scan else (raw.topic, pair)]
        table.extend(self.times(raw, message))
        if is_scan:
            self._look_at(message, raw.kind)
            self.scan_frames.append(pair[0])
        elif raw.kind == ros.IMU:
            table.extend(ros.numbers(message.linear_acceleration, message.angular_velocity))
        else:
            table.extend(ros.pose_numbers(message, raw.kind))

    def times(self, raw: Raw, message: Any) -> tuple[float, float]:
        """The stamp that counts and the time of recording, seconds."""
        log_s = raw.log_ns / 1e9
        return log_s if self._clock.by_log else ros.stamp_of(message), log_s

    def _look_at(self, message: Any, kind: str) -> None:
        """Find out whether a scan repeats one of the latest, and note what contradicts its message; a fault is raised
        when the scan is read."""
        head, before = message.header, [each for each in self._of_stamp if each.header.stamp == message.header.stamp]
        same = [each for each in before if each.header.frame_id == head.frame_id]
        if any(np.array_equal(each.data, message.data) for each in same):
            self.repeated.add(len(self.scan_frames))
        self._of_stamp = [*before[-3:], message]
        with suppress(InputError):
            layout = cloud_layout(message) if kind == ros.CLOUD else depth_layout(message)
            self.shape = self.shape or layout.shape
            self.note(*layout.notes)

    def objects(self, topic: str) -> dict[Pair, list[Pair]]:
        """Frame and child frame of each object on a topic, the one with most messages first, with all pairs of its
        messages. Empty names may be those of any. Names that follow one another in time are of one object."""
        found = [pair for pair, _ in self.frames_of[topic].most_common()]
        partly = [pair for pair in found if not all(pair)]
        named = [pair for pair in found if all(pair) or not any(_is_less(pair, each) for each in found)]
        spans = sorted(self._span[topic, pair] for pair in named)
        if len(named) > 1 and all(one[1] <= other[0] for one, other in itertools.pairwise(spans)):
            names = " → ".join(filter(None, named[0]))
            self.note(f"{topic} names several frames, one after the other; all are taken for {names}")
            return {named[0]: found}
        return {pair: [pair, *(each for each in partly if _is_less(each, pair))] for pair in named}

    def of_object(self, topic: str, pair: Pair, values: int, what: str) -> Array:
        """Rows of stamp and values of the messages of a topic that are about one of its `objects`."""
        rows = self.rows_of(topic, pair, values)
        self._clock_of[topic] = rows[:, :2]
        return self._right(rows, what)

    def rows_of(self, topic: str, pair: Pair, values: int) -> Array:
        """Rows of stamp, time of recording and values of all messages about one of the `objects` of a topic."""
        same = self.objects(topic)[pair]
        rows = np.concatenate([np.array(self._table[topic, each]).reshape(-1, values + 2) for each in same])
        return rows[np.argsort(rows[:, 1], kind="stable")] if len(same) > 1 else rows

    def note_jumps(self, rows: Array, what: str) -> None:
        """Note if poses, ``rows (N, 8)``, jump to and fro from row to row."""
        if (apart_m := jump_m(rows)) > JUMP_M:
            self.note(f"{what} jumps {apart_m:.2g} m to and fro: two programs may send it")

    def _right(self, rows: Array, what: str) -> Array:
        """Rows of stamp and values, of rows of stamp, time of recording and values, where stamps are right."""
        far = far_stamps(rows[:, 0], rows[:, 1])
        self.skipped[f"{what} whose stamp is far from the time of recording"] += int(far.sum())
        rows = rows[~far]
        order, back = np.argsort(rows[:, 0], kind="stable"), int((np.diff(rows[:, 0]) < 0).sum())
        is_swapped = back > SWAPPED_SHARE * len(rows) and np.abs(order - np.arange(len(order))).max() <= SWAPPED_BY
        if is_swapped and not jump_m(rows[order][:, 1:]):  # of two programs one is kept
            self.skipped[f"{what} out of order, sorted by its stamp"] += back
            rows = rows[order]
        rising = rising_stamps(rows[:, 0], strictly=False)
        self.skipped[f"{what} whose stamp does not rise"] += len(rows) - len(rising)
        return np.delete(rows[rising], 1, axis=1)

    def scan_stamps(self, topic: str) -> tuple[Array, Array]:
        """Stamps of all scans, NaN where they are wrong, and times of recording."""
        rows = np.array(self._table[topic]).reshape(-1, 2)
        known = np.flatnonzero(~np.isnan(rows[:, 0]))
        others = [np.array(self._table[key]).reshape(-1, 9)[:, :2] for key in self._table if self._is_of_poses(key)]
        far = known[far_stamps(rows[known, 0], rows[known, 1], others)]
        if len(far):
            first = "{:.3f} s, recorded at {:.3f} s".format(*rows[far[0]])
            self.skipped[f"scan whose stamp is far from the time of recording (the first: {first})"] = len(far)
        rows[far, 0] = np.nan
        self._clock_of[topic] = rows
        right = rows[~np.isnan(rows[:, 0])]
        step_s, log_step_s = np.abs(np.median(np.diff(right, axis=0), axis=0)) if len(right) > 1 else (1.0, 1.0)
        if 0 < step_s < STEP_SHARE_MIN * log_step_s:
            recorded = f"which were recorded every {log_step_s:.2g} s"
            self.note(f"stamps of scans are {step_s:.2g} s apart, {recorded} (--clock bag)")
        return rows[:, 0] + self._clock.offset_s, rows[:, 1]

    def _is_of_poses(self, key: Any) -> bool:
        """Whether a part of the table is of poses or of a transform of tf."""
        if isinstance(key, Link):
            return not key.is_static
        return isinstance(key, tuple) and self._bag.types[key[0]] != ros.IMU

    def check_clocks(self, scans: str, others: Any, what: str = "poses") -> None:
        """Note or, if it is much, raise `InputError` if the stamps of the scans are ahead of those of ``others``, a
        topic or the names of a transform, or behind them, compared with the times at which both were recorded."""
        ahead_s, is_sure = ahead_of(self._clock_of[scans], self._clock_of.get(others, np.zeros((0, 2))))
        if not ahead_s or self._clock.offset_s:
            return
        how = f"{abs(ahead_s):.1f} s {'ahead of' if ahead_s > 0 else 'behind'} the {what} by the times of recording"
        shift, is_pose = f"{-ahead_s:.1f}", what == "poses"
        if is_sure:
            remedy = ONE_CLOCK.format(shift, OF_BAG) if is_pose else f"expected one clock{OF_BAG}, or --mount"
            raise InputError(f"scans are {how}; {remedy}")
        remedy = f" (--time-offset {shift})" if is_pose else ""
        self.note(f"scans are {how}: they are late, or the clocks differ{remedy}")

    def tree(self) -> Tree:
        """Transforms of tf_static and tf."""
        tree = Tree()
        for key in [key for key in self._table if isinstance(key, Link)]:
            parent, child, is_static = key
            rows = np.array(self._table[key]).reshape(-1, 9)
            if not is_static:
                self._clock_of[parent, child] = rows[:, :2]
            rows = self._right(rows, "transform")
            self.note_jumps(rows, f"{parent} → {child}")
            if not is_static and len(rows) > 1 and not np.ptp(rows[:, 0]) and np.ptp(rows[:, 1:], axis=0).max() > STILL:
                self.unstamped[child] = f"transforms {parent} → {child} move, but all have the stamp {rows[0, 0]:g} s"
                continue
            if is_static:  # its stamp does not matter, and the last one that is valid holds
                rows = np.array(self._table[key]).reshape(-1, 9)[:, [0, *range(2, 9)]]
                rows = rows[are_valid(rows)] if are_valid(rows).any() else rows
                if np.ptp(rows[:, 1:], axis=0).max() > STILL:
                    self.note(f"the fixed transform {parent} → {child} changes; the last one is used for all scans")
            if is_static or not np.ptp(rows[:, 0]):  # repeated
                rows = rows[-1:]
            try:
                found = trajectory_of(f"transform {parent} → {child} is left out", rows, self.skipped)
                tree.add(parent, child, found, is_static)
            except InputError as fault:
                self.note(str(fault))
        return tree


def _is_less(pair: Pair, other: Pair) -> bool:
    """Whether a pair of names is another one with empty names in it."""
    return pair != other and all(a in ("", b) for a, b in zip(pair, other, strict=True))
