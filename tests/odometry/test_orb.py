"""Visual odometry: features and depths, the pose of sightings, and a short flight."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.types import project
from steelnb.odometry import OrbOdometry, make_odometry, run
from steelnb.odometry.orb import LandmarkMap, solve_pose
from steelnb.odometry.orb_features import DepthImage, Features, find_features, import_opencv, match
from steelnb.registration import FREE
from steelnb.settings import CameraSettings, ExperimentSettings, TofSettings
from steelnb.simulation import FORWARD, camera
from steelnb.simulation.camera import intrinsics
from steelnb.simulation.raycasting import rays
from tests import naive

K = intrinsics(FORWARD)
SHAPE = (320, 422)
TOF = TofSettings.preset("starling2")
BLIND_S = (4.0, 4.5)


@pytest.fixture(scope="module")
def loops_with_images():
    """Six seconds of loops whose camera sees nothing for half of one; rendered images are kept."""
    settings = ExperimentSettings.preset("loops", "random-walk:0.004", "orb", seed=12, duration_s=6.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera, "SAMPLES", 2)
        flight, truth = experiment.simulate(settings)
        number = [flight.images.at(stamp_s) for stamp_s in flight.prior.stamp_s]
        dark = np.zeros((FORWARD.rows, FORWARD.columns), np.uint8)
        blind = (flight.prior.stamp_s >= BLIND_S[0]) & (flight.prior.stamp_s < BLIND_S[1])
        images = [dark if is_blind else flight.images.images[k] for k, is_blind in zip(number, blind, strict=True)]
    return settings, replace(flight, images=replace(flight.images, stamp_s=flight.prior.stamp_s, images=images)), truth


@pytest.fixture(scope="module")
def estimate(loops_with_images):
    settings, flight, _ = loops_with_images
    return run(flight, make_odometry(settings.odometry, flight.T_drone_sensor, images=flight.images))


def test_a_short_flight_stays_within_twelve_millimetres(loops_with_images, estimate):
    _, flight, truth = loops_with_images
    lit, after = flight.prior.stamp_s < BLIND_S[0], flight.prior.stamp_s >= BLIND_S[1]
    error, raw = (
        np.linalg.norm(path.position - truth.trajectory.at(path.stamp_s).position, axis=1)
        for path in (estimate.corrected, flight.prior)
    )
    assert np.sqrt(np.mean(error[lit] ** 2)) < 0.012
    assert np.sqrt(np.mean(raw[lit] ** 2)) > 0.05
    assert error[after].max() < 0.06  # the map is found again
    assert raw[after].min() > 0.06
    assert np.median(estimate.matches[1:][lit[1:]]) > 40
    assert len(estimate.points) > 500
    up = [path.T_world_drone[:, 2, :3] for path in (estimate.corrected, flight.prior)]
    np.testing.assert_allclose(*up, atol=1e-9)


def test_black_images_have_a_reason_and_follow_the_prior(loops_with_images, estimate):
    _, flight, _ = loops_with_images
    stamp_s = flight.prior.stamp_s
    dark = (stamp_s >= BLIND_S[0]) & (stamp_s < BLIND_S[1])
    assert dark.sum() == 3
    assert {reason for reason, is_dark in zip(estimate.reason, dark, strict=True) if is_dark} == {"too few features"}
    assert estimate.reason[0] == "first scan"
    assert not any(reason for reason in estimate.reason[23:])
    moved, prior = (np.diff(path.position[dark][1:], axis=0) for path in (estimate.corrected, flight.prior))
    np.testing.assert_allclose(moved, prior, atol=1e-9)


def test_no_image_after_the_scan_is_used_and_without_one_the_prior_is_followed(loops_with_images):
    settings, flight, _ = loops_with_images

    class Watched(list):
        def __getitem__(self, k):
            asked.append(k)
            return super().__getitem__(k)

    for shift_s in (0.0, 0.01, 10.0):
        asked, images = [], Watched(flight.images.images)
        late = replace(flight.images, stamp_s=flight.images.stamp_s + shift_s, images=images)
        odometry = OrbOdometry(settings.odometry, flight.T_drone_sensor, images=late)
        steps = [odometry.update(flight.scans[k], flight.prior.T_world_drone[k]) for k in range(4)]
        assert asked == ([] if shift_s else [0, 1, 2, 3])
        if shift_s:
            assert {step.reason for step in steps} == {"no image"}
            np.testing.assert_array_equal([step.T_world_drone for step in steps], flight.prior.T_world_drone[:4])


def wall(edge_m=None):
    """Points of an inclined wall 2 m ahead; its right half is ``edge_m`` farther away."""
    ray = rays(TOF)
    depth = 2.0 / (1.0 - 0.15 * ray[..., 1] / ray[..., 0])
    if edge_m:
        depth = np.where(ray[..., 1] < 0, depth + edge_m, depth)
    random = np.random.default_rng(2)
    noisy = depth + 0.01 * random.standard_normal(depth.shape)
    return noisy[..., None] * ray / ray[..., :1]


def test_only_smooth_surfaces_have_depths():
    place = np.random.default_rng(3).uniform([120, 60], [300, 260], (400, 2))
    flat = DepthImage(wall(), np.eye(4), K, SHAPE)
    exact = 2.0 / (1.0 + 0.15 * (place[:, 0] - K[0, 2]) / K[0, 0])
    depth = flat.depth_at(place)
    known = np.isfinite(depth)
    assert known.mean() > 0.85
    assert np.abs(depth - exact)[known].max() < 0.03
    assert flat.mask()[160, 211] == 255
    assert flat.mask()[160, 5] == 0
    points = wall().reshape(-1, 3)
    expected = naive.plane_depth(project(points, K), points[:, 0], place[known][:40], flat.radius_px)
    np.testing.assert_allclose(depth[known][:40], expected, rtol=1e-9)
    edge = DepthImage(wall(0.3), np.eye(4), K, SHAPE)
    depth, away_px = edge.depth_at(place), np.abs(place[:, 0] - K[0, 2])
    assert not np.isfinite(depth[away_px < 1.5]).any()
    assert np.isfinite(depth[away_px > 8]).mean() > 0.85


def test_a_match_has_the_nearest_descriptor_among_near_features():
    random = np.random.default_rng(5)
    pixel, expected = random.uniform(0, 60, (80, 2)), random.uniform(0, 60, (50, 2))
    octave, wanted_octave = random.integers(0, 3, 80), random.integers(0, 3, 50)
    depth, wanted_depth = random.uniform(1, 1.2, 80), random.uniform(1, 1.2, 50)
    depth[::3] = np.nan
    words = random.integers(0, 2**63, (12, 4)).astype(np.uint64)
    descriptor, wanted = words[random.integers(0, 12, 80)], words[random.integers(0, 12, 50)]
    flips = np.uint64(1) << random.integers(0, 40, (80, 4)).astype(np.uint64)
    arguments = (
        pixel, octave, descriptor ^ flips, depth, expected, wanted_octave, wanted_depth, wanted, 15.0, 60, 0.9,
    )  # fmt: skip
    found = match(*arguments)
    np.testing.assert_array_equal(found, naive.match_features(*arguments))
    assert 3 < np.count_nonzero(found >= 0) < 50
    assert len(set(found[found >= 0])) == np.count_nonzero(found >= 0)


def sightings(T_world_drone, T_drone_camera, outliers=0.0, seed=6):
    """Observations of landmarks, half of them with depth, some with the position of another landmark."""
    random = np.random.default_rng(seed)
    T = T_world_drone @ T_drone_camera
    point = random.uniform([1.0, -0.8, -0.6], [4.0, 0.8, 0.6], (120, 3)) * [1, 1.5, 1.5]
    pixel = project(point, K)
    wrong = random.random(120) < outliers
    pixel[wrong] += random.uniform(4, 8, (wrong.sum(), 2)) * random.choice([-1, 1], (wrong.sum(), 2))
    depth = np.where(random.random(120) < 0.5, point[:, 0], np.nan)
    world = point @ T[:3, :3].T + T[:3, 3]
    return (world, Features(pixel, np.zeros(120, np.int64), np.zeros((120, 4), np.uint64), depth)), wrong


@pytest.mark.parametrize(("dof", "turn"), [("se3", (0.02, -0.03, 0.04)), ("xyz_yaw", (0.0, 0.0, 0.04))])
def test_exact_observations_determine_the_pose(dof, turn):
    true, mount = np.eye(4), CameraSettings(mount_rpy_deg=(0.0, 45.0, 0.0)).T_drone_sensor
    true[:3, :3] = Rotation.from_euler("ZYX", [1.0, 0.1, -0.05]).as_matrix()
    true[:3, 3] = 3, -2, 5
    off = true.copy()
    off[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ true[:3, :3]
    off[:3, 3] += (0.05, -0.04, 0.03)
    for outliers in (0.0, 0.25):
        seen, wrong = sightings(true, mount, outliers)
        middle = np.array([2.0, 0.1, -1.0])
        found = solve_pose(*seen, K, mount, off, FREE[dof], [], middle, 2.0 + 20 * (not outliers))
        if outliers:  # from nearer by, as after a first solve
            found = solve_pose(*seen, K, mount, found.T_world_drone, FREE[dof], [], middle, 2.0)
            assert found.weight[wrong].max() < 0.1
        np.testing.assert_allclose(found.T_world_drone, true, atol=2e-4)
        assert found.weight[~wrong].min() > 0.99
        nothing = seen[0][:0], seen[1].take(np.arange(0))
        assert solve_pose(*nothing, K, mount, off, FREE[dof], [], middle, 2.0) is None


def test_a_map_drops_old_landmarks_and_those_that_are_not_found_again():
    landmarks = LandmarkMap(50)
    random = np.random.default_rng(7)
    features = Features(np.zeros((20, 2)), np.zeros(20, np.int64), np.zeros((20, 4), np.uint64), np.ones(20))
    for now in range(4):
        landmarks.insert(random.uniform(1, 2, (20, 3)), features, np.zeros(3), now)
    assert len(landmarks) == 50
    assert np.bincount(landmarks.table["last"]).tolist() == [0, 10, 20, 20]
    landmarks.table["missed"][:5] = 12
    landmarks.insert(np.ones((1, 3)), features.take(np.array([0])), np.zeros(3), 4)
    assert len(landmarks) == 46
    mean = landmarks.table["point"][0].copy()
    landmarks.update(
        np.array([0, 1]), np.array([mean + 0.2, [np.nan] * 3]), features.take(np.arange(2)), np.arange(2, 4), 5
    )
    np.testing.assert_allclose(landmarks.table["point"][0], mean + 0.1)
    assert np.isfinite(landmarks.table["point"]).all()
    assert landmarks.table["missed"][:4].tolist() == [0, 0, 1, 1]


def test_a_landmark_is_expected_only_from_a_similar_direction():
    landmarks = LandmarkMap(50)
    features = Features(np.zeros((1, 2)), np.zeros(1, np.int64), np.zeros((1, 4), np.uint64), np.ones(1))
    landmarks.insert(np.array([[2.0, 0, 0]]), features, np.zeros(3), 0)
    seen = landmarks.expected(np.eye(4), K, SHAPE, 6.0)
    np.testing.assert_allclose(seen.pixel, [[K[0, 2], K[1, 2]]])
    np.testing.assert_allclose(seen.depth, [2.0])
    behind = np.diag([-1.0, -1.0, 1.0, 1.0])
    behind[0, 3] = 4.0
    assert len(landmarks.expected(behind, K, SHAPE, 6.0).number) == 0
    assert len(landmarks.expected(np.eye(4), K, SHAPE, 1.5).number) == 0


def test_features_of_all_levels_have_consistent_positions():
    """The features of each level of a symmetric image are symmetric, too."""
    random = np.random.default_rng(8)
    quarter = np.kron(random.integers(0, 2, (40, 53)), np.full((4, 4), 200.0)).astype(np.uint8)[:160, :211]
    quarter = import_opencv().blur(quarter, (3, 3))
    image = np.block([[quarter, quarter[:, ::-1]], [quarter[::-1], quarter[::-1, ::-1]]])
    found = find_features(image, 1000)
    assert set(found.octave) == {0, 1, 2}
    for level in range(3):
        of_level = found.pixel[found.octave == level]
        mirrored = [422, 320] - np.array([1, 1]) - of_level
        apart = np.linalg.norm(mirrored[:, None] - of_level, axis=2).min(axis=1)
        assert np.median(apart) < 0.05, level
    assert len(find_features(np.zeros(SHAPE, np.uint8), 400).pixel) == 0
