"""A recording through an odometry is the experiment, to the bit; odd scans are counted, and never a crash."""

from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.config import METHODS
from steelnb.errors import RecordingError
from steelnb.replay.course import course_of
from steelnb.replay.judge import judged
from steelnb.replay.offline import periods, replay, uncounted, warm_up
from steelnb.replay.options import Options
from steelnb.replay.simulated import HeldScans, simulated_recording
from tests.replay.flights import NOISE, lattice, made, settings


@pytest.fixture(scope="module")
def recording():
    return simulated_recording(settings())


@pytest.mark.parametrize("method", ["best", "least_squares", "icp-3dof"])
def test_a_replayed_recording_is_the_experiment_to_the_bit(recording, method):
    expected = experiment.run(settings(method))
    for options in (Options(method), Options(method, noise=NOISE, seed=3)):  # as recorded, and drawn again
        course = course_of(recording, options.drift, options.seed)
        found = replay(course.flight, options.settings())
        np.testing.assert_array_equal(found.corrected.T_world_drone, expected.corrected.T_world_drone)
        np.testing.assert_array_equal(found.prior.T_world_drone, expected.prior.T_world_drone)
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_array_equal(found.matches, expected.matches)
        numbers = judged(course, found, {})
        for name in ("ate_rmse_m", "error_final_m", "rpe_rmse_m"):
            assert numbers[f"corrected_{name}"] == expected.metrics[name]
        assert numbers["prior_ate_rmse_m"] == expected.metrics["raw_ate_rmse_m"]
        removed = 100 * (1 - expected.metrics["ate_rmse_m"] / expected.metrics["raw_ate_rmse_m"])
        assert numbers["drift_removed_percent"] == pytest.approx(removed)


def test_another_seed_is_another_drift(recording):
    first, second = (course_of(recording, Options(noise=NOISE).drift, seed).flight.prior for seed in (3, 4))
    assert np.abs(first.position - second.position).max() > 0.01


def test_observers_are_told_of_every_frame(recording):
    frames = []
    flight = course_of(recording).flight
    found = replay(flight, settings(), [lambda frame, odometry: frames.append((frame, len(odometry.map_points())))])
    assert [frame.index for frame, _ in frames] == list(range(len(flight.prior)))
    assert frames[-1][0].on_time == np.count_nonzero(found.seconds <= found.period_s)
    assert frames[-1][1] == len(found.points)
    assert [frame.step.stamp_s for frame, _ in frames] == flight.prior.stamp_s.tolist()


NAN = np.full((24, 18, 3), np.nan)
ODD = {
    "all NaN": lambda k: NAN,
    "no point": lambda k: np.zeros((0, 3)),
    "no pixel": lambda k: np.zeros((0, 0, 3)),
    "one point": lambda k: np.array([[2.0, 0.0, 0.0]]),
    "one place": lambda k: np.tile([[2.0, 0.1, 0.0]], (500, 1)),
    "a line": lambda k: np.c_[np.full(300, 2.0), np.linspace(-1, 1, 300), np.zeros(300)],
    "zero ranges": lambda k: np.zeros((20, 20, 3)),
    "square to the axis": lambda k: np.dstack([np.zeros((20, 20)), *np.random.default_rng(k).normal(size=(2, 20, 20))]),
    "far beyond all": lambda k: 1e30 * np.random.default_rng(k).normal(size=(300, 3)),
    "infinite": lambda k: np.full((300, 3), np.inf),
    "of all kinds": lambda k: [NAN, np.zeros((0, 3)), lattice(np.random.default_rng(k))][k % 3],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ODD)
def test_odd_scans_are_counted_and_never_a_crash(kind, method):
    course = course_of(made(ODD[kind], scans=5))
    found = replay(course.flight, Options(method).settings())
    assert np.isfinite(found.corrected.T_world_drone).all()
    numbers = judged(course, found, {})
    unused = sum(count for name, count in numbers.items() if name.startswith("not used: "))
    assert numbers["used"] + unused == numbers["frames"] == 5
    if kind not in ("a line", "square to the axis", "of all kinds"):
        assert numbers["used"] == 0


def test_a_source_that_ends_early_is_no_traceback():
    recording = made(lambda k: lattice(np.random.default_rng(k)))
    full = recording.scans
    short = HeldScans([], full.stamp_s)
    short.walk = lambda wanted=None: iter(list(full.walk())[:5])
    with pytest.raises(RecordingError, match="5 scans could be read; expected the 8"):
        replay(course_of(replace(recording, scans=short)).flight, settings())


def test_warming_up_counts_nothing():
    recording = made(lambda k: lattice(np.random.default_rng(k)))
    recording.skipped["empty cloud"] = 2
    with uncounted(recording.skipped):
        warm_up(course_of(recording).flight, settings())
        recording.skipped["empty cloud"] += 1
    assert recording.skipped == {"empty cloud": 2}


def test_periods():
    np.testing.assert_allclose(periods(np.array([0.0, 0.2, 0.5, 0.7])), [0.2, 0.3, 0.2, 0.2])
    assert periods(np.array([1.0])).tolist() == [np.inf]
