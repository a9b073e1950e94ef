"""Odometry by front faces, on scans of a small tower and on a short flight."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment, odometry
from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.metrics import position_error_m
from steelnb.odometry import CloudOdometry, FaceOdometry, faces, make_odometry
from steelnb.odometry.faces import ADOPT_S
from steelnb.odometry.scan_to_bars import Locator, points_in_range
from steelnb.settings import ExperimentSettings, OdometrySettings, StructureSettings
from tests.fusion.made import around, small_tower

REFIT_S = 4.0


@pytest.fixture(scope="module", autouse=True)
def often():
    """Adjust keyframes more often, since flights are short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faces, "REFIT_S", REFIT_S)
        yield


@pytest.fixture(scope="module")
def world():
    """A flight of 30 s, corrected with keyframes adjusted every few seconds."""
    settings = ExperimentSettings.preset("loops", "random-walk+yaw-random-walk", "faces", seed=11, duration_s=30.0)
    flight, truth = experiment.simulate(settings)
    estimator = make_odometry(settings.odometry, flight.T_drone_sensor)
    return flight, truth, estimator, odometry.run(flight, estimator)


def moved(flight: Flight, T: np.ndarray) -> Flight:
    """The same flight in another world frame."""
    return replace(flight, prior=Trajectory(flight.prior.stamp_s, T @ flight.prior.T_world_drone))


def test_it_is_nearer_to_the_truth_than_the_odometry_that_it_starts_from(world):
    flight, truth, _, found = world
    before = odometry.run(flight.first(100), CloudOdometry(OdometrySettings.preset("best"), flight.T_drone_sensor))
    late = flight.prior.stamp_s[:100] > 2 * REFIT_S
    ours, clouds, drift = (
        np.sqrt((position_error_m(path, truth.trajectory)[:100][late] ** 2).mean())
        for path in (found.corrected, before.corrected, flight.prior)
    )
    assert ours < 0.7 * clouds < 0.1 * drift
    assert not any(found.reason[1:])


def test_most_scans_are_registered_to_front_faces_after_the_first_adjustment(world):
    flight, _, estimator, found = world
    by_clouds = found.seconds["prepare"] > 0
    adopted_s = REFIT_S + ADOPT_S
    assert by_clouds[flight.prior.stamp_s <= adopted_s][1:].all()
    assert by_clouds[flight.prior.stamp_s > adopted_s + 0.1].mean() < 0.2
    refits = np.flatnonzero(found.seconds["refit"])
    np.testing.assert_allclose(flight.prior.stamp_s[refits], adopted_s + REFIT_S * np.arange(len(refits)), atol=0.1)
    assert len(refits) == 6
    assert len(estimator.keyframes.scans) + len(estimator._waiting) == 30
    assert len(found.segments) > 10
    assert len(found.points) > 1000
    first = flight.prior.T_world_drone[0] @ flight.T_drone_sensor  # where drift begins
    np.testing.assert_allclose(estimator.keyframes.T_world_sensor[0], first, atol=1e-5)


def test_what_is_put_out_follows_an_adjustment_in_steps_of_the_drift(world):
    flight = world[0]
    estimator = FaceOdometry(world[2].settings, flight.T_drone_sensor)
    estimator._lag = np.array([0.0, 0.05, 0.0, 0.0])
    plain = FaceOdometry(world[2].settings, flight.T_drone_sensor)
    for k in range(8):
        scan, prior = flight.scans[k], flight.prior.T_world_drone[k]
        behind = estimator.update(scan, prior).T_world_drone[:3, 3] - plain.update(scan, prior).T_world_drone[:3, 3]
        np.testing.assert_allclose(behind, max(0.0, 0.05 - 0.01 * (k + 1)) * np.eye(3)[0], atol=1e-9)


def test_the_answer_does_not_depend_on_the_frame_of_the_world(world):
    flight, _, estimator, found = world
    T = np.eye(4)
    T[:2, 3] = 31.0, -17.0
    T[:3, :3] = Rotation.from_rotvec([0, 0, 0.5 * np.pi]).as_matrix()
    part = moved(flight, T).first(80)  # two adjustments
    elsewhere = odometry.run(part, FaceOdometry(estimator.settings, flight.T_drone_sensor))
    home = np.linalg.inv(T) @ elsewhere.corrected.T_world_drone
    apart = np.linalg.norm(home[:, :3, 3] - found.corrected.position[:80], axis=1)
    assert np.median(apart) < 0.003
    assert apart.max() < 0.05  # voxels lie otherwise


def test_scans_of_nothing_follow_the_prior_and_those_without_stamps_come_at_the_usual_rate(world):
    flight, poses = world[0].first(41), []
    estimator = FaceOdometry(world[2].settings, flight.T_drone_sensor)
    for k, (scan, prior) in enumerate(zip(flight.scans, flight.prior.T_world_drone, strict=True)):
        step = estimator.update(scan.points if k < 36 else np.full_like(scan.points, np.nan), prior)
        poses.append(step.T_world_drone[:3, 3])
        assert step.used == (0 < k < 36)
    assert estimator.faces is not None
    np.testing.assert_allclose(np.diff(poses[35:], axis=0), np.diff(flight.prior.position[35:], axis=0), atol=0.012)


