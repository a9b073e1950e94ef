"""Self-calibration: its equations by differences, and the errors that a simulated flight finds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.fusion import sections, smooth
from steelnb.fusion.bar_equations import BAR, equations
from steelnb.fusion.poses import POSE, increments
from steelnb.fusion.sensor_errors import (
    RANGE,
    SensorEquations,
    TrueScans,
    true_flight,
    true_poses,
    unknown_errors,
    with_prior,
)
from steelnb.metrics import score_trajectory
from steelnb.points.ranges import true_points
from steelnb.settings import CalibrationSettings, ExperimentSettings
from steelnb.types import RangeScans, SensorErrors
from tests.fusion.test_bundle import residuals_of
from tests.fusion.test_smooth import made_up

TRUE = np.array([0.008, 0.02, 0.0, 0.0, 0.0, 0.0, np.radians(1), np.radians(-1), 0.0])


def test_the_equations_of_the_range_are_those_of_derivatives_by_differences():
    T, bars, seen = made_up(4, 0.0)
    found = equations(seen, T, bars, sections.outlines(bars.turn, bars.flange), 1.0, POSE, RANGE)
    compared = 0
    for p in range(0, len(seen.pair_scan), 7):
        ends = [
            [residuals_of(T, bars, seen._replace(point=true_points(seen.point.astype(float), *(sign * step))), p)
             for sign in (1, -1)] for step in 1e-4 * np.eye(RANGE)
        ]  # fmt: skip
        g = np.column_stack([(ahead[0] - behind[0]) / 2e-4 / ahead[1] for ahead, behind in ends])
        if np.isfinite(g).all():
            share = g.T @ g
            np.testing.assert_allclose(found.shares[p, BAR:, BAR:], share, atol=0.02 * np.abs(share).max())
            compared += 1
    assert compared > 5


def test_the_equations_of_mount_and_clock_are_those_of_derivatives_by_differences():
    rng, n, tilt_rad = np.random.default_rng(6), 6, 0.02
    prior = np.tile(np.eye(4), (n, 1, 1))
    prior[:, :3, 3] = np.cumsum(rng.normal(scale=0.3, size=(n, 3)), axis=0)
    prior[:, :3, :3] = Rotation.from_euler("xyz", rng.normal(scale=0.1, size=(n, 3))).as_matrix()
    stamp_s, none = 0.2 * np.arange(n), unknown_errors(CalibrationSettings())
    empty = SensorEquations(np.zeros((n, 6, RANGE)), np.zeros((0, RANGE)), np.zeros((RANGE, RANGE)), np.zeros(RANGE))

    def slopes(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        errors = replace(none, value=value)
        of_poses = increments(prior, true_poses(errors, prior, stamp_s), stamp_s, tilt_rad)[2]
        return of_poses, with_prior(empty, errors, prior, prior, stamp_s, tilt_rad).right

    found = with_prior(empty, none, prior, prior, stamp_s, tilt_rad)
    for c in range(len(TRUE)):
        step = 1e-5 * np.eye(len(TRUE))[c]
        poses, errors = ((a - b) / -2e-5 for a, b in zip(slopes(step), slopes(-step), strict=True))
        np.testing.assert_allclose(found.poses[1:, :, c], poses[1:], rtol=1e-3, atol=1e-2 * np.abs(poses[1:]).max())
        np.testing.assert_allclose(found.block[:, c], errors, rtol=1e-3, atol=1e-4 * np.abs(errors).max())


def test_the_true_sensor_is_where_its_mount_and_its_clock_say():
    T, stamp_s = np.tile(np.eye(4), (5, 1, 1)), 0.2 * np.arange(5)
    T[:, 0, 3] = 3.0 * stamp_s  # 3 m/s along x
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(stamp_s, [0, 0, 0.5])).as_matrix()
    late = SensorErrors(np.array([0, 0, 0, 0.1, 0, 0, 0, 0, 0.05]), np.eye(9), np.ones(9))
    found = true_poses(late, T, stamp_s)
    heading = 0.5 * (stamp_s + 0.05)
    np.testing.assert_allclose(found[:, 0, 3], 3.0 * (stamp_s + 0.05) - 0.1 * np.sin(heading), atol=1e-9)
    np.testing.assert_allclose(found[:, 1, 3], 0.1 * np.cos(heading), atol=1e-9)


def test_points_lose_the_errors_of_their_ranges():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4, 5, 3))
    range_m = np.linalg.norm(points, axis=2, keepdims=True)
    measured = points / range_m * (1.03 * range_m + 0.02)
    measured[0, 0] = np.nan
    found = true_points(measured, 0.02, 0.03)
    np.testing.assert_allclose(found[1:], points[1:], rtol=1e-12)
    assert np.isnan(found[0, 0]).all()


@pytest.fixture(scope="module")
def flown():
    """A flight of 12 s about the tower, told as `TRUE` has it wrong, and what odometry makes of it."""
    settings = ExperimentSettings.preset("loops", "random-walk", seed=11, duration_s=12.0, method="combined")
    flight, truth = experiment.simulate(settings)
    sensor, scans = SensorErrors(TRUE, np.eye(9), TRUE), flight.scans
    ranges = (scans.range_m * (1 + TRUE[1]) + TRUE[0]).astype(np.float32)
    told = replace(
        flight, scans=RangeScans(scans.stamp_s, ranges, scans.ray),
        T_drone_sensor=flight.T_drone_sensor @ np.linalg.inv(sensor.T_assumed_true),
    )  # fmt: skip
    return flight, told, truth, experiment.estimate(settings, told, truth)


@pytest.fixture(scope="module")
def calibrated(flown):
    _, told, _, estimate = flown
    return smooth(told, estimate, calibration=CalibrationSettings(time_sigma_s=0.0))


def test_a_flight_finds_the_errors_of_its_sensor(calibrated):
    found = calibrated.sensor_errors
    off = np.abs(found.value - TRUE)
    assert (off[:8] < 3.5 * found.sigma[:8]).all()
    assert off[0] < 0.003  # of 8 mm
    assert (off[5:8] < np.radians(0.3)).all()  # of 1°
    assert found.value[8] == pytest.approx(0.0, abs=1e-6)  # known


def test_what_the_flight_does_not_tell_keeps_its_standard_deviation(calibrated):
    """How high the sensor sits on a drone that turns about the vertical alone."""
    found = calibrated.sensor_errors
    assert found.sigma[4] > 0.95 * found.prior_sigma[4]
    assert (found.sigma < 1.001 * np.maximum(found.prior_sigma, 1e-8)).all()


def test_poses_are_those_of_the_true_sensor(flown, calibrated):
    flight, told, truth, estimate = flown
    plain, better = (
        score_trajectory(each.corrected, truth.trajectory)["ate_rmse_m"]
        for each in (smooth(told, estimate), calibrated)
    )
    assert better < 0.5 * plain
    true = true_flight(told, calibrated.sensor_errors)
    assert np.abs(true.T_drone_sensor - flight.T_drone_sensor).max() < 0.02
    assert isinstance(true.scans, TrueScans)
    before_m, after_m = (
        np.nanmedian(np.linalg.norm(each.scans[7].points - flight.scans[7].points, axis=-1)) for each in (told, true)
    )
    assert after_m < 0.5 * before_m
    assert len(true.scans[3:9:2]) == 3


def test_without_a_bar_nothing_is_found(flown):
    flight, _, _, estimate = flown
    blind = replace(flight, scans=RangeScans(flight.scans.stamp_s, flight.scans.range_m * np.nan, flight.scans.ray))
    found = smooth(blind, estimate, calibration=CalibrationSettings())
    assert found.sensor_errors is None
    assert found.unsmoothed
