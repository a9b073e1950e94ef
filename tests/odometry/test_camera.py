"""Landmarks in images as a term of the solve by clouds and bars."""

from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.metrics import position_error_m
from steelnb.odometry import CombinedOdometry, OrbOdometry, camera, make_odometry, run
from steelnb.odometry.tracking import LandmarkTracker
from steelnb.registration.solve import exp_about
from steelnb.settings import ExperimentSettings, OdometrySettings
from tests.odometry.conftest import Watched

SCANS = 14
SETTINGS = OdometrySettings.preset("combined-camera")


@pytest.fixture(scope="module")
def flight(loops_with_images):
    return loops_with_images[1].first(SCANS)


def poses(flight, odometry):
    return np.array([odometry.update(*given).T_world_drone for given in steps_of(flight)])


def steps_of(flight):
    return zip(flight.scans, flight.prior.T_world_drone, strict=True)


def test_without_images_it_is_combined(flight):
    blind = make_odometry(SETTINGS, flight.T_drone_sensor)
    combined = CombinedOdometry(OdometrySettings.preset("combined"), flight.T_drone_sensor)
    np.testing.assert_array_equal(poses(flight, blind), poses(flight, combined))


@pytest.mark.parametrize("share", [1e-9, 1e5])
def test_landmarks_of_no_share_leave_combined_s_answer_and_those_of_a_great_one_give_their_own(
    flight, monkeypatch, share
):
    monkeypatch.setattr(camera, "LANDMARK_SHARE", share)
    ours = poses(flight, make_odometry(SETTINGS, flight.T_drone_sensor, images=flight.images))[:, :3, 3]
    combined = poses(flight, CombinedOdometry(OdometrySettings.preset("combined"), flight.T_drone_sensor))[:, :3, 3]
    if share < 1:
        np.testing.assert_allclose(ours, combined, atol=1e-5)
    else:
        seen = OrbOdometry(OdometrySettings.preset("orb"), flight.T_drone_sensor, images=flight.images)
        by_landmarks = poses(flight, seen)[:, :3, 3]
        apart, away = (np.linalg.norm(ours - other, axis=1).mean() for other in (by_landmarks, combined))
        assert apart < 0.6 * away


def test_a_dozen_scans_stay_within_twelve_millimetres(loops_with_images, flight):
    found = run(flight, make_odometry(SETTINGS, flight.T_drone_sensor, images=flight.images))
    truth = loops_with_images[2].trajectory.at(flight.prior.stamp_s)
    assert not any(found.reason[1:])
    assert position_error_m(found.corrected, truth).max() < 0.012
    assert position_error_m(flight.prior, truth).max() > 0.03


def test_the_term_of_landmarks_is_the_slope_of_its_own_loss(flight):
    """Central differences of the loss by each of the six directions of a twist."""
    tracker = LandmarkTracker(flight.images, flight.T_drone_sensor, 6.0)
    for scan, T_prior in steps_of(flight.first(3)):
        image, pull = tracker.image_at(scan.stamp_s), lambda _: ([], np.zeros(3))
        tracked = tracker.track(tracker.find(image, scan.points), image.shape, T_prior, np.eye(6), pull)
        tracker.update(tracked, tracked.T_world_drone)
    assert tracked.matches > 40
    term, centre = tracker.term(tracked, 0.3), tracked.T_world_drone[:3, 3] + [1.0, 0.2, 0.1]
    T = exp_about(centre, np.array([2e-3, -1e-3, 3e-3, 0.01, -0.005, 0.004])) @ tracked.T_world_drone
    H, b, loss = term(T, centre)
    ahead, behind = ([term(exp_about(centre, step * e) @ T, centre)[2] for e in np.eye(6)] for step in (1e-6, -1e-6))
    np.testing.assert_allclose(b, np.subtract(ahead, behind) / 2e-6, atol=1e-4 * np.abs(b).max())
    assert loss > 0
    assert np.linalg.eigvalsh(H).min() > 0


def test_each_image_is_read_once(flight):
    watched = Watched(flight.images.images)
    odometry = make_odometry(SETTINGS, flight.T_drone_sensor, images=replace(flight.images, images=watched))
    poses(flight.first(4), odometry)
    assert watched.asked == [0, 1, 2, 3]


def test_an_honest_flight_is_corrected_with_the_imu_of_its_sensor():
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk:0.004", "combined-camera", "starling2-honest", seed=12, duration_s=8.0
    ).override({"camera.samples": 2})
    flight, truth = experiment.simulate(settings)
    odometry = make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu, flight.images)
    found = run(flight, odometry)
    up, true_up, told_up = (
        path.T_world_drone[5:, 2, :3]
        for path in (found.corrected, truth.trajectory.at(flight.prior.stamp_s), flight.prior)
    )
    assert position_error_m(found.corrected, truth.trajectory).mean() < 0.015
    assert position_error_m(flight.prior, truth.trajectory).mean() > 0.05
    assert np.arccos((up * true_up).sum(axis=1)).max() < 0.5 * np.arccos((told_up * true_up).sum(axis=1)).max()


@pytest.mark.parametrize("overrides", [{"clouds.bars_weight": 0.0}, {"refit_s": 10.0}])
def test_a_camera_belongs_to_clouds_and_bars_without_refits(overrides):
    with pytest.raises(InputError, match="'combined-camera': orb with clouds: expected bars_weight"):
        SETTINGS.override(overrides)
    with pytest.raises(InputError, match="'combined-camera': expected an odometry by features"):
        OrbOdometry(SETTINGS)
