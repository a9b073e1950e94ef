import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation import build_tower, fly, scan_flight
from steelnb.simulation.scene import cast_rays, make_scene, rays
from steelnb.simulation.tof import RANGE_MIN_M
from steelnb.types import Trajectory

TOWER = build_tower()
SCENE = make_scene(TOWER)
EXACT = TofSettings.preset("report").replace(sigma_floor_m=0.0)


@pytest.fixture(scope="module")
def flight():
    return fly(TOWER, FlightSettings.preset("vertical", 10.0), 1)[0]


def distance_to_axes(points):
    begin, end = TOWER.axes[:, 0], TOWER.axes[:, 1]
    axis = end - begin
    t = np.clip(((points[:, None] - begin) * axis).sum(axis=2) / (axis**2).sum(axis=1), 0, 1)
    return np.linalg.norm(points[:, None] - begin - t[..., None] * axis, axis=2).min(axis=1)


def test_rays_are_a_pinhole_s_with_the_given_fields_of_view():
    ray = rays(TofSettings.preset("starling2"))
    assert ray.shape == (240, 180, 3)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=2), 1)
    pixel = ray / ray[..., :1]
    np.testing.assert_allclose(np.diff(pixel[..., 1], axis=1), -2 * np.tan(np.radians(43)) / 180)
    np.testing.assert_allclose(np.diff(pixel[..., 2], axis=0), -2 * np.tan(np.radians(53)) / 240)
    assert pixel[0, 0, 1] > 0  # the first pixel is up and to the left
    assert pixel[0, 0, 2] > 0


def test_exact_returns_lie_on_the_structure_or_the_ground(flight):
    T_drone_sensor = np.eye(4)
    T_drone_sensor[:3, 3] = [0.06, 0.02, -0.01]
    scans, visibility = scan_flight(TOWER, flight, T_drone_sensor, EXACT, 1)
    poses = flight.at(scans.stamp_s).T_world_drone @ T_drone_sensor
    steel = 0
    for scan, T in zip(scans, poses, strict=True):
        points = scan.points.reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])] @ T[:3, :3].T + T[:3, 3]
        points = points[np.abs(points[:, 2]) > 1e-3]
        steel += len(points)
        assert distance_to_axes(points).max() <= np.hypot(0.12, 0.12)
    assert visibility.returns.sum() == pytest.approx(steel, rel=0.01)
    assert len(scans) == 50


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 20), st.floats(-math.pi, math.pi), st.floats(0.2, 1.5), st.floats(-0.5, 0.5))
def test_ranges_to_the_ground_are_those_of_the_plane(height, yaw, pitch, roll):
    """Beside the tower, looking down: range = height over the fall of the ray, and no return above the horizon."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[:3, 3] = [30, 0, height]
    ray = rays(EXACT)
    exact, member = cast_rays(SCENE, T[None], ray)
    world = ray @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        at = -height / world[..., 2:] * world + T[:3, 3]
    ground = (world[..., 2] < -1e-3) & (np.abs(at[..., :2]).max(axis=-1) < TOWER.settings.floor_half_m - 0.1)
    tower = member[0] >= 0
    assert ground.any()
    np.testing.assert_allclose(exact[0][ground & ~tower], (-height / world[..., 2])[ground & ~tower], rtol=1e-4)
    assert np.isinf(exact[0][(world[..., 2] > 1e-3) & ~tower]).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_ray_hits_the_member_that_it_says(seed):
    """Aimed at a point on a member from 2 m away: hit there, or before by another one."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(len(TOWER.members)))
    begin, end = TOWER.axes[m]
    flange = np.array(TOWER.members[m].flange_a) * TOWER.members[m].section_m[0]
    target = begin + rng.uniform(0.05, 0.95) * (end - begin) + 0.5 * flange
    aim = rng.normal(size=3) * [1, 1, 0.2]
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(aim[None], [[1, 0, 0]])[0].as_matrix()
    T[:3, 3] = target - 2.0 * aim / np.linalg.norm(aim)
    exact, member = cast_rays(SCENE, T[None], np.array([[[1.0, 0, 0]]]))
    at = T[:3, 3] + exact[0, 0, 0] * T[:3, 0]
    if exact[0, 0, 0] < 2.0 - 0.15:
        assert T[2, 3] < 0 or member[0, 0, 0] >= 0
    else:
        assert np.linalg.norm(at - target) < 0.15
    if member[0, 0, 0] >= 0:
        begin, end = TOWER.axes[member[0, 0, 0]]
        axis = (end - begin) / np.linalg.norm(end - begin)
        assert np.linalg.norm(np.cross(at - begin, axis)) < TOWER.members[member[0, 0, 0]].section_m[
            0
        ] * 1.01 * np.sqrt(2)


def test_noise_has_the_sigma_of_its_settings(flight):
    flight = Trajectory(flight.stamp_s[:501], flight.T_world_drone[:501])
    for sensor in (TofSettings.preset("report"), TofSettings.preset("starling2")):
        exact, _ = scan_flight(TOWER, flight, np.eye(4), sensor.replace(sigma_floor_m=0.0, sigma_relative=0.0), 1)
        noisy, _ = scan_flight(TOWER, flight, np.eye(4), sensor, 1)
        np.testing.assert_array_equal(np.isnan(exact.range_m), np.isnan(noisy.range_m))
        sigma = np.maximum(sensor.sigma_floor_m, sensor.sigma_relative * exact.range_m)
        score = ((noisy.range_m - exact.range_m) / sigma)[np.isfinite(exact.range_m)]
        assert score.std() == pytest.approx(1, abs=0.02)
        assert abs(score.mean()) < 0.02
        limits = exact.range_m[np.isfinite(exact.range_m)]
        assert limits.min() >= RANGE_MIN_M
        assert limits.max() <= sensor.range_max_m


def test_a_longer_flight_begins_with_the_scans_of_a_shorter_one(flight):
    shorter = Trajectory(flight.stamp_s[:626], flight.T_world_drone[:626])
    a, _ = scan_flight(TOWER, flight, np.eye(4), TofSettings.preset("report"), 4)
    b, _ = scan_flight(TOWER, shorter, np.eye(4), TofSettings.preset("report"), 4)
    assert (len(a), len(b)) == (50, 25)
    np.testing.assert_array_equal(a.range_m[:25], b.range_m)
    c, _ = scan_flight(TOWER, shorter, np.eye(4), TofSettings.preset("report"), 5)
    assert np.nanmax(np.abs(b.range_m - c.range_m)) > 0.01
