"""Clocks of recordings: wrong stamps, clocks of no use, and scans that are off the poses."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.io import read_flight
from steelnb.io.clocks import far_stamps, in_order, rising_stamps, taken_together
from tests.io.samples import Bagged, poses

EPOCH_S = 1_700_000_000.0
TIMES = np.round(EPOCH_S + 0.2 * np.arange(8), 9)


def bag_of(path, scan_s, pose_s=TIMES):
    """A bag whose messages are recorded at `TIMES`, with other stamps of scans and poses."""
    bag, T = Bagged(path), poses(8, begin_s=EPOCH_S).T_world_drone
    wrong = SimpleNamespace(stamp_s=pose_s, T_world_drone=T)  # no Trajectory may have such stamps
    bag.clouds(stamps=scan_s).odometry(trajectory=wrong)
    bag.rows = [(topic, kind, TIMES[k % 8], message) for k, (topic, kind, _, message) in enumerate(bag.rows)]
    return bag.write()


@pytest.mark.parametrize(("at", "wrong_s"), [(0, EPOCH_S + 60), (4, 0.0), (4, EPOCH_S - 60), (7, 2_085_978_496.0)])
@pytest.mark.parametrize("what", ["scan", "pose"])
def test_one_wrong_stamp_costs_one_message(tmp_path, at, wrong_s, what):
    stamps = TIMES.copy()
    stamps[at] = wrong_s
    flight = read_flight(bag_of(tmp_path / "a.mcap", *((stamps, TIMES) if what == "scan" else (TIMES, stamps))))
    kept = np.delete(TIMES, at)
    if what == "pose" and at == 4:  # interpolated between its neighbours
        kept = TIMES
    np.testing.assert_array_equal(flight.prior.stamp_s, kept)
    assert any(reason.startswith(f"{what} whose stamp is far from the time of recording") for reason in flight.skipped)


@pytest.mark.parametrize("places", [[1, 0, 3, 2, 5, 4, 7, 6], [0, 1, 2, 5, 6, 3, 4, 7]])
def test_poses_of_two_threads_are_sorted(tmp_path, places):
    flight = read_flight(bag_of(tmp_path / "a.mcap", TIMES, TIMES[places]))
    np.testing.assert_array_equal(flight.prior.stamp_s, TIMES)
    assert flight.skipped == {"pose out of order, sorted by its stamp": int((np.diff(places) < 0).sum())}


def test_poses_of_a_clock_that_is_set_back_once_are_not_mixed(tmp_path):
    stamps = np.round(0.1 * np.concatenate([np.arange(20), np.arange(17.5, 40)]), 9)
    path, T = Bagged(tmp_path / "a.mcap").clouds(stamps=stamps[:18]), poses(len(stamps)).T_world_drone
    path.odometry(trajectory=SimpleNamespace(stamp_s=stamps, T_world_drone=T))
    for k in range(len(stamps)):
        topic, kind, _, message = path.rows[k - len(stamps)]
        path.rows[k - len(stamps)] = topic, kind, 0.1 * k, message
    assert read_flight(path.write()).skipped == {"pose whose stamp does not rise": 2}


def test_the_clock_that_most_stamps_have_counts(tmp_path):
    jump = np.where(np.arange(8) < 3, TIMES - EPOCH_S + 30, TIMES)
    flight = read_flight(bag_of(tmp_path / "a.bag", jump, jump))
    np.testing.assert_array_equal(flight.prior.stamp_s, TIMES[3:])


@pytest.mark.parametrize("off_s", [37.0, -3600.0, 5.0 - EPOCH_S])
def test_of_two_clocks_of_the_scans_that_of_the_poses_counts(tmp_path, off_s):
    flight = read_flight(bag_of(tmp_path / "a.bag", np.where(np.arange(8) < 5, TIMES + off_s, TIMES)))
    np.testing.assert_array_equal(flight.prior.stamp_s, TIMES[5:])
    assert 5 in flight.skipped.values()


@pytest.mark.parametrize("late_s", [0.7, 2.0])
def test_scans_seconds_behind_the_poses_by_the_times_of_recording_are_noted(tmp_path, late_s):
    begun = np.round(EPOCH_S - 5 + 0.2 * np.arange(40), 9)
    bag = Bagged(tmp_path / "a.mcap").clouds(stamps=TIMES - late_s)
    bag.odometry(trajectory=poses(40, begin_s=EPOCH_S - 5))
    log_s = [*TIMES, *begun]
    bag.rows = [(topic, kind, log, message) for (topic, kind, _, message), log in zip(bag.rows, log_s, strict=True)]
    note = "scans are 2.0 s behind the poses by the times of recording: they are late, or the clocks differ (--time-off"
    assert (note in read_flight(bag.write()).facts.get("notes", "")) == (late_s == 2.0)


@pytest.mark.parametrize("off_s", [0.0, -37.0, -2.0])
def test_transforms_of_a_gimbal_on_another_clock_are_noted_or_refused(tmp_path, off_s):
    bag, T = Bagged(tmp_path / "a.mcap").clouds(stamps=TIMES).odometry(trajectory=poses(8, begin_s=EPOCH_S)), poses(8)
    log_s = [*TIMES, *TIMES, *TIMES]
    bag.moving("base_link", "tof", SimpleNamespace(stamp_s=TIMES + off_s, T_world_drone=T.T_world_drone))
    bag.rows = [(topic, kind, log, message) for (topic, kind, _, message), log in zip(bag.rows, log_s, strict=True)]
    path = bag.write()
    if off_s:
        match = (
            "scans are 37.0 s ahead of the transforms base_link → tof" if off_s < -10 else "no scan has a place on the"
        )
        with pytest.raises(InputError, match=match):
            read_flight(path)
    else:
        assert len(read_flight(path)) == 8


@pytest.mark.parametrize("stamps", [np.zeros(8), 12.5 + 0.1 * np.arange(8), TIMES[::-1]])
def test_a_clock_of_no_use_is_refused_and_that_of_the_bag_can_be_taken(tmp_path, stamps):
    path = bag_of(tmp_path / "a.mcap", stamps)
    with pytest.raises(InputError, match=r"a.mcap: .*--clock bag takes the times of recording"):
        read_flight(path)
    np.testing.assert_array_equal(read_flight(path, clock="bag").prior.stamp_s, TIMES)


@pytest.mark.parametrize("ahead_s", [18.0, -37.0])
def test_scans_ahead_of_the_poses_by_the_times_of_recording_are_refused_with_the_shift(tmp_path, ahead_s):
    path = bag_of(tmp_path / "a.mcap", TIMES + ahead_s)
    how = f"scans are {abs(ahead_s)} s (ahead of|behind) the poses .*--time-offset {-ahead_s} shifts scans, --clock bag"
    with pytest.raises(InputError, match=how):
        read_flight(path)
    assert len(read_flight(path, time_offset_s=-ahead_s)) == len(read_flight(path, clock="bag")) == len(TIMES)


def test_stamps_in_the_wrong_unit_are_noted(tmp_path):
    stamps = EPOCH_S + np.arange(8) * 2e-4
    flight = read_flight(bag_of(tmp_path / "a.mcap", stamps))
    assert "stamps of scans are 0.0002 s apart, which were recorded every 0.2 s" in flight.facts["notes"]


def test_scans_can_be_shifted_against_poses(tmp_path):
    path = bag_of(tmp_path / "a.mcap", TIMES - 3600.1)
    np.testing.assert_allclose(read_flight(path, time_offset_s=3600.1).prior.stamp_s, TIMES, atol=1e-6)
    for options in ({"clock": "sun"}, {"time_offset_s": np.nan}, {"time_offset_s": 1e300}):
        with pytest.raises(InputError, match="expected stamps or bag, and seconds below"):
            read_flight(path, **options)


@pytest.mark.parametrize("speed", [0.1, 1.0, 20.0])
def test_a_simulated_clock_of_any_speed_is_right(speed):
    log_s = EPOCH_S + 0.1 * np.arange(600)
    assert not far_stamps(speed * 0.1 * np.arange(600), log_s).any()


def test_stamps_that_go_on_while_the_recording_paused_are_right():
    stamp_s = 0.1 * np.arange(600)
    assert not far_stamps(stamp_s, EPOCH_S + stamp_s + 60 * (stamp_s > 40)).any()


@given(st.lists(st.integers(0, 6), max_size=9), st.booleans())
def test_the_longest_rising_series_is_kept(stamps, strictly):
    found = rising_stamps(np.array(stamps, dtype=float), strictly)
    steps = np.diff(np.array(stamps)[found])
    assert (steps > 0).all() if strictly else (steps >= 0).all()
    best = [1] * len(stamps)
    for k, stamp in enumerate(stamps):
        for j in range(k):
            if stamps[j] < stamp or (stamps[j] == stamp and not strictly):
                best[k] = max(best[k], best[j] + 1)
    assert len(found) == max(best, default=0)


def test_different_scans_of_a_clock_that_stands_still_are_not_joined(tmp_path):
    stamps = TIMES.copy()
    stamps[3:6] = stamps[3]
    flight = read_flight(bag_of(tmp_path / "a.mcap", stamps))
    np.testing.assert_array_equal(flight.prior.stamp_s, np.delete(TIMES, [4, 5]))
    assert flight.scans[3].points.size == flight.scans[2].points.size


@pytest.mark.parametrize(("count", "log"), [(10, "even"), (3, "even"), (1, "bursts")])
def test_scans_of_a_coarse_clock_are_not_joined(tmp_path, count, log):
    """``count`` scans have one stamp each; of the bursts, five of a clock that stands still."""
    number = np.arange(40)
    stamps = 0.1 * (number // count * count)
    stamps[11:16] = stamps[11] if log == "bursts" else stamps[11:16]
    log_s = 0.1 * number if log == "even" else 0.5 * (number // 5) + 1e-9 * number
    frames = ["tof"] * len(number)
    assert taken_together(stamps, log_s, frames) == [[k] for k in number]
    two = taken_together(np.repeat(stamps, 2), np.repeat(log_s, 2), ["front", "rear"] * len(number))
    assert two == [[2 * k, 2 * k + 1] for k in number]


def test_repeated_scans_between_others_are_not_joined():
    stamps = np.array([0.0, 0.1, 0.0, 0.2, 0.1])
    assert len(taken_together(stamps, 0.1 * np.arange(5), ["tof"] * 5, {2, 4})) == 5


@pytest.mark.parametrize("clock", ["stamps", "bag"])
def test_poses_that_are_recorded_in_bursts_are_in_metres(tmp_path, clock):
    bag, stamps = Bagged(tmp_path / "a.mcap").clouds(), np.round(0.02 * np.arange(60), 9)
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:, 0, 3] = stamps
    bag.odometry(trajectory=Trajectory(stamps, T))
    for k, (topic, kind, _, message) in enumerate(bag.rows[-60:]):
        bag.rows[k - 60] = topic, kind, 0.3 * (k // 6) + 4e-5 * (k % 6), message
    assert len(read_flight(bag.write(), clock=clock)) == 5


@pytest.mark.parametrize(
    ("stamp_s", "order"),
    [
        ([0, 2, 1, 3, np.nan, 5, 4], [0, 2, 1, 3, 6, 5]),
        ([1, 1, 2, 2, 3], [0, 2, 4]),
        ([0, 1, 2, 3, 4, 5, 6, 0.5, 7], [0, 1, 2, 3, 4, 5, 6, 8]),
    ],
)
def test_scans_are_sorted_unless_they_are_far_from_their_place(stamp_s, order):
    np.testing.assert_array_equal(in_order(np.array(stamp_s, dtype=float)), order)
