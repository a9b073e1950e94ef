"""Smoothing: poses and bars adjusted together, on simulated flights and on a made-up problem with a known answer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Segments, Trajectory
from steelnb.fusion import smooth
from steelnb.fusion.adjustment import factors, problem, solver
from steelnb.fusion.adjustment import smooth as smoothing
from steelnb.fusion.sections.shapes import THICKNESS
from steelnb.metrics import score_trajectory
from steelnb.points.ranges import range_sigma_m
from steelnb.settings import ExperimentSettings
from tests.fusion.made import made_up

NOISE = "constant-drift:0.0004+random-walk+yaw-random-walk"


@pytest.fixture(scope="module")
def flown():
    settings = ExperimentSettings.preset("loops", NOISE, seed=11, duration_s=12.0, method="best")
    flight, truth = experiment.simulate(settings)
    return flight, truth, experiment.estimate(settings, flight, truth)


@pytest.fixture(scope="module")
def smoothed(flown):
    flight, _, estimate = flown
    return smooth(flight, estimate)


def test_it_halves_the_error_of_the_best_odometry(flown, smoothed):
    _, truth, estimate = flown
    before, after = (score_trajectory(each.corrected, truth.trajectory)["ate_rmse_m"] for each in (estimate, smoothed))
    assert smoothed.unsmoothed == ""
    assert after < 0.6 * before
    assert after < 0.008


def test_the_first_pose_is_the_prior_s_and_roll_and_pitch_stay(flown, smoothed):
    flight, _, estimate = flown
    np.testing.assert_allclose(smoothed.corrected.T_world_drone[0], flight.prior.T_world_drone[0], atol=1e-6)
    np.testing.assert_allclose(
        smoothed.corrected.T_world_drone[:, 2, :3], estimate.corrected.T_world_drone[:, 2, :3], atol=1e-9
    )
    assert len(smoothed.segments) > 20
    assert len(smoothed.points) > 1000
    assert smoothed.unsure == ""
    assert smoothed.thickness == pytest.approx(1 / 12, abs=0.03)
    assert smoothed.pose_covariance.shape == (len(smoothed.corrected), 6, 6)
    assert smoothed.axis_covariance.shape == (len(smoothed.segments), 4, 4)


def test_another_frame_gives_the_same_path_and_a_reason_where_covariances_fail(flown, smoothed, monkeypatch):
    def fail(*_):
        raise InputError("covariance of pose 3 is singular: nothing holds it along 1.00 z")

    flight, _, estimate = flown
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0, 0, 2.0]).as_matrix(), [30.0, -20.0, 0.0]
    turned = [Trajectory(each.stamp_s, T @ each.T_world_drone) for each in (flight.prior, estimate.corrected)]
    monkeypatch.setattr(smoothing, "marginals", fail)
    found = smooth(replace(flight, prior=turned[0]), replace(estimate, prior=turned[0], corrected=turned[1]))
    assert found.unsmoothed == ""
    assert "pose 3" in found.unsure
    assert found.pose_covariance is None
    back = (found.corrected.position - T[:3, 3]) @ T[:3, :3]
    assert np.linalg.norm(back - smoothed.corrected.position, axis=1).max() < 0.015  # other voxels, a few other bars


@pytest.mark.parametrize(("height_m", "says"), [(0.0, "ridges"), (-100.0, "without a return above the floor")])
def test_a_flight_without_bars_comes_back_as_it_was(flown, height_m, says):
    flight, _, estimate = flown
    if height_m < 0:
        prior = flight.prior.moved(np.array([0.0, 0.0, height_m]))
        flight, given = replace(flight, prior=prior), replace(estimate, corrected=prior)
    else:  # a few returns alone
        scans = [replace(scan, points=scan.points[:2, :2] * 0 + [2.0, 0.0, 1.0]) for scan in flight.scans]
        flight, given = replace(flight, scans=scans), estimate
    found = smooth(flight, given)
    assert says in found.unsmoothed
    assert found.corrected is given.corrected


def test_a_made_up_flight_comes_back_to_the_truth():
    """Poses and bars are off by millimetres, sections by a degree; the increments of the prior are noisy."""
    T, bars, observed = made_up(1, 0.002)
    rng = np.random.default_rng(2)
    stamp_s = 0.2 * np.arange(len(T))
    prior = T.copy()
    prior[1:, :3, 3] += np.cumsum(rng.normal(scale=0.001, size=(len(T) - 1, 3)), axis=0)
    shifted = bars.segments.start + rng.normal(scale=0.004, size=(6, 3)), bars.segments.end
    segments = Segments(*shifted, bars.segments.count, bars.segments.radius)
    wrong = replace(bars, segments=segments, turn=bars.turn + 0.02, flange=bars.flange + 0.002)
    state = problem.start(prior, prior, wrong)
    for _ in range(8):
        state = solver.improve(state, factors.linearised(state, observed), prior, stamp_s)
    before, after = (np.linalg.norm((each - T)[:, :3, 3], axis=1).mean() for each in (prior, state.T_world_sensor))
    assert after < 0.15 * before
    assert np.abs(state.bars.flange - bars.flange).max() < 0.004
    np.testing.assert_allclose(state.T_world_sensor[0], T[0], atol=1e-9)


@pytest.mark.parametrize("thickness", [0.06, 0.12])
def test_the_thickness_is_found_though_a_section_is_wrong(thickness):
    """The inner faces of two posts and a beam are in view. The other beam is fitted the wrong way round."""
    T, bars, observed = made_up(0, 0.001, scans=80, thickness=thickness)
    wrong = replace(bars, turn=np.add(bars.turn, [0, 0, 0, 0, np.pi, 0]), thickness=THICKNESS)
    state = problem.start(T, T, wrong)
    for _ in range(4):
        state = solver.improve(state, factors.linearised(state, observed), T, 0.2 * np.arange(len(T)))
    assert state.bars.thickness == pytest.approx(thickness, abs=0.006)


@pytest.mark.parametrize("noise_m", [0.005, 0.03])
def test_the_range_noise_is_taken_from_the_residuals(noise_m):
    T, bars, observed = made_up(3, noise_m)
    state = problem.start(T, T, bars)
    for _ in range(3):
        state = solver.improve(state, factors.linearised(state, observed), T, 0.2 * np.arange(len(T)))
    sigma_m = range_sigma_m(np.linalg.norm(observed.point, axis=1))
    assert state.sigma_ratio == pytest.approx(np.median(noise_m / sigma_m), rel=0.15)
