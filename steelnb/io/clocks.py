"""Stamps that a clock got wrong: found before anything is ordered by them."""

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from steelnb.core.types import Array, IntArray

FAR_S, FAR_MADS = 5.0, 10.0
"""A stamp is wrong if it differs from the time of recording by this much more, or less, than usual: seconds, and median
absolute deviations, which allow for a simulated clock of another speed."""

ONE_CLOCK = "expected one clock (--time-offset {} shifts scans{})"
OF_BAG = ", --clock bag takes the times of recording"
"""What to do about clocks that differ, with the seconds of a shift, and with the second text where there is a bag."""
STEADY_S, CLOCKS_APART_S, LATE_S, SPREAD_SHARE = 1.0, 10.0, 1.0, 0.1
"""Two clocks are compared if the stamps of each keep their distance from the times of recording within the first, in
the median. They differ if these distances differ by more than the second, which exceeds any latency. They may differ if
it is more than the third, and much more than the distances vary."""
RIGHT_SHARE = 0.1
"""Minimum share of stamps with the clock of the poses, if most were taken before that clock was set."""
SWAPPED_BY = 4
"""Maximum number of places by which scans may be out of order."""
EVENER = 0.5
"""Digits without zeros before them are decimals of a second if they make the steps more even, by this factor."""
FRACTIONS = {3: "ms", 6: "µs", 9: "ns"}
PARTS_SHARE = 0.3
"""Parts of a scan are recorded within this share of the time to the next scan."""


class Clock(NamedTuple):
    """Which stamps count: those in the messages or, ``by_log``, the times of recording; ``offset_s`` is added to those
    of scans."""

    by_log: bool = False
    offset_s: float = 0.0


def far_stamps(stamp_s: Array, log_s: Array, others: Sequence[Array] = ()) -> NDArray[np.bool_]:
    """Which stamps ``(N,)`` are far from the times of recording ``log_s (N,)``, compared with most of them.

    Stamps that go on from right ones without a jump are right: then the recording paused. ``others``: both times
    ``(M, 2)`` of poses, whose clock counts if most of these stamps have another one, steadily, but not all.
    """
    if not len(stamp_s):
        return np.zeros(0, bool)
    late_s = stamp_s - log_s
    off_s = np.abs(late_s - np.median(late_s))
    far: NDArray[np.bool_] = off_s > np.maximum(FAR_S, FAR_MADS * np.median(off_s))
    clocks_s = [usual_s for usual_s, spread_s in map(_lateness, others) if spread_s < STEADY_S]
    if all(abs(np.median(late_s) - clock_s) > CLOCKS_APART_S for clock_s in clocks_s):
        for clock_s in clocks_s:
            is_near = np.abs(late_s - clock_s) < FAR_S
            off_s = late_s[~is_near]
            is_set_once = np.median(np.abs(off_s - np.median(off_s))) < STEADY_S
            if is_set_once and is_near.mean() > RIGHT_SHARE:
                far = ~is_near
    run = np.cumsum(np.abs(np.diff(stamp_s, prepend=stamp_s[0])) > FAR_S)
    return far & ~np.isin(run, run[~far])


def _lateness(times_s: Array) -> tuple[float, float]:
    """Median of stamp minus time of recording in ``times_s (N, 2)``, and the median distance from it."""
    late_s = times_s[:, 0] - times_s[:, 1]
    usual_s = float(np.median(late_s))
    return usual_s, float(np.median(np.abs(late_s - usual_s)))


def ahead_of(one: Array, other: Array) -> tuple[float, bool]:
    """Seconds by which stamps are ahead of others, compared with the times of recording, and whether their clocks
    differ for sure; 0 if nothing tells. ``one`` and ``other``: stamps and times of recording ``(N, 2)``."""
    one, other = (times_s[np.isfinite(times_s[:, 0])] for times_s in (one, other))
    if not len(one) or not len(other) or min(one[-1, 1], other[-1, 1]) <= max(one[0, 1], other[0, 1]):
        return 0.0, False
    (one_s, one_spread_s), (other_s, other_spread_s) = _lateness(one), _lateness(other)
    ahead_s, spread_s = one_s - other_s, max(one_spread_s, other_spread_s)
    is_sure = spread_s < STEADY_S and abs(ahead_s) > CLOCKS_APART_S
    is_likely = spread_s < SPREAD_SHARE * abs(ahead_s) and -ahead_s > LATE_S  # else the others are recorded late
    return (ahead_s if is_sure or is_likely else 0.0), is_sure


