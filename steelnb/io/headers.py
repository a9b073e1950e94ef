"""One pass over the small messages of a bag and the headers of its scans."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.io import messages as ros
from steelnb.io.clocks import far_stamps, rising_stamps
from steelnb.io.containers import Container
from steelnb.io.layouts import cloud_layout, depth_layout
from steelnb.io.scanning import Raw
from steelnb.io.trajectories import trajectory_of
from steelnb.io.transforms import STILL, Tree

SAME_PLACE_M = 0.05
"""Largest distance of poses of one stamp in messages of one path."""


class Headers:
    """Stamps and frames of the scans, and the values of small messages; ``by_log``: stamps are times of recording.

    ``frame_of``: frame and child frame of each topic; ``scan_frames``: frame of each scan; ``repeated``: numbers of
    those with the stamp, frame and data of one before; ``shape``: rows and columns of the first; ``cameras`` of topics,
    each with the stamp from which it holds; ``longest``: the longest Path, the last of its length; ``earlier_paths``:
    rows of stamp and pose of some before it that did not grow; ``notes`` on what contradicted itself; ``faults``: of
    each topic the first message that cannot be decoded; ``skipped``: counts of what is left out; ``unstamped``: frames
    on moving transforms without stamps, and a text on each.
    """

    def __init__(self, bag: Container, by_log: bool) -> None:
        self._bag, self._by_log = bag, by_log
        self._table: dict[Any, array[float]] = defaultdict(lambda: array("d"))
        self.frame_of: dict[str, tuple[str, str]] = {}
        self.scan_frames: list[str] = []
        self.repeated: set[int] = set()
        self._of_stamp: list[Any] = []
        self.shape: tuple[int, int] | None = None
        self.cameras: dict[str, list[tuple[float, ros.CameraInfo]]] = defaultdict(list)
        self.longest: Raw | None = None
        self.earlier_paths: list[Array] = []
        self._until_path = 0
        self.notes: dict[str, None] = {}
        self.faults: dict[str, InputError] = {}
        self.skipped = Counter[str]()
        self.unstamped: dict[str, str] = {}

    def read(self, scans: str, *others: str) -> None:
        """Store the values of small messages, and stamps and frames of the scans. Raises `InputError`."""
        for raw in self._bag.messages(scans, *others):
            if raw.kind == ros.PATH:  # decoding each message of a path that grows takes the square of its length
                self._look_at_path(raw)
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
            raise self.faults.get(scans) or InputError(
                f"{self._bag.path}: no message of {scans} can be read ({'; '.join(self._bag.notes)})"
            )

    def _store(self, raw: Raw, message: Any, is_scan: bool) -> None:
        if raw.kind in ros.TF:
            for each in message.transforms:
                key = frame_name(each.header.frame_id), frame_name(each.child_frame_id), raw.topic.endswith("tf_static")
                self._table[key].extend((*self.times(raw, each), *ros.pose_numbers(each, ros.TRANSFORM)))
            return
        frame = frame_name(message.header.frame_id)
        self.frame_of[raw.topic] = frame, frame_name(getattr(message, "child_frame_id", ""))
        if raw.kind == ros.CAMERA:
            camera, so_far = ros.camera_of(message), self.cameras[raw.topic]
            if not so_far or not camera.equals(so_far[-1][1]):
                so_far.append((self.times(raw, message)[0], camera))
            return
        self._table[raw.topic].extend(self.times(raw, message))
        if is_scan:
            self._compare(message)
            self.scan_frames.append(frame)
            self._look_at(message, raw.kind)
        elif raw.kind == ros.IMU:
            self._table[raw.topic].extend(ros.numbers(message.linear_acceleration, message.angular_velocity))
        else:
            self._table[raw.topic].extend(ros.pose_numbers(message, raw.kind))

    def times(self, raw: Raw, message: Any) -> tuple[float, float]:
        """The stamp that counts and the time of recording, seconds."""
        log_s = raw.log_ns / 1e9
        return log_s if self._by_log else ros.stamp_of(message), log_s

    def _look_at_path(self, raw: Raw) -> None:
        """Keep the longest Path. Those that do not grow have lost their first poses: of them, one is decoded for every
        eighth of its poses, since decoding all takes the square of their number."""
        self._until_path -= 1
        if self.longest is not None and len(raw.data) <= len(self.longest.data) and self._until_path <= 0:
            with suppress(InputError):
                for path in (raw,) if self.earlier_paths else (self.longest, raw):
                    poses = self._bag.decode(path).poses
                    self.earlier_paths.append(np.array([ros.stamped_pose(each) for each in poses]).reshape(-1, 8))
                    self._until_path = len(poses) // 8
        if self.longest is None or len(raw.data) >= len(self.longest.data):
            self.longest = raw

    def _compare(self, message: Any) -> None:
        """Find out whether a scan repeats one of the latest before it."""
        head, before = message.header, [each for each in self._of_stamp if each.header.stamp == message.header.stamp]
        same = [each for each in before if each.header.frame_id == head.frame_id]
        if any(np.array_equal(each.data, message.data) for each in same):
            self.repeated.add(len(self.scan_frames))
        self._of_stamp = [*before[-3:], message]

    def _look_at(self, message: Any, kind: str) -> None:
        """Note what contradicts a scan's message. A fault is that of the scan, when it is read."""
        try:
            layout = cloud_layout(message) if kind == ros.CLOUD else depth_layout(message)
        except InputError:
            return
        self.shape = self.shape or layout.shape
        self.notes |= dict.fromkeys(layout.notes)

    def rows(self, key: Any, values: int, what: str) -> Array:
        """Rows of stamp and values of messages whose stamps are right."""
        rows = np.array(self._table[key]).reshape(-1, values + 2)
        far = far_stamps(rows[:, 0], rows[:, 1])
        rising = rising_stamps(rows[~far, 0], strictly=False)
        self.skipped[f"{what} whose stamp is far from the time of recording"] += int(far.sum())
        self.skipped[f"{what} whose stamp does not rise"] += int((~far).sum()) - len(rising)
        return np.delete(rows[~far][rising], 1, axis=1)

    def scan_stamps(self, topic: str) -> tuple[Array, Array]:
        """Stamps of all scans, NaN where they are wrong, and times of recording."""
        rows = np.array(self._table[topic]).reshape(-1, 2)
        known = np.flatnonzero(~np.isnan(rows[:, 0]))
        far = known[far_stamps(*rows[known].T)]
        if len(far):
            first = "{:.3f} s, recorded at {:.3f} s".format(*rows[far[0]])
            self.skipped[f"scan whose stamp is far from the time of recording (the first: {first})"] = len(far)
        rows[far, 0] = np.nan
        return rows[:, 0], rows[:, 1]

    def tree(self) -> Tree:
        """Transforms of tf_static and tf."""
        tree = Tree()
        for key in [key for key in self._table if isinstance(key, tuple)]:
            parent, child, is_static = key
            rows = self.rows(key, 7, "transform")
            if not is_static and len(rows) > 1 and not np.ptp(rows[:, 0]) and np.ptp(rows[:, 1:], axis=0).max() > STILL:
                self.unstamped[child] = f"transforms {parent} → {child} move, but all have the stamp {rows[0, 0]:g} s"
                continue
            if is_static:  # its stamp does not matter, and the last one holds
                rows = np.array(self._table[key]).reshape(-1, 9)[:, [0, *range(2, 9)]]
                if np.ptp(rows[:, 1:], axis=0).max() > STILL:
                    self.notes[
                        f"the fixed transform {parent} → {child} changes; the last one is used for all scans"
                    ] = None
            if is_static or not np.ptp(rows[:, 0]):  # repeated
                rows = rows[-1:]
            try:
                tree.add(parent, child, trajectory_of(self._bag.path, rows, self.skipped), is_static)
            except InputError:
                self.notes[f"no transform {parent} → {child} is valid"] = None
        return tree


def frame_name(name: str) -> str:
    """Name of a frame; ROS 1 allowed a slash before it."""
    return name.lstrip("/")


def whole_path(earlier: Sequence[Array], last: Array) -> Array:
    """Rows ``(N, 8)`` of a path of which each message has only the latest poses, rising by stamp: ``last (M, 8)``, and
    what ``earlier`` ones had before, back to the first that shares no stamp with those after it or has other places."""
    for rows in reversed(earlier):
        _, ours, theirs = np.intersect1d(last[:, 0], rows[:, 0], return_indices=True)
        if not len(ours) or np.abs(last[ours, 1:4] - rows[theirs, 1:4]).max() > SAME_PLACE_M:
            break
        last = np.concatenate([last, rows[~np.isin(rows[:, 0], last[:, 0])]])
    return last[np.argsort(last[:, 0], kind="stable")] if len(earlier) else last
