from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.odometry import LoamOdometry, make_odometry, run
from steelnb.registration import FREE
from steelnb.settings import ExperimentSettings, OdometrySettings


@pytest.fixture(scope="module")
def world():
    settings = ExperimentSettings.preset("loops", sensor="starling2", seed=13, duration_s=2.8, method="loam")
    return experiment.simulate(settings)


def test_the_first_scan_is_mapped_as_it_is_and_scans_without_features_follow_the_prior(world):
    flight, _ = world
    odometry = make_odometry(OdometrySettings.preset("loam"), flight.T_drone_sensor)
    scans, prior = flight.scans[:3], flight.prior.T_world_drone
    assert odometry.update(scans[0], prior[0]).reason == "first scan"
    assert len(odometry.map_points()) > 100
    assert not len(odometry.map_segments())
    empty = odometry.update(np.full((240, 180, 3), np.nan), prior[1])
    assert empty.reason == "too few points"
    np.testing.assert_allclose(empty.T_world_drone, prior[1], atol=1e-12)
    assert odometry.update(scans[2], prior[2]).used


def test_a_wall_constrains_only_the_direction_of_its_normal():
    """Within the plane, the pose remains that of the prior."""
    ray = np.ones((40, 60, 3))
    ray[..., 1], ray[..., 2] = np.meshgrid(np.linspace(0.6, -0.6, 60), np.linspace(0.4, -0.4, 40))
    noise, prior = np.random.default_rng(1), np.tile(np.eye(4), (6, 1, 1))
    prior[:, 2, 3] = 3.0
    prior[:, :3, 3] += np.arange(6)[:, None] * [0.02, 0.01, 0.0]
    odometry = LoamOdometry()
    odometry.options = replace(odometry.options, free=FREE["xyz"])
    for T in prior:
        depth = 2.0 + noise.normal(0, 0.002, (40, 60, 1))  # the drone stands still, and the prior drifts
        found = odometry.update(depth * ray, T).T_world_drone
    assert abs(found[0, 3]) < 0.01
    assert found[1, 3] == pytest.approx(0.05, abs=0.04)


def test_clouds_of_a_spinning_lidar_are_sorted_into_their_lines():
    """A room seen by sixteen lasers from two positions, its points in random order."""
    noise = np.random.default_rng(1)
    elevation, azimuth = np.meshgrid(np.radians(np.arange(-15, 16, 2.0)), np.radians(np.arange(0, 360, 0.5)))
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    half = np.array([4.0, 3.0, 0.8])
    odometry = LoamOdometry(OdometrySettings.preset("loam", overrides={"preprocess.floor_m": -9.0}))
    for place in ([0.0, 0.0, 0.0], [0.1, -0.06, 0.04]):
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = ((np.sign(ray) * half - place) / ray).min(axis=1)
        points = ray * (reach + noise.normal(0, 0.003, len(ray)))[:, None]
        step = odometry.update(points[noise.permutation(len(points))], np.eye(4))
    assert step.used
    np.testing.assert_allclose(step.T_world_drone[:3, 3], [0.1, -0.06, 0.04], atol=0.02)


def test_poses_are_deterministic_and_do_not_depend_on_later_scans(world):
    settings, flight = OdometrySettings.preset("loam"), world[0]
    short, longer = (run(part, make_odometry(settings, flight.T_drone_sensor)) for part in (flight.first(10), flight))
    np.testing.assert_array_equal(short.corrected.T_world_drone, longer.corrected.T_world_drone[:10])