def rising_stamps(stamp_s: Array, strictly: bool = True) -> IntArray:
    """Indices of the longest rising series of stamps ``(N,)``, so that one wrong stamp leaves out one message.

    NaN are left out. Not ``strictly``: equal stamps rise, too.
    """
    known = np.flatnonzero(~np.isnan(stamp_s))
    steps = np.diff(stamp_s[known])
    if (steps > 0).all() or (not strictly and (steps >= 0).all()):
        return known
    # From the end, so that of two series of one length the earlier messages are kept.
    known, find = known[::-1], bisect_left if strictly else bisect_right
    tails: list[float] = []  # the last stamp, negative, of the best series of each length
    ends: list[int] = []
    before = np.full(len(known), -1)
    for k, stamp in enumerate((-stamp_s[known]).tolist()):
        length = find(tails, stamp)
        before[k] = ends[length - 1] if length else -1
        tails[length : length + 1], ends[length : length + 1] = [stamp], [k]
    chosen = [ends[-1]]
    while before[chosen[-1]] >= 0:
        chosen.append(int(before[chosen[-1]]))
    return known[chosen]


def seconds_and_fraction(column: Sequence[str]) -> tuple[Array, str] | None:
    """Stamps ``(N,)``, seconds, and their units, from numbers such as 7.42 where 42 counts ns, µs or ms: some programs
    write them after the point without the zeros before them. Their steps are then even if they are read so, and not as
    decimals; else None."""
    parts = [number.partition(".") for number in column]
    longest = max((len(part) for *_, part in parts), default=0)
    digits = next((each for each in (3, 6, 9) if each >= longest), 0)
    if not digits or len({len(part) for *_, part in parts}) == 1:
        return None
    if not all(whole.isdecimal() and (part or "0").isdecimal() for whole, _, part in parts):
        return None
    plain = np.array([float(number) for number in column])
    padded = np.array([int(whole) + int(part or 0) / 10**digits for whole, _, part in parts])
    uneven = [float(np.ptp(np.diff(np.sort(stamp_s)))) for stamp_s in (plain, padded)]
    return (padded, f"s and {FRACTIONS[digits]}") if uneven[1] < EVENER * uneven[0] else None


def in_order(stamp_s: Array) -> IntArray:
    """Indices of the scans with stamps ``(N,)`` by stamp, each stamp once, if those recorded in another order are near
    their place: programs with several threads swap scans, and of two sensors one lags. Else `rising_stamps`."""
    known = np.flatnonzero(~np.isnan(stamp_s))
    order = np.argsort(stamp_s[known], kind="stable")
    if np.abs(order - np.arange(len(order))).max(initial=0) > SWAPPED_BY:
        return rising_stamps(stamp_s)
    found = known[order]
    return found[np.diff(stamp_s[found], prepend=-np.inf) > 0]


def taken_together(
    stamp_s: Array, log_s: Array, frames: Sequence[str], repeated: Collection[int] = ()
) -> list[list[int]]:
    """Numbers of the messages of each scan: those that follow each other with one stamp in ``stamp_s (N,)`` are one.

    They are of several sensors, by their ``frames (N,)``, or parts of one scan: see `_are_parts`. Those ``repeated``
    are left out.
    """
    found: list[list[int]] = []
    are_parts = _are_parts(stamp_s, log_s, frames, repeated)
    for k, (stamp, frame) in enumerate(zip(stamp_s.tolist(), frames, strict=True)):
        last = found[-1] if found and stamp == stamp_s[found[-1][0]] else []
        if last and (are_parts or k in repeated or frame not in {frames[each] for each in last}):
            last += [k] if k not in repeated else []
        else:
            found.append([k])
    return found


def _are_parts(stamp_s: Array, log_s: Array, frames: Sequence[str], repeated: Collection[int]) -> bool:
    """Whether messages of one frame and stamp are parts of a scan: most stamps have several, and these are recorded
    much nearer to each other than to the next stamp's, unlike scans by a clock that is coarse or stands still."""
    table = pd.DataFrame({"frame": frames, "stamp": stamp_s, "log": log_s}).drop(index=list(repeated)).dropna()
    step = table.groupby("frame").diff()
    within, between = step["log"][step["stamp"] == 0].abs(), step["log"][step["stamp"].abs() > 0].abs()
    if within.empty or between.empty or table.groupby(["frame", "stamp"]).size().median() < 2:
        return False
    return bool(np.quantile(within, 0.9) < PARTS_SHARE * np.median(between))
