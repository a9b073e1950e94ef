"""Stamps of scans from the names of their files."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from steelnb.core.types import Array, Trajectory
from steelnb.io.clocks import EVENER, FRACTIONS, seconds_and_fraction
from steelnb.io.table_form import unix_us
from steelnb.io.trajectories import SECONDS, unit_of_stamps

STEP_S = 1e-3, 60.0
"""Bounds of the median interval of scans, by which the unit of small stamps is recognised."""
OVERLAP_MIN, NS_DIGITS = 0.5, 16
"""Minimum overlap of small stamps with the poses, by which their unit is recognised; integers with so many digits are
nanoseconds."""
COUNT_SHARE = 0.1
"""Numbers after seconds count if, as decimals, they give a median interval of less than this share of the mean one."""
NUMBER = re.compile(r"\d+(?:\.\d+)?")
MEASURE = re.compile(r"(?<!\d)\d{1,7}\.\d+(?:C|m|cm|mm|km|kB|MB|GB|V|Hz)(?![A-Za-z])")
"""A number with decimals and a unit, such as 20.5C, is no stamp."""
DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?:[-_. T]*| at )(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)s?"
    r"(?:[.,](\d{1,9})|(\d{3}|\d{6}|\d{9}))?(?!\d)(Z|\+\d\d:?\d\d)?"
)
"""Date and time of day, with decimals of the second and zone if any; most programs avoid colons in names."""


def stamps_of(names: Sequence[str], prior: Trajectory) -> tuple[Array | None, str]:
    """Stamps ``(K,)`` in seconds from names without endings, sorted by their numbers, and a text on them; None if no
    number in the names is one.

    A stamp is a number with a decimal point, in seconds; an integer that is a Unix time in s, ms, µs or ns, or in one
    of these units fits the poses; or two integers, Unix seconds and their decimals. The last such number is chosen.
    Date and time are Unix seconds if the poses are of that time, and else no stamp: many programs write local time.
    """
    dates = [_unix(name) or "" for name in names]
    dated_s = np.array([float(date) for date in dates]) if all(dates) else None
    is_of_poses = dated_s is not None and unit_of_stamps(prior.stamp_s) == "s"
    if dated_s is not None and is_of_poses:  # as many of both are pairs otherwise: they must overlap for long
        share_min = OVERLAP_MIN if len(prior) == len(dated_s) > 1 else 0.0
        is_of_poses = _overlap(np.sort(dated_s), prior.stamp_s) > share_min
    if dated_s is not None:  # else the digits of a date are those of no stamp
        names = [DATE.sub(date if is_of_poses else "", name, count=1) for name, date in zip(names, dates, strict=True)]
    numbers = [NUMBER.findall(MEASURE.sub("", name))[::-1] for name in names]
    columns = list(zip(*numbers, strict=False))  # the numbers of each place, the last first
    for column, before in zip(columns, [*columns[1:], None], strict=False):
        for stamp_s, units in _readings(column, before, prior, is_of_poses):
            step_s = np.diff(np.sort(stamp_s) if "." in column[0] else stamp_s)
            if not len(step_s) or ((step_s >= 0).all() and STEP_S[0] <= np.median(step_s) <= STEP_S[1]):
                is_date = dated_s is not None and np.abs(stamp_s - dated_s).max() < 1
                return stamp_s, f"stamped by their names ({'date and time, UTC' if is_date else units})"
    is_other = dated_s is not None and not is_of_poses
    return None, f"{'dates of another time than the poses' if is_other else 'no stamps'} in their names"


def _unix(name: str) -> str | None:
    """The Unix seconds of the date in a name, with its decimals; None if there is none."""
    match = DATE.search(name)
    if not match:
        return None
    *time, decimals, more, zone = match.groups(default="")
    try:
        seconds = unix_us("{}-{}-{}T{}:{}:{}".format(*time) + zone) // 10**6
    except ValueError:
        return None
    return f"{seconds}.{decimals or more}" if decimals or more else str(seconds)


def _readings(
    column: Sequence[str], before: Sequence[str] | None, prior: Trajectory, is_dated: bool
) -> Iterator[tuple[Array, str]]:
    """What the same number of all names, and the one before it, may mean: stamps in seconds, and their units.

    ``is_dated``: a date has become Unix seconds, after which numbers often count."""
    if any("." in number for number in column):
        plain_s = np.array([float(number) for number in column])
        stamp_s, units = seconds_and_fraction(column) or (plain_s, "s")
        unix = unit_of_stamps(stamp_s)
        is_order = len(prior) == len(column) and not unix and len(column) > 1
        if not is_order or _overlap(np.sort(stamp_s), prior.stamp_s) > OVERLAP_MIN:
            yield (stamp_s, units) if unix in (None, "s") else (stamp_s * SECONDS[unix], unix.replace("us", "µs"))
        return
    whole = [int(number) for number in column]
    widths = {len(number) for number in column}
    digits = next((each for each in (3, 6, 9) if each >= max(widths)), 0)
    if before and digits and not any("." in number for number in before):
        seconds = np.array([float(number) for number in before])
        stamp_s = seconds + np.array(whole) / 10**digits
        step_s, second_s = np.diff(stamp_s), np.diff(seconds)
        is_count = len(whole) > 1 and (set(np.diff(whole)) == {1} or np.median(step_s) < COUNT_SHARE * np.mean(step_s))
        is_padded = widths == {digits} and (np.ptp(seconds) > 0 or not is_dated or digits == 9)
        is_even = len(whole) > 2 and np.ptp(step_s) < EVENER * np.ptp(second_s)
        is_time = unit_of_stamps(seconds) == "s" or _overlap(stamp_s, prior.stamp_s) > OVERLAP_MIN
        if is_time and not is_count and (is_padded or max(widths) > 6 or is_even):
            yield stamp_s, f"s and {FRACTIONS[digits]}"
    unix = unit_of_stamps(np.array(whole, dtype=np.float64))
    sure = [unix or "", "ns" if min(widths) >= NS_DIGITS else ""]
    for unit in [unit for unit in sure if unit] + ["ns", "us", "ms"]:
        per_second = round(1 / SECONDS[unit])
        stamp_s = np.array([number // per_second + number % per_second / per_second for number in whole])
        if unit in sure or _overlap(stamp_s, prior.stamp_s) > OVERLAP_MIN:
            yield stamp_s, unit.replace("us", "µs")


def _overlap(one_s: Array, other_s: Array) -> float:
    """Share that two intervals have in common, of the longer one."""
    both = min(one_s[-1], other_s[-1]) - max(one_s[0], other_s[0])
    return float(both / max(np.ptp(one_s), np.ptp(other_s), 1e-9))
