"""What is replayed: drift at 125 Hz whatever the recording's rate, gaps, frames of the truth, points at the sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.config import NoiseSettings
from steelnb.datatypes import Scan, Trajectory
from steelnb.errors import RecordingError, SettingsError
from steelnb.noise import drifting
from steelnb.recordings.recording import interpolate
from steelnb.replay.course import STEP_S, Returns, course_of, with_drift, without_zeros
from tests.replay.flights import lattice, made, straight

WALK = NoiseSettings.parse("random-walk:0.002")


def test_drift_of_the_simulators_rate_is_the_simulators_to_the_bit():
    true = straight(np.arange(501) * STEP_S)
    found = with_drift(true, WALK, 7, 0.5)
    np.testing.assert_array_equal(found.T_world_drone, drifting(true, WALK, 7).T_world_drone)


@pytest.mark.parametrize("rate_hz", [5.0, 30.0, 200.0])
def test_the_same_noise_is_the_same_drift_at_every_rate(rate_hz):
    fine = straight(np.arange(1001) * STEP_S)
    coarse = straight(np.arange(round(8.0 * rate_hz) + 1) / rate_hz)
    at_s = np.arange(0, 8.0, 0.2)
    expected, found = (interpolate(with_drift(t, WALK, 7, 0.5), at_s, 0.5)[0] for t in (fine, coarse))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[-1, :3, 3] - straight(at_s).position[-1]).max() > 0.01


def test_drift_goes_on_over_a_gap_and_the_gap_stays_one():
    true = straight(np.concatenate([np.arange(0, 2, 0.1), np.arange(5, 8, 0.1)]))
    found = with_drift(true, WALK, 7, 0.5)
    assert not ((found.stamp_s > 1.91) & (found.stamp_s < 4.99)).any()
    whole = with_drift(straight(np.arange(0, 8, 0.1)), WALK, 7, 0.5)
    np.testing.assert_allclose(found.T_world_drone, whole.at(found.stamp_s).T_world_drone, atol=1e-9)


def test_poses_over_years_are_refused_before_they_fill_the_memory():
    with pytest.raises(RecordingError, match="less than four hours"):
        with_drift(straight(np.array([0.0, 1e9])), WALK, 7, 0.5)


def test_without_truth_and_noise_nothing_is_said_of_errors():
    course = course_of(made(lambda k: lattice(np.random.default_rng(k))))
    assert course.truth is None
    assert course.notes == ("no truth: nothing is said of errors",)


def test_noise_without_truth_takes_the_poses_as_true():
    recording = made(lambda k: lattice(np.random.default_rng(k)))
    course = course_of(recording, WALK, seed=2)
    assert course.truth is not None
    np.testing.assert_allclose(course.truth.T_world_drone, recording.poses.T_world_drone, atol=1e-12)
    assert np.linalg.norm(course.flight.prior.position[-1] - course.truth.position[-1]) > 0.005
    assert "taken as true" in course.notes[0]


def test_noise_goes_onto_the_truth_and_not_onto_drifting_poses():
    stamp_s = 0.2 * np.arange(8)
    wrong = straight(stamp_s, speed_m_s=0.4)
    recording = made(lambda k: lattice(np.random.default_rng(k)), poses=wrong, truth=straight(stamp_s))
    none = NoiseSettings()
    np.testing.assert_allclose(course_of(recording, none).flight.prior.position, straight(stamp_s).position, atol=1e-9)
    np.testing.assert_array_equal(course_of(recording).flight.prior.position, wrong.position)


def test_true_poses_do_not_drift_and_that_is_said():
    recording = made(lambda k: lattice(np.random.default_rng(k)), facts={"poses": "true poses, /ground_truth"})
    recording = replace(recording, truth=recording.poses)
    assert "--noise" in course_of(recording).notes[0]
    assert course_of(recording, WALK).notes == ()


def test_truth_in_another_frame_is_moved_onto_the_first_pose_and_said():
    stamp_s = 0.2 * np.arange(8)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("z", 70, degrees=True).as_matrix(), (40.0, -3.0, 1.0)
    true = straight(stamp_s)
    recording = made(lambda k: lattice(np.random.default_rng(k)), truth=Trajectory(stamp_s, turn @ true.T_world_drone))
    course = course_of(recording)
    np.testing.assert_allclose(course.truth.T_world_drone, true.T_world_drone, atol=1e-9)
    assert "different frames" in course.notes[0]
    assert "70.0°" in course.notes[0]


def test_truth_that_covers_a_part_judges_that_part():
    stamp_s = 0.2 * np.arange(8)
    recording = made(lambda k: lattice(np.random.default_rng(k)), truth=straight(stamp_s[2:6]))
    course = course_of(recording)
    np.testing.assert_array_equal(course.truth.stamp_s, stamp_s[2:6])
    assert "covers 4 of 8 scans" in course.notes[0]
    course = course_of(replace(recording, truth=straight(stamp_s[:1])))
    assert course.truth is None


def test_poses_that_do_not_cover_the_scans():
    recording = made(lambda k: lattice(np.random.default_rng(k)), poses=straight(100 + 0.2 * np.arange(8)))
    with pytest.raises(RecordingError, match=r"0\.000 to 1\.400 s of scans, 100\.000 to 101\.400 s of poses"):
        course_of(recording)
    part = made(lambda k: lattice(np.random.default_rng(k)), poses=straight(0.2 * np.arange(5)))
    assert len(course_of(part).flight.prior) == 5
    assert part.skipped["no pose within the gap"] == 3


@pytest.mark.parametrize("gap", [0.0, -1.0, np.nan, np.inf])
def test_gaps_that_bound_nothing_are_refused(gap):
    with pytest.raises(SettingsError, match="gap"):
        course_of(made(lambda k: np.zeros((0, 3))), gap_max_s=gap)


def test_points_at_the_sensor_are_no_returns():
    points = np.array([[1.0, 2, 3], [0, 0, 0], [0, 1, 0], [np.nan] * 3])
    scan = Scan(0.0, points)
    found = without_zeros(scan).points
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), [False, True, False, True])
    np.testing.assert_array_equal(found[0], points[0])
    np.testing.assert_allclose(found[2], points[2], atol=1e-8)
    assert points[1].tolist() == [0, 0, 0]  # the source's own array is left alone
    clean = Scan(0.0, points[:1])
    assert without_zeros(clean) is clean
    some = Returns([clean, scan])[1:]
    assert np.isnan(next(iter(some)).points[1]).all()
