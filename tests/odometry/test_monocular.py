"""Landmarks triangulated from images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.images import CameraImages, project
from steelnb.metrics import position_error_m
from steelnb.odometry import make_odometry, run
from steelnb.odometry.features import Features
from steelnb.odometry.monocular import MonocularTracker
from steelnb.settings import CameraSettings, OdometrySettings
from steelnb.types import Scan

K = CameraSettings.preset().K
SETTINGS = OdometrySettings.preset("orb-monocular")


@pytest.fixture
def tracker():
    images = CameraImages(np.zeros(1), [np.zeros((320, 422), np.uint8)], K, np.eye(4))
    return MonocularTracker(images, np.eye(4), 6.0)


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", yaw).as_matrix(), (x, y, z)
    return T


def features(points, T_world_camera, noise_px=0.0, seed=1):
    seen = project((points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3], K)
    seen = seen + noise_px * np.random.default_rng(seed).normal(size=seen.shape)
    count = len(points)
    return Features(seen, np.zeros(count, int), np.zeros((count, 4), np.uint64), np.full(count, np.nan))


def cloud(count=60):
    return np.random.default_rng(0).uniform([1.5, -0.8, -0.6], [3.0, 0.8, 0.6], (count, 3))


def test_rays_of_two_poses_meet_at_the_landmarks(tracker):
    points, first, second = cloud(), pose(), pose(0.1, 0.5, 0.1, yaw=-0.2)
    tracker._triangulate(features(points, first), first, features(points, second), second)
    np.testing.assert_allclose(tracker.map.point, points, atol=1e-9)


def test_their_information_is_that_of_their_errors(tracker):
    """The mean square of errors in the metric of the information is three, one a direction."""
    points, first, second = np.repeat([[2.0, 0.1, -0.2]], 400, axis=0), pose(), pose(0.1, 0.5, 0.1, yaw=-0.2)
    tracker._triangulate(features(points, first, 0.5, 1), first, features(points, second, 0.5, 2), second)
    error = (tracker.map.point - points[0]) / 0.5
    square = np.einsum("ni,nij,nj->n", error, tracker.map.information, error)
    assert len(error) > 300
    assert square.mean() == pytest.approx(3.0, rel=0.15)


def test_what_was_mismatched_or_seen_under_too_small_an_angle_is_no_landmark(tracker):
    points, first, second = cloud(), pose(), pose(0.0, 0.5)
    wrong = features(points, second)._replace(pixel=features(points, second).pixel + np.array([0.0, 12.0]))
    tracker._triangulate(features(points, first), first, wrong, second)
    assert len(tracker.map) == 0
    near = pose(0.0, 0.1)  # 0.07 rad at 1.5 m
    tracker._triangulate(features(points, first), first, features(points, near), near)
    assert len(tracker.map) == 0
    mirrored = 2 * features(points, first).pixel - features(points, second).pixel  # rays meet behind both cameras
    tracker._triangulate(features(points, first), first, wrong._replace(pixel=mirrored), second)
    assert len(tracker.map) == 0


def test_sightings_refine_a_landmark(tracker):
    points, first, second = cloud(), pose(), pose(0.0, 0.5)
    tracker._triangulate(features(points, first, 0.5, 1), first, features(points, second, 0.5, 2), second)
    true = points[np.linalg.norm(tracker.map.point[:, None] - points, axis=2).argmin(axis=1)]
    before, known = np.linalg.norm(tracker.map.point - true, axis=1), tracker.map.information.copy()
    for k in range(12):
        T = pose(0.0, 0.5 + 0.1 * k, yaw=-0.04 * k)
        tracker._refine(np.arange(len(true)), features(true, T, 0.5, 3 + k), T)
    after = np.linalg.norm(tracker.map.point - true, axis=1)
    assert after.mean() < 0.5 * before.mean()
    assert np.linalg.eigvalsh(tracker.map.information - known).min() > 0


def test_a_short_flight_is_followed_without_any_range(loops_with_images):
    _, flight, truth = loops_with_images
    flight = flight.first(20)
    found = run(flight, make_odometry(SETTINGS, flight.T_drone_sensor, images=flight.images))
    assert position_error_m(found.corrected, truth.trajectory.at(flight.prior.stamp_s)).max() < 0.2
    assert np.median(found.matches[8:]) > 20
    assert len(found.points) > 50
    blind = make_odometry(SETTINGS, flight.T_drone_sensor, images=flight.images)
    none = np.full((4, 4, 3), np.nan)
    again = [
        blind.update(Scan(scan.stamp_s, none), T).T_world_drone
        for scan, T in zip(flight.scans, flight.prior.T_world_drone, strict=True)
    ]
    np.testing.assert_array_equal(again, found.corrected.T_world_drone)
