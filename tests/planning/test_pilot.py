"""Flights steered by the estimate of the odometry."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core.errors import CollisionError, InputError
from steelnb.odometry import make_odometry, run
from steelnb.planning import OnboardPilot, Planner
from steelnb.settings import ExperimentSettings, FlightSettings
from steelnb.simulation import Command, OnboardSensors, build_tower, fly

NOISE = "random-walk+yaw-random-walk"
COARSE = {"tof.columns": 60, "tof.rows": 80}
"""A third of the pixels per axis, to save time."""


def steered(settings):
    """The pilot of a flight, and its true poses and exact IMU readings."""
    tower = build_tower(settings.tower)
    sensors = OnboardSensors(settings, tower)
    pilot = OnboardPilot(settings, sensors.imu)
    return pilot, fly(tower, settings.flight, settings.seed, sensors.steered_by(pilot))


@pytest.mark.parametrize("sensor", ["starling2", "starling2-honest"])
def test_scans_during_a_flight_equal_those_of_the_whole_flight_bit_for_bit(sensor):
    settings = ExperimentSettings.preset("planned", NOISE, "best", sensor, seed=3, duration_s=2.0, overrides=COARSE)
    pilot, (true, _) = steered(settings)
    flight, truth = experiment.simulate(settings)
    np.testing.assert_array_equal(true.T_world_drone, truth.trajectory.T_world_drone)
    estimate = run(flight, make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu))
    assert len(pilot.steps) == len(flight) == 10
    np.testing.assert_array_equal([step.stamp_s for step in pilot.steps], flight.prior.stamp_s)
    np.testing.assert_array_equal([step.T_world_drone for step in pilot.steps], estimate.corrected.T_world_drone)
    np.testing.assert_array_equal([step.matches for step in pilot.steps], estimate.matches)


@pytest.fixture(scope="module")
def around():
    """A quarter of the way around the tower: settings, pilot and true poses."""
    settings = ExperimentSettings.preset("planned", "random-walk", "best", seed=5, duration_s=12.0, overrides=COARSE)
    pilot, (true, _) = steered(settings)
    return settings, pilot, true


def test_a_planned_flight_goes_around_the_tower_and_sees_it_in_every_scan(around):
    _, pilot, true = around
    azimuth = np.unwrap(np.arctan2(true.position[:, 1], true.position[:, 0]))
    assert azimuth[-1] - azimuth[0] > np.pi / 2
    assert {decision.state for _, decision in pilot.decisions} == {"follow"}
    assert [step.reason for step in pilot.steps if not step.used] == ["first scan"]
    at = true.at(np.array([step.stamp_s for step in pilot.steps])).position
    assert np.linalg.norm([step.T_world_drone[:3, 3] for step in pilot.steps] - at, axis=1).max() < 0.1


def test_the_drone_follows_the_planner_s_velocities(around):
    _, pilot, true = around
    speed = np.gradient(true.position, 0.008, axis=0)
    asked, flown = [], []
    for stamp_s, decision in pilot.decisions[20:]:
        T = true.at(np.array([stamp_s])).T_world_drone[0]
        yaw = np.arctan2(T[1, 0], T[0, 0])
        forward, left, up = decision.velocity
        asked.append([np.cos(yaw) * forward - np.sin(yaw) * left, np.sin(yaw) * forward + np.cos(yaw) * left, up])
        flown.append(speed[round(stamp_s / 0.008)])
    # The controller has a delay of a few tenths of a second, and there are gusts.
    assert np.sqrt((np.subtract(asked, flown) ** 2).sum(axis=1).mean()) < 0.35


def test_the_path_depends_on_the_estimated_pose(around):
    settings, _, true = around
    drifting = settings.replace(noise_name="random-walk:0.02")
    _, (other, _) = steered(drifting)
    np.testing.assert_array_equal(other.position[0], true.position[0])
    assert np.abs(other.position - true.position).max() > 0.02


def test_a_planned_flight_reports_its_progress_and_is_the_same_again():
    settings = ExperimentSettings.preset("planned", "random-walk", "best", seed=2, duration_s=1.0, overrides=COARSE)
    shares = []
    a, b = (experiment.simulate(settings, shares.append)[1].trajectory.T_world_drone for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert shares[: len(shares) // 2] == sorted(shares[: len(shares) // 2])
    assert shares[-1] > 0.9


def test_a_pilot_that_ends_the_flight_ends_it():
    tower, calls = build_tower(), []

    def pilot(true, imu):
        calls.append(true.stamp_s[-1])
        return None if len(calls) > 3 else Command((0.0, 0.0, 0.2), 0.0)

    true, imu = fly(tower, FlightSettings.preset("planned", 5.0), 1, pilot)
    assert len(true) == len(imu.stamp_s)
    np.testing.assert_allclose(calls, [0.0, 0.104, 0.2, 0.304], atol=1e-9)
    assert true.stamp_s[-1] == pytest.approx(0.304)
    assert true.position[-1, 2] > true.position[0, 2]


def test_a_collision_with_the_ground_states_its_position():
    with pytest.raises(CollisionError, match=r"planned flight .* touches the structure or the ground at t = "):
        fly(build_tower(), FlightSettings.preset("planned", 20.0), 1, lambda true, imu: Command((0.0, 0.0, -1.0), 0.0))


def test_only_planned_flights_have_a_planner():
    with pytest.raises(InputError, match="trajectory 'loops': expected 'planned'"):
        Planner(FlightSettings.preset("loops"), 1.5, 6.0)
