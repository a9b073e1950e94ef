"""Ranges corrected by a measured scale and offset, and the measurement in front of a wall."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core import rng
from steelnb.core.errors import InputError
from steelnb.core.types import Flight, RangeScans, Scan, Trajectory
from steelnb.fusion.adjustment.smooth import with_range_sigmas
from steelnb.points.ranges import calibrated
from steelnb.settings import ExperimentSettings, StructureSettings, TofSettings
from steelnb.settings.world import fitted_calibration
from steelnb.simulation.tof import DISTANCES_M, measure_calibration
from steelnb.simulation.tof_faults import draw_faults

SCALE, OFFSET_M = 1.004, -0.006
TOLD = TofSettings(range_scale=SCALE, range_offset_m=OFFSET_M, range_scale_sigma=0.001, range_offset_sigma_m=0.002)


def flight(scans):
    poses = Trajectory(np.arange(len(scans)) * 0.2, np.tile(np.eye(4), (len(scans), 1, 1)))
    return Flight(scans, poses, np.eye(4))


def images(range_m):
    ray = np.random.default_rng(1).normal(size=(3, 4, 3))
    return RangeScans(np.arange(len(range_m)) * 0.2, range_m, ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def test_corrected_ranges_are_the_true_ones_of_images_and_of_clouds():
    true_m = np.random.default_rng(2).uniform(0.3, 6.0, (2, 3, 4))
    true_m[0, 0, 0] = np.nan
    reported = images((SCALE * true_m + OFFSET_M).astype(np.float32))
    for given in (flight(reported), flight([reported[k] for k in range(2)])):
        found = calibrated(given, TOLD)
        assert found.range_sigmas == (0.001, 0.002)
        for k, scan in enumerate(found.scans):
            np.testing.assert_allclose(np.linalg.norm(scan.points, axis=-1), true_m[k], atol=1e-6)
            away = scan.points / np.linalg.norm(scan.points, axis=-1, keepdims=True)
            np.testing.assert_allclose(away[~np.isnan(true_m[k])], reported.ray[~np.isnan(true_m[k])], atol=1e-6)
        assert len(found.scans[:1]) == 1
        np.testing.assert_array_equal(found.scans[:1][0].points, found.scans[0].points)


def test_without_a_calibration_the_flight_is_the_same_object_and_zeros_stay_no_returns():
    given = flight([Scan(0.0, np.array([[0.0, 0, 0], [0.001, 0, 0], [2.0, 0, 0]]))])
    assert calibrated(given, TofSettings()) is given
    points = calibrated(given, TofSettings(range_offset_m=0.01)).scans[0].points
    assert np.isnan(points[:2]).all()
    assert points[2, 0] == pytest.approx(1.99)


def test_a_wall_tells_scale_and_offset_to_their_standard_deviations():
    tof, off = TofSettings.preset("starling2-honest"), []
    for seed in range(40):
        told, faults = measure_calibration(tof, seed), draw_faults(tof, rng.stream(seed, "tof-camera"))
        off.append([
            (told["tof.range_scale"] - 1 - faults.scale_error) / told["tof.range_scale_sigma"],
            (told["tof.range_offset_m"] - faults.offset_m) / told["tof.range_offset_sigma_m"],
        ])  # fmt: skip
        assert 0.0003 < told["tof.range_scale_sigma"] < 0.0015
    assert (np.abs(off).max(axis=0) < 3.5).all()
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.5).all()
    exact = fitted_calibration(DISTANCES_M, SCALE * DISTANCES_M + OFFSET_M)
    assert exact["tof.range_scale"] == pytest.approx(SCALE)
    assert exact["tof.range_offset_m"] == pytest.approx(OFFSET_M)


@pytest.mark.parametrize(
    ("distance_m", "range_m"),
    [
        ([1, 2], [1, 2]),
        ([1, 1, 1], [1, 1, 1.1]),
        ([1, 2, 3], [1, 2]),
        ([1, 2, np.nan], [1, 2, 3]),
        ([0, 1, 2], [0, 1, 2]),
        ([1, 2, 3], [1000, 2000, 3000]),
        ([1000, 2000, 3000], [1, 2, 3]),
    ],
)
def test_a_calibration_needs_three_distances_in_the_unit_of_the_ranges(distance_m, range_m):
    with pytest.raises(InputError):
        fitted_calibration(distance_m, range_m)


def test_sigmas_of_a_calibration_stretch_the_path_from_its_first_pose():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [[1.0, 0, 0], [4.0, 0, 0], [1.0, 0, 10.0]]
    scans = [Scan(float(k), np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])) for k in range(3)]
    flight = Flight(scans, Trajectory(np.arange(3.0), T), np.eye(4), range_sigmas=(0.003, 0.004))
    found = with_range_sigmas(np.zeros((3, 6, 6)), flight, T, StructureSettings(floor_m=-9.0, range_max_m=4.0))
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(found, axis1=1, axis2=2))[:, :3], [[0, 0, 0], [0.015, 0, 0], [0, 0, 0.05]]
    )
    assert not found[:, 3:, 3:].any()


def test_a_told_calibration_changes_estimates_but_not_the_flight():
    short = {"seed": 13, "duration_s": 1.0, "overrides": {"flight.still_s": 0.0}}
    settings = ExperimentSettings.preset("zigzag", "random-walk", "best", "starling2-honest", **short)
    told = settings.override(measure_calibration(settings.tof, 13))
    flown, truth = experiment.simulate(settings)
    again, _ = experiment.simulate(told)
    np.testing.assert_array_equal(again.scans.range_m, flown.scans.range_m)
    one, other = (experiment.world(each.replace(tof=each.tof.uncalibrated())) for each in (told, settings))
    assert one == other
    one, other = (experiment.estimate(each, flown, truth).corrected for each in (settings, told))
    assert not np.array_equal(one.T_world_drone, other.T_world_drone)
    assert flown.range_sigmas == (0.0, 0.0)