def test_bars_that_lie_elsewhere_do_not_lead_a_scan_astray(world):
    flight, _, estimator, _ = world
    settings = estimator.settings
    ours, clouds = (kind(settings, flight.T_drone_sensor) for kind in (FaceOdometry, CloudOdometry))
    poses = []
    for k in range(41):
        scan, prior = flight.scans[k], flight.prior.T_world_drone[k]
        if k == 40:  # all bars are shifted by 5 cm: near enough to be matched, too far to be the drift's doing
            assert ours.faces is not None
            bars, away = ours.faces.bars, np.array([0.05, 0.0, 0.0])
            segments = replace(bars.segments, start=bars.segments.start + away, end=bars.segments.end + away)
            assert not ours.faces.fit(*_points_and_start(ours, scan, prior)).reason
            before = ours.faces
            ours.faces = Locator(replace(bars, segments=segments), before.stamp_s, before.ratio)
            ours.faces.variance = before.variance
            assert not ours.faces.fit(*_points_and_start(ours, scan, prior)).reason
        poses.append([odometry.update(scan, prior).T_world_drone[:3, 3] for odometry in (ours, clouds)])
    apart = np.linalg.norm(np.diff(poses, axis=1)[:, 0], axis=1)
    assert apart[40] < 0.03


def test_points_on_unknown_structure_are_no_reason_to_refuse_a_scan_but_free_directions_are(world):
    flight, _, estimator, _ = world
    scan, prior = flight.scans[-1], flight.prior.T_world_drone[-1]
    points, T = _points_and_start(estimator, scan, prior)
    bars, variance = estimator.faces.bars, estimator.faces.variance

    def located(kept, variance=variance):
        some = Locator(bars.take(kept), ratio=estimator.faces.ratio)
        some.variance = variance
        return some.fit(points, T), some._matched(points, T)[1].sum() / len(points)

    every = np.ones(len(bars.turn), dtype=bool)
    whole, _ = located(every)
    assert not whole.reason
    some, share = located(np.arange(len(every)) % 2 == 0)
    assert not some.reason
    assert share < 0.4
    assert np.linalg.norm(some.T_world_sensor[:3, 3] - whole.T_world_sensor[:3, 3]) < 0.01
    assert "mm" in located(np.abs(bars.segments.direction[:, 2]) > 0.9, np.full(4, 0.05**2))[0].reason


def _points_and_start(estimator, scan, prior):
    T = estimator.prediction.pose(prior, scan.stamp_s) @ estimator.T_drone_sensor
    return points_in_range(scan, T, 6.0, 0.3, 2000), T


def test_scans_from_afar_are_registered_too():
    """With few points on each bar, the position is known to 5 to 10 mm, which is better than by clouds."""

    def error_m(estimate):
        return position_error_m(estimate.corrected, truth.trajectory)[late].mean()

    settings = ExperimentSettings.preset("loops", "random-walk", "faces", seed=11, duration_s=24.0)
    settings = settings.override({"flight.standoff_m": 3.4})
    flight, truth = experiment.simulate(settings)
    estimator = make_odometry(settings.odometry, flight.T_drone_sensor)
    found = odometry.run(flight, estimator)
    late = flight.prior.stamp_s > 15
    assert (found.seconds["prepare"] > 0)[late].mean() < 0.3
    assert estimator.faces.variance[-3:].max() > 0.004**2
    clouds = odometry.run(flight, CloudOdometry(OdometrySettings.preset("best"), flight.T_drone_sensor))
    assert error_m(found) < 0.8 * error_m(clouds)


def test_a_flight_without_bars_is_that_of_the_odometry_by_clouds(monkeypatch):
    monkeypatch.setattr(faces, "REFIT_S", 2.0)
    flight = around(small_tower(), poses=20)
    rng = np.random.default_rng(5)
    leaves = [Scan(scan.stamp_s, rng.uniform((1.5, -1, -1), (3.5, 1, 1), (4000, 3))) for scan in flight.scans]
    flight = replace(flight, scans=leaves)
    settings = OdometrySettings.preset("faces")
    ours = odometry.run(flight, FaceOdometry(settings))
    clouds = odometry.run(flight, CloudOdometry(settings))
    np.testing.assert_array_equal(ours.corrected.T_world_drone, clouds.corrected.T_world_drone)


def test_the_number_of_keyframes_is_bounded(monkeypatch):
    monkeypatch.setattr(faces, "KEYFRAMES_MAX", 20)
    monkeypatch.setattr(faces, "RECENT", 5)
    kept = faces.Keyframes(StructureSettings())
    for k in range(21):
        T = np.eye(4)
        T[0, 3] = k
        kept.add(Scan(0.2 * k, np.full((4, 4, 3), np.nan)), np.zeros((0, 3)), T, T)
    places = kept.T_world_sensor[:, 0, 3].tolist()
    assert places == [0, 2, 4, 6, 8, 10, 12, 14, 15, 16, 17, 18, 19, 20]
    assert [scan.stamp_s for scan in kept.scans] == pytest.approx([0.2 * place for place in places])
    assert kept.adjust() is None  # nothing was seen


def test_keyframes_of_an_exact_sensor_are_adjusted_where_their_poses_are_off():
    flight = around(small_tower(), poses=24)
    true, rng = flight.prior.T_world_drone, np.random.default_rng(3)
    kept = faces.Keyframes(StructureSettings())
    for k, scan in enumerate(flight.scans):
        kept.add(scan, points_in_range(scan, true[k], 6.0, 0.2, 4000), true[k], true[k])
    assert kept.adjust() is not None  # and the noise is known to be next to nothing
    kept.T_world_sensor = true.copy()
    kept.T_world_sensor[1:, :3, 3] += rng.normal(scale=0.006, size=(len(true) - 1, 3))
    before, _ = np.linalg.norm((kept.T_world_sensor - true)[1:, :3, 3], axis=1), kept.adjust()
    after = np.linalg.norm((kept.T_world_sensor - true)[1:, :3, 3], axis=1)
    assert np.median(after) < 0.3 * np.median(before)
