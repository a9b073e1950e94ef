import numpy as np
import pytest

from steelnb import rng
from steelnb.config import FlightSettings, TofSettings
from steelnb.datatypes import Trajectory
from steelnb.simulation import build_tower, fly, scan_flight
from steelnb.simulation.tof import measure, rays

TOWER = build_tower()
EXACT = TofSettings.preset("report").but(sigma_floor_m=0.0)


@pytest.fixture(scope="module")
def flight():
    return fly(TOWER, FlightSettings.preset("vertical", 10.0), 1)[0]


def distance_to_axes(points):
    begin, end = TOWER.axes[:, 0], TOWER.axes[:, 1]
    axis = end - begin
    t = np.clip(((points[:, None] - begin) * axis).sum(axis=2) / (axis**2).sum(axis=1), 0, 1)
    return np.linalg.norm(points[:, None] - begin - t[..., None] * axis, axis=2).min(axis=1)


def test_rays_are_a_pinhole_s_with_the_given_fields_of_view():
    settings = TofSettings.preset("starling2")
    ray = rays(settings)
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
    scans, hits = scan_flight(TOWER, flight, T_drone_sensor, EXACT, 1)
    poses = flight.at(scans.stamp_s).T_world_drone @ T_drone_sensor
    steel = 0
    for scan, T in zip(scans, poses, strict=True):
        points = scan.points.reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])] @ T[:3, :3].T + T[:3, 3]
        points = points[np.abs(points[:, 2]) > 1e-3]
        steel += len(points)
        assert distance_to_axes(points).max() <= np.hypot(0.12, 0.12)
    assert hits.sum() == pytest.approx(steel, rel=0.01)
    assert len(scans) == 50


def test_noise_has_the_sigma_of_its_settings(flight):
    for settings in (TofSettings.preset("report"), TofSettings.preset("starling2")):
        exact, _ = scan_flight(TOWER, flight, np.eye(4), settings.but(sigma_floor_m=0.0, sigma_relative=0.0), 1)
        noisy, _ = scan_flight(TOWER, flight, np.eye(4), settings, 1)
        np.testing.assert_array_equal(np.isnan(exact.range_m), np.isnan(noisy.range_m))
        sigma = np.maximum(settings.sigma_floor_m, settings.sigma_relative * exact.range_m)
        score = ((noisy.range_m - exact.range_m) / sigma)[np.isfinite(exact.range_m)]
        assert score.std() == pytest.approx(1, abs=0.02)
        assert abs(score.mean()) < 0.02
        limits = exact.range_m[np.isfinite(exact.range_m)]
        assert limits.min() >= settings.range_min_m
        assert limits.max() <= settings.range_max_m


def test_a_longer_flight_begins_with_the_scans_of_a_shorter_one(flight):
    shorter = Trajectory(flight.stamp_s[:626], flight.T_world_drone[:626])
    a, _ = scan_flight(TOWER, flight, np.eye(4), TofSettings.preset("report"), 4)
    b, _ = scan_flight(TOWER, shorter, np.eye(4), TofSettings.preset("report"), 4)
    assert (len(a), len(b)) == (50, 25)
    np.testing.assert_array_equal(a.range_m[:25], b.range_m)
    c, _ = scan_flight(TOWER, shorter, np.eye(4), TofSettings.preset("report"), 5)
    assert np.nanmax(np.abs(b.range_m - c.range_m)) > 0.01


def test_flying_pixels_lie_between_two_surfaces_and_only_at_edges():
    exact = np.full((20, 20), 4.0)
    exact[:, 8:12] = 2.0
    exact[:3] = np.inf
    settings = EXACT.but(flying_pixel_probability=1.0)
    result = measure(exact, settings, rng.stream(1, "test"))
    edge = np.zeros(exact.shape, dtype=bool)
    edge[3:, 7:9] = edge[3:, 11:13] = True
    assert np.isnan(result[:3]).all()
    np.testing.assert_array_equal(result[3:][~edge[3:]], exact[3:][~edge[3:]])
    assert ((result[edge] > 2) & (result[edge] < 4)).mean() > 0.98
    half = measure(exact, settings.but(flying_pixel_probability=0.5), rng.stream(1, "test"))
    assert 0.3 < (half[edge] != exact[edge]).mean() < 0.7


def test_dropouts_are_as_frequent_as_asked():
    exact = np.full((200, 200), 2.0)
    result = measure(exact, EXACT.but(dropout_probability=0.3), rng.stream(1, "test"))
    assert np.isnan(result).mean() == pytest.approx(0.3, abs=0.01)
