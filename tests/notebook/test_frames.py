import dataclasses
import math

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.notebook.frames import Scenes, attempt, match_images, trial_table, trial_timing
from steelnb.settings import ExperimentSettings, FlightSettings, TofSettings
from steelnb.simulation.flight import pose_on_path
from steelnb.simulation.tof import TofCamera, take_view


@pytest.fixture(scope="module")
def scenes():
    return Scenes()


def test_a_frame_is_made_again_by_its_seed(scenes):
    first, again, other = scenes.frames(3, 2), scenes.frames(3, 2), scenes.frames(4, 1)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.points, two.points)
    assert len(other[0].points) != len(first[0].points)
    assert first[0].members.observed().sum() >= 10


def test_noise_clutter_and_density_are_as_asked_and_change_nothing_else(scenes):
    exact, noisy = (scenes.frames(3, 1, noise_m=noise, clutter=0.0)[0] for noise in (0.0001, 0.03))
    np.testing.assert_allclose(len(noisy.points), len(exact.points), rtol=0.02)  # a few leave the range
    np.testing.assert_allclose(noisy.members.axes, exact.members.axes, atol=0.1)
    cluttered = scenes.frames(3, 1, clutter=0.25)[0]
    plain = scenes.frames(3, 1, clutter=0.0)[0]
    np.testing.assert_array_equal(cluttered.points[: len(plain.points)], plain.points)
    assert 1 - len(plain.points) / len(cluttered.points) == pytest.approx(0.25, abs=0.001)
    thin = scenes.frames(3, 1, clutter=0.0, kept=0.25)[0]
    assert len(thin.points) / len(plain.points) == pytest.approx(0.25, abs=0.02)


def test_range_noise_has_its_standard_deviation(scenes):
    tof = TofSettings.preset("starling2").replace(sigma_floor_m=0.02, sigma_relative=0.0)
    T = pose_on_path(scenes.tower, FlightSettings.preset("zigzag"), 0.3)
    view = take_view(TofCamera(scenes.tower, tof, 0), T, np.random.default_rng(0))
    off = np.linalg.norm(view.points - T[:3, 3], axis=1) - np.linalg.norm(view.surface - T[:3, 3], axis=1)
    assert off.std() == pytest.approx(0.02, rel=0.05)
    assert abs(off.mean()) < 0.001
    assert view.points[:, 2].min() >= 0.3
    np.testing.assert_allclose(view.across, [1, 0, 0], atol=1e-9)


def test_a_drone_may_lean(scenes):
    T = pose_on_path(scenes.tower, FlightSettings.preset("loops"), 0.4, np.array([0.0, 0.1, 0.0]))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert T[2, 0] == pytest.approx(-math.sin(0.1))  # pitched down


def test_trials_become_rows(scenes):
    seen = [scene for seed in (5, 6) for scene in scenes.frames(seed, 2)]
    trials = [attempt(name, scene) for name in ("hough", "dbscan") for scene in seen]
    table = trial_table(trials)
    assert len(table) == 4
    assert (table["frames"] == 2).all()
    hough = table[table["method"] == "hough"]
    expected = np.mean([t.score.recall for t in trials[:2]])
    assert hough["recall"].iloc[0] == pytest.approx(expected)
    assert "median_ms" not in table
    timing = trial_timing(trials)
    assert timing[["method", "seed"]].equals(table[["method", "seed"]])


def test_a_frame_without_a_segment_has_precision_0(scenes):
    nothing = attempt("hough", scenes.frames(5, 1)[0], points_min=100_000)
    row = trial_table([nothing]).iloc[0]
    assert row["precision"] == row["recall"] == row["segments"] == 0
    assert math.isnan(row["angle_deg"])


@pytest.fixture(scope="module")
def flown():
    return experiment.simulate(ExperimentSettings.preset("zigzag", "none", "orb", "starling2", 1, 2.0))


def test_the_true_motion_tells_which_matches_are_right(flown):
    flight, truth = flown
    between = match_images(flight, truth, 3, 6)
    moved = np.linalg.norm(between.second - between.first, axis=1)
    known = np.isfinite(between.apart_px)
    assert known.sum() > 10
    assert len(np.unique(between.second, axis=0)) == len(between.first), "each feature is matched once"
    assert np.median(between.apart_px[known]) < 2 < np.median(moved[known])


def test_a_flight_without_images_is_refused(flown):
    flight, truth = flown
    with pytest.raises(InputError, match="has no images"):
        match_images(dataclasses.replace(flight, images=None), truth, 0, 1)
