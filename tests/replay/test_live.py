"""The rules of playing at sensor speed, by a clock that only moves when somebody works."""

import itertools
import threading
import time
from contextlib import nullcontext

import numpy as np
import pytest

from steelnb.datatypes import Scan
from steelnb.replay.live import Arrival, LoneClock, Reader, Ready, WallClock, highest_rate, play


class MadeClock:
    """Time that passes by sleeping and by `work`."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def now(self) -> float:
        return self.now_s

    def sleep_until(self, moment_s: float) -> None:
        self.now_s = max(self.now_s, moment_s)

    def working(self):
        return nullcontext()

    def work(self, seconds: float) -> None:
        self.now_s += seconds


class Read:
    """Scans that are read at given times after the beginning."""

    def __init__(self, clock: MadeClock, ready_s: list[float]) -> None:
        self.left = [Arrival(k, scan(k), clock.now() + ready) for k, ready in enumerate(ready_s)]

    def begin(self, due_s) -> None:
        self.due_s = due_s

    def take(self):
        return self.left.pop(0) if self.left else None

    def peek(self):
        return self.left[0] if self.left else None


def scan(k: int) -> Scan:
    return Scan(float(k), np.full((1, 3), float(k)))


def scans(count: int) -> list[Scan]:
    return [scan(k) for k in range(count)]


def played(work_s, count=10, rate=1.0, ready_s=None, stamp_s=None):
    """Play ``count`` scans a second apart, the work on scan k taking ``work_s(k)``."""
    clock, done = MadeClock(), []
    arrivals = Ready(scans(count)) if ready_s is None else Read(clock, ready_s)

    def update(k, given):
        assert given.points[0, 0] == k
        clock.work(work_s(k))
        done.append((k, clock.now() - 100.0))

    stamps = np.arange(float(count)) if stamp_s is None else stamp_s
    return play(arrivals, stamps, rate, update, clock), done


def test_in_time_nothing_is_late_and_nothing_dropped():
    found, done = played(lambda k: 0.9)
    assert (found.dropped, found.missed, found.late.any()) == (0, 0.0, False)
    np.testing.assert_allclose(found.latency_s, 0.9)
    assert done == [(k, pytest.approx(k + 0.9)) for k in range(10)]


def test_a_little_too_slow_is_late_first_and_drops_then():
    found, _ = played(lambda k: 1.25)
    # scan k ends at 1.25 (k + 1), until scan 3 ends when 5 is due, and 4 was waiting
    np.testing.assert_array_equal(found.index, [0, 1, 2, 3, 5, 6, 7, 8, 9])
    np.testing.assert_allclose(found.latency_s, [1.25, 1.5, 1.75, 2.0, 1.25, 1.5, 1.75, 2.0, 2.25])
    assert found.late.all()
    assert found.dropped == 1
    assert found.missed == 1.0


def test_the_newest_is_taken_and_the_others_are_dropped():
    found, _ = played(lambda k: 3.5 if k == 2 else 0.1)
    np.testing.assert_array_equal(found.index, [0, 1, 2, 5, 6, 7, 8, 9])  # 3 and 4 were replaced by 5, due at 5.0
    np.testing.assert_array_equal(found.late, [False, False, True, *[False] * 5])
    assert found.latency_s[3] == pytest.approx(0.6)  # it waited from 5.0 to 5.5
    assert (found.dropped, found.missed) == (2, pytest.approx(0.3))


def test_a_result_exactly_when_the_next_is_due_is_in_time():
    found, _ = played(lambda k: 1.0)
    assert (found.dropped, found.missed) == (0, 0.0)


def test_rate_shortens_the_time_there_is():
    assert played(lambda k: 0.4, rate=2.0)[0].missed == 0.0
    assert played(lambda k: 0.4, rate=2.6)[0].missed > 0.0
    _, done = played(lambda k: 0.1, rate=4.0)
    assert done[-1] == (9, pytest.approx(9 / 4 + 0.1))


def test_reading_late_is_reported_and_not_the_odometrys():
    ready = [k + (2.5 if k in (4, 5) else -1.0) for k in range(10)]
    found, _ = played(lambda k: 0.2, ready_s=ready)
    assert found.late.sum() == 0
    np.testing.assert_allclose(found.reading_s[np.isin(found.index, (4, 5))], 2.5)
    assert found.reading_s[found.index == 3] == 0.0


def test_uneven_stamps_have_deadlines_of_their_own():
    stamps = np.array([0.0, 1.0, 1.3, 2.3, 3.3])
    found, _ = played(lambda k: 0.5, count=5, stamp_s=stamps)
    np.testing.assert_array_equal(found.late, [False, True, False, False, False])
    assert found.dropped == 0


def test_scans_in_memory_can_be_played_again():
    held = Ready(scans(3))
    for _ in range(2):
        held.begin(np.zeros(3))
        assert [held.take().k for _ in range(3)] == [0, 1, 2]
        assert held.take() is None


def test_the_lone_clock_counts_the_processors_time_of_work_alone():
    clock = LoneClock()
    clock.sleep_until(5.0)
    assert clock.now() == 5.0
    time.sleep(0.02)  # the machine's time does not count, nor what is done between two scans
    sum(range(100_000))
    assert clock.now() == 5.0
    with clock.working():
        began_s = time.process_time()
        while time.process_time() - began_s < 0.02:
            pass
    assert clock.now() >= 5.02
    assert clock.now() - 5.0 <= time.process_time() - began_s + 0.02
    clock.sleep_until(1.0)
    assert clock.now() >= 5.02


def test_reader_hands_over_every_scan_in_order_while_none_is_due():
    with Reader(scans(20), WallClock()) as reader:
        reader.begin(np.full(20, np.inf))
        assert [reader.take().k for _ in range(20)] == list(range(20))
        assert reader.take() is None


def test_reader_drops_the_first_when_the_second_is_due():
    clock = MadeClock()
    with Reader(scans(20), clock, ahead=3) as reader:
        clock.work(1000.0)  # all of them are due
        reader.begin(np.arange(20.0))
        reader._thread.join(30)
        assert not reader._thread.is_alive()
        assert [reader.take().k for _ in range(3)] == [17, 18, 19]
        assert reader.take() is None


def test_reader_holds_no_more_than_it_may():
    given = []

    def counted():
        for k in range(50):
            given.append(k)
            yield scan(k)

    with Reader(counted(), MadeClock(), ahead=4) as reader:
        reader.begin(np.full(50, np.inf))
        assert reader.take().k == 0
    assert len(given) <= 7  # four wait, one is in hand, one was taken
    assert "reader" not in [thread.name for thread in threading.enumerate()]


def test_what_reading_raises_comes_out_after_what_was_read():
    def broken():
        yield scan(0)
        yield scan(1)
        raise OSError("gone")

    with Reader(broken(), WallClock()) as reader:
        reader.begin(np.full(9, np.inf))
        assert [reader.take().k for _ in range(2)] == [0, 1]
        with pytest.raises(OSError, match="gone"):
            reader.take()


def test_reader_and_play_together_leave_no_scan_unaccounted_for():
    stamps = np.arange(60) * 0.002
    with Reader(scans(60), WallClock()) as reader:
        found = play(reader, stamps, 1.0, lambda k, _: WallClock().sleep_until(WallClock().now() + 0.004), WallClock())
    assert found.total == 60
    assert (np.diff(found.index) > 0).all()
    assert found.index[-1] == 59  # the newest is never dropped
    assert len(found.index) == len(found.latency_s) == len(found.late) == len(found.reading_s)


@pytest.mark.parametrize("limit", [0.7, 1.0, 1.01, 3.3, 40.0, 1000.0])
@pytest.mark.parametrize("first", [0.25, 1.0, 8.0])
def test_the_highest_rate_is_found_by_doubling_and_halving(limit, first):
    asked = []

    def missed(rate):
        asked.append(rate)
        return 0.0 if rate <= limit else 0.5

    found = highest_rate(missed, first)
    assert limit / 1.05 <= found <= limit
    assert len(asked) < 25


def test_rates_that_are_never_or_always_good_end():
    assert highest_rate(lambda rate: 1.0) == 0.0
    assert highest_rate(lambda rate: 0.0, limit=100.0) == 64.0
    assert highest_rate(lambda rate: 0.01) == 0.0  # one in a hundred is not less than one in a hundred
    for start in itertools.islice((2.0**k for k in range(-5, 5)), 10):
        assert highest_rate(lambda rate: 0.0, start, limit=100.0) > 50.0
