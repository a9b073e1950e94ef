import gc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core import rng
from steelnb.core.errors import CollisionError
from steelnb.settings import FlightSettings, TowerSettings
from steelnb.simulation import build_tower, fly
from steelnb.simulation.flight import gusts, path, setpoints
from steelnb.simulation.tower import half_width

TOWER = build_tower()


@pytest.mark.parametrize("name", ["zigzag", "loops"])
def test_the_flight_covers_the_report_s_heights_in_about_200_s(name):
    settings = FlightSettings.preset(name)
    trajectory, _ = fly(TOWER, settings, 1)
    position = trajectory.position
    assert trajectory.stamp_s[-1] == pytest.approx(200.0)
    assert position[0, 2] == pytest.approx(0.7, abs=0.1)
    assert position[-1, 2] == pytest.approx(settings.height_max_m, abs=0.2)
    arrived = np.argmax(position[:, 2] > settings.height_max_m - 0.3) / 125
    assert 150 < arrived < 200
    half = np.array([half_width(TOWER.settings, z) for z in position[:, 2]])
    clear = np.abs(position[:, :2]).max(axis=1) - half
    assert clear.min() > 0.7
    ahead = trajectory.T_world_drone[:, :2, 0]
    to_axis = -position[:, :2] / np.linalg.norm(position[:, :2], axis=1)[:, None]
    assert (ahead[:, 1] if name == "zigzag" else (ahead * to_axis).sum(axis=1)).min() > 0.95  # at the face or the axis
    tilt = np.degrees(np.arccos(np.clip(trajectory.T_world_drone[:, 2, 2], -1, 1)))
    assert np.sqrt((tilt**2).mean()) < 4


def test_the_imu_integrates_back_to_the_flight():
    trajectory, imu = fly(TOWER, FlightSettings.preset("loops", 20.0), 3)
    R, dt = trajectory.T_world_drone[:, :3, :3], 0.008
    acceleration = np.einsum("nij,nj->ni", R[1:], imu.specific_force[1:]) - [0, 0, 9.81]
    velocity = np.cumsum(acceleration * dt, axis=0)
    position = trajectory.position[0] + np.cumsum(velocity * dt, axis=0)
    np.testing.assert_allclose(position, trajectory.position[1:], atol=1e-9)
    # Each orientation follows from the one before by the angular rate in the body frame.
    turned = Rotation.from_matrix(R[:-1]) * Rotation.from_rotvec(imu.angular_rate[1:] * dt)
    assert (turned.inv() * Rotation.from_matrix(R[1:])).magnitude().max() < 1e-4


def test_the_seed_changes_only_the_gusts():
    calm = FlightSettings.preset("zigzag", 5.0).replace(gust_sigma_m_s=0.0)
    a, b = (fly(TOWER, calm, seed)[0].position for seed in (1, 2))
    np.testing.assert_array_equal(a, b)
    a, b, c = (fly(TOWER, FlightSettings.preset("zigzag", 5.0), seed)[0].position for seed in (1, 2, 1))
    np.testing.assert_array_equal(a, c)
    assert 0.001 < np.abs(a - b).max() < 0.3


def test_gusts_follow_their_recursion_and_those_of_a_longer_flight_begin_alike():
    shocks = rng.stream(3, "gust").standard_normal((50, 3))
    keep, wind = np.exp(-0.008 / 2.0), np.zeros(3)
    found = gusts(FlightSettings(), 3, 80)[:50]
    for k, expected in enumerate(found):
        wind = keep * wind + 0.3 * np.sqrt(1 - keep**2) * shocks[k]
        np.testing.assert_allclose(expected, wind, rtol=1e-12)


def test_touching_the_structure_is_an_error_with_time_and_place():
    settings = FlightSettings.preset("zigzag").replace(standoff_m=-0.05)
    with pytest.raises(CollisionError, match=r"standoff_m = -0.05.* t = \d+\.\d\d s, at x = .* m"):
        fly(TOWER, settings, 1)


def test_the_path_goes_through_its_corners_slowly():
    settings, tower = FlightSettings.preset("loops"), TowerSettings()
    position, velocity = setpoints(settings, tower, 25_000, 0.008)
    corner, _ = path(settings, tower)
    nearest = [np.linalg.norm(position - point, axis=1).min() for point in corner]
    assert max(nearest) < 0.3  # rounded corners
    assert np.linalg.norm(velocity, axis=1).max() < 1.02 * settings.speed_m_s
    np.testing.assert_allclose(position[-1], corner[-1], atol=1e-6)


def test_memory_does_not_grow_with_the_number_of_flights_and_of_towers():
    """PyBullet would keep 0.7 MiB of vertices a flight."""

    def pages_after(flights: int) -> int:
        for seed in range(flights):
            tower = build_tower(TowerSettings(profile_m=((0.0, 4.0 + 0.01 * seed), (9.0, 1.7), (16.0, 1.0))))
            fly(tower, FlightSettings.preset("loops", 0.1), seed)
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1])

    assert pages_after(5) + 5 * 256 > pages_after(20)  # pages of 4 KiB
