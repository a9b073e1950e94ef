"""Playing a recording: the odometry gets what it would get live, and drops cost what they cost."""

import numpy as np
import pytest

from steelnb.errors import RecordingError, SettingsError
from steelnb.replay import play as module
from steelnb.replay.course import course_of
from steelnb.replay.judge import score
from steelnb.replay.live import Ready
from steelnb.replay.offline import replay
from steelnb.replay.options import Options
from steelnb.replay.play import fastest_rate, play_recording, played_through
from steelnb.replay.simulated import simulated_recording
from tests.replay.flights import lattice, made, settings
from tests.replay.test_live import MadeClock


@pytest.fixture(scope="module")
def recording():
    return simulated_recording(settings())


def through(recording, work_s):
    """Play by a made clock on which each update takes ``work_s``."""
    course, clock = course_of(recording), MadeClock()
    found = played_through(
        course.flight, settings(), 1.0, Ready(list(course.flight.scans)), clock, lambda *_: clock.work(work_s)
    )
    return course, *found


def test_without_drops_the_poses_are_those_of_a_run(recording):
    course, played, poses = through(recording, 0.19)
    assert played.missed == 0
    np.testing.assert_array_equal(poses, replay(course.flight, settings()).corrected.T_world_drone)


def test_drops_cost_accuracy_against_a_run_at_the_same_scans(recording):
    course, played, poses = through(recording, 0.59)
    assert played.dropped > len(course.flight.prior) / 2
    ate, undropped = module._accuracy(course, settings(), played, poses)
    whole = replay(course.flight, settings()).corrected
    truth = course.truth.at(course.flight.prior.stamp_s[played.index])
    assert undropped == score(whole, truth)["ate_rmse_m"]
    assert ate != undropped
    assert len(poses) == len(played.index)


def test_a_report_by_the_wall_clock(recording):
    seen = []
    report = play_recording(recording, 20.0, Options(), lambda *done: seen.append(done))
    assert report.played.total == 40
    assert seen[-1] == (40, 40)
    assert len(report.played.index) + report.played.dropped == 40
    assert report.ate_m < 0.05
    text = "\n".join(report.summary)
    for word in ("40 scans at 20 x, 100.0 a second", "missed", "50 %", "95 %", "99 %", "max", "reading", "ATE"):
        assert word in text
    if not report.played.dropped:
        assert report.ate_m == report.ate_undropped_m


def test_a_report_by_processor_time(recording):
    report = play_recording(recording, 0.01, alone=True)  # twenty seconds a scan, which nobody waits for
    assert (report.played.missed, report.played.dropped) == (0.0, 0)
    assert "as if nothing else ran here" in report.summary[0]
    assert report.ate_m == report.ate_undropped_m
    fast = play_recording(recording, 1e6, alone=True)
    assert fast.played.dropped > 30
    assert fast.played.missed == 1.0
    assert (fast.played.reading_s == 0).all()


def test_without_truth_nothing_is_said_of_accuracy():
    report = play_recording(made(lambda k: lattice(np.random.default_rng(k))), 50.0)
    assert report.ate_m is None
    assert not any(line.startswith("accuracy") for line in report.summary)
    assert "no truth" in "\n".join(report.summary)


def test_the_fastest_rate_is_one_that_was_tried_and_good(monkeypatch, recording):
    monkeypatch.setattr(module, "SCANS_MIN", 20)
    tried = {}
    rate, summary = fastest_rate(recording, Options(), lambda rate, played: tried.update({rate: played}), alone=True)
    assert len(tried) > 1
    assert tried[rate].missed < 0.01
    assert min(given for given, played in tried.items() if played.missed >= 0.01) / rate < 1.06
    assert summary[0].startswith(f"fastest   {rate:.3g} x")
    assert "as if nothing else ran here" in summary[0]
    assert all(played.total == 40 for played in tried.values())


def test_where_no_rate_is_low_enough_it_is_said(monkeypatch, recording):
    monkeypatch.setattr(module, "SCANS_MIN", 20)
    monkeypatch.setattr(module, "highest_rate", lambda *_: 0.0)
    rate, summary = fastest_rate(recording, alone=True)
    assert (rate, summary) == (0.0, (f"fastest   no rate with less than 1% missed, best, {recording.path.name}",))


def test_scans_that_fit_into_memory_are_tried(monkeypatch, recording):
    monkeypatch.setattr(module, "HELD_BYTES", 10 * 120 * 90 * 24 + 1)
    assert len(module._first_scans(course_of(recording).flight)) == 10


def test_bad_rates_and_short_recordings_are_refused(recording):
    for rate in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SettingsError, match="rate"):
            play_recording(recording, rate)
    with pytest.raises(RecordingError, match="40 scans with a pose; expected at least 100"):
        fastest_rate(recording)
