"""A flight at the speed of its sensor: scans arrive whether the odometry is ready or not, and only the newest waits.

What time it is comes from a `Clock`, so that the rules can be tried without waiting.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from types import TracebackType
from typing import NamedTuple, Protocol, Self

import numpy as np

from steelnb.datatypes import Array, IntArray, Scan
from steelnb.replay.offline import periods

AHEAD = 4
"""Scans that are read before they are due."""


class Clock(Protocol):
    """Seconds that pass."""

    def now(self) -> float:
        """The time, in seconds from anywhere."""

    def sleep_until(self, moment_s: float) -> None:
        """Come back at that time, or at once if it has passed."""

    def working(self) -> AbstractContextManager[None]:
        """What happens within is work on a scan."""


class WallClock:
    """The machine's."""

    def now(self) -> float:
        """Seconds of `time.perf_counter`."""
        return time.perf_counter()

    def sleep_until(self, moment_s: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, moment_s - time.perf_counter()))

    def working(self) -> AbstractContextManager[None]:
        """Nothing more: time passes by itself."""
        return nullcontext()


class LoneClock:
    """Time as it would pass if nothing else ran on this machine: by processor time of the work, and by sleeping.

    It does not wait, so a flight is played as fast as it goes.
    """

    def __init__(self) -> None:
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._now_s

    def sleep_until(self, moment_s: float) -> None:
        """Be there."""
        self._now_s = max(self._now_s, moment_s)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Let the processor time of the process pass."""
        began_s = time.process_time()
        yield
        self._now_s += time.process_time() - began_s


class Arrival(NamedTuple):
    """Scan number ``k``, read at ``ready_s``."""

    k: int
    scan: Scan
    ready_s: float


class Arrivals(Protocol):
    """The scans of a flight in their order, as they are read."""

    def begin(self, due_s: Array) -> None:
        """Say when each scan ``(K,)`` is due, by the clock."""

    def take(self) -> Arrival | None:
        """The next scan, when it is read; None after the last."""

    def peek(self) -> Arrival | None:
        """The next scan if it is read already."""


@dataclass(frozen=True)
class Played:
    """How a flight went at sensor speed.

    ``index (N,)``: the scans that were worked on; the other of ``total`` were dropped. ``latency_s (N,)``: from a
    scan's arrival to its result; ``late (N,)``: the result came after the next scan was due; ``reading_s (N,)``: how
    long after it was due a scan was read, which is not the odometry's time.
    """

    total: int
    index: IntArray
    latency_s: Array
    late: np.ndarray
    reading_s: Array

    @property
    def dropped(self) -> int:
        """Scans that a newer one replaced before the odometry was ready."""
        return self.total - len(self.index)

    @property
    def missed(self) -> float:
        """Share 0–1 of all scans whose result came late or never."""
        return (int(self.late.sum()) + self.dropped) / self.total


def play(
    arrivals: Arrivals, stamp_s: Array, rate: float, update: Callable[[int, Scan], object], clock: Clock
) -> Played:
    """Send scans through ``update`` as they arrive: ``rate`` times as fast as their stamps ``(K,)`` say.

    A scan arrives when it is due or, if that is later, when it is read. While the odometry works, one scan waits, and a
    newer one takes its place.
    """
    period_s = periods(stamp_s) / rate
    start_s = clock.now()
    due_s = start_s + (stamp_s - stamp_s[0]) / rate
    arrivals.begin(due_s)
    index, latency_s, late, reading_s = [], [], [], []

    def arrived_s(arrival: Arrival) -> float:
        return max(float(due_s[arrival.k]), arrival.ready_s)

    while (arrival := arrivals.take()) is not None:
        clock.sleep_until(arrived_s(arrival))
        while (newer := arrivals.peek()) is not None and arrived_s(newer) <= clock.now():
            arrival = arrivals.take() or newer
        with clock.working():
            update(arrival.k, arrival.scan)
        index.append(arrival.k)
        latency_s.append(clock.now() - arrived_s(arrival))
        late.append(latency_s[-1] > period_s[arrival.k])
        reading_s.append(max(0.0, arrival.ready_s - float(due_s[arrival.k])))
    return Played(
        len(stamp_s), np.array(index, dtype=np.int64), np.array(latency_s), np.array(late, dtype=bool),
        np.array(reading_s),
    )  # fmt: skip


class Ready:
    """Scans that are always there in time, from memory or read when they are asked for, while the clock stands."""

    def __init__(self, scans: Iterable[Scan]) -> None:
        self._scans = scans
        self._left: Iterator[tuple[int, Scan]] = iter(())
        self._next: Arrival | None = None

    def begin(self, due_s: Array) -> None:
        """From the first scan on."""
        self._left = enumerate(self._scans)
        self._read()

    def take(self) -> Arrival | None:
        """The next scan."""
        found = self._next
        self._read()
        return found

    def peek(self) -> Arrival | None:
        """The next scan."""
        return self._next

    def _read(self) -> None:
        found = next(self._left, None)
        self._next = None if found is None else Arrival(*found, ready_s=-np.inf)


class Reader:
    """A thread that reads scans ahead of time; used as a context manager.

    It holds `AHEAD` scans. When it has more, and the second of them is due, the first is dropped: the odometry is busy
    with one before it. What reading raises, `take` raises.
    """

    def __init__(self, scans: Iterable[Scan], clock: Clock, ahead: int = AHEAD) -> None:
        self._scans, self._clock, self._ahead = scans, clock, ahead
        self._queue: deque[Arrival] = deque()
        self._changed = threading.Condition()
        self._due_s: Array | None = None
        self._fault: BaseException | None = None
        self._ended = self._stopped = False
        self._thread = threading.Thread(target=self._read, name="reader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        with self._changed:  # a sensor that is already running
            self._changed.wait_for(lambda: self._ended or len(self._queue) >= self._ahead)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join()

    def begin(self, due_s: Array) -> None:
        """Say when each scan is due; until then none is dropped."""
        with self._changed:
            self._due_s = due_s
            self._changed.notify_all()

    def take(self) -> Arrival | None:
        """The next scan that was not dropped; waits for it."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ended)
            if self._queue:
                self._changed.notify_all()
                return self._queue.popleft()
            if self._fault is not None:
                raise self._fault
            return None

    def peek(self) -> Arrival | None:
        """The next scan if it is read already."""
        with self._changed:
            return self._queue[0] if self._queue else None

    def _read(self) -> None:
        try:
            for index, scan in enumerate(self._scans):
                arrival = Arrival(index, scan, self._clock.now())
                with self._changed:
                    while len(self._queue) >= self._ahead and not self._stopped:
                        wait_s = self._second_due_s() - self._clock.now()
                        if wait_s <= 0:
                            self._queue.popleft()
                        else:
                            self._changed.wait(min(wait_s, 1.0))
                    if self._stopped:
                        return
                    self._queue.append(arrival)
                    self._changed.notify_all()
        except BaseException as fault:  # handed over to the thread that takes
            self._fault = fault
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _second_due_s(self) -> float:
        if self._due_s is None or len(self._queue) < 2:
            return np.inf
        return float(self._due_s[self._queue[1].k])


def highest_rate(
    missed: Callable[[float], float], first: float = 1.0, share_max: float = 0.01, precision: float = 0.05,
    limit: float = 4096.0,
) -> float:  # fmt: skip
    """The highest rate at which the share ``missed(rate)`` is below ``share_max``, to a relative ``precision``.

    Rates double from ``first`` until one is too high, and are then halved between; where ``first`` is too high itself,
    they halve until one is not. 0 where none below a thousandth of it is low enough.
    """
    good, bad = 0.0, first
    while bad <= limit and missed(bad) < share_max:
        good, bad = bad, 2 * bad
    if good > limit / 2:
        return good
    while not good:
        bad /= 2
        if bad < first / 1024:
            return 0.0
        if missed(bad) < share_max:
            good, bad = bad, 2 * bad
    while bad / good > 1 + precision:
        middle = (good * bad) ** 0.5
        if missed(middle) < share_max:
            good = middle
        else:
            bad = middle
    return good
