import numpy as np
import pytest

from steelnb.core.errors import CollisionError
from steelnb.settings import FlightSettings
from steelnb.simulation import build_tower, fly
from steelnb.simulation.flight import minimum_jerk, pose_on_path

REPORT = ("vertical", "orbit", "orbit-3.3")


def at(name, *seconds):
    """Poses at seconds since the start of the path."""
    flight = FlightSettings.preset(name)
    return minimum_jerk(flight, flight.still_s + np.array(seconds, dtype=float))[0]


@pytest.mark.parametrize("name", REPORT)
def test_the_path_is_smooth_passes_each_waypoint_in_its_time_and_is_at_rest_there(name):
    flight = FlightSettings.preset(name)
    point = np.array(flight.waypoints)
    pose, rate, acceleration = minimum_jerk(flight, flight.still_s + np.cumsum(point[:, 4]))
    np.testing.assert_allclose(pose[:, :3], point[:, :3], atol=1e-12)
    turned = pose[:, 3] - np.radians(point[:, 3])
    np.testing.assert_allclose(np.exp(1j * turned), 1, atol=1e-12)
    np.testing.assert_allclose(np.hstack([rate, acceleration]), 0, atol=1e-12)
    assert np.abs(np.diff(pose[:, 3])).max() <= np.pi + 1e-12
    pose, rate, acceleration = minimum_jerk(flight, np.arange(0, flight.duration_s, 0.008))
    np.testing.assert_allclose(np.gradient(pose, 0.008, axis=0)[1:-1], rate[1:-1], atol=2e-3)
    np.testing.assert_allclose(np.gradient(rate, 0.008, axis=0)[1:-1], acceleration[1:-1], atol=0.1)


def test_the_vertical_flight_has_the_report_s_positions():
    start, top, down, foot, end = at("vertical", 0, 210, 325, 335, 408)
    np.testing.assert_allclose(start, [0.5, 2.5, 0.1, -np.pi / 2], atol=1e-9)
    np.testing.assert_allclose(top[:3], [0.5, 1.5, 15.0], atol=1e-9)
    np.testing.assert_allclose(down[:3], [-0.5, 2.5, 0.1], atol=1e-9)
    np.testing.assert_allclose(foot, [0.5, -2.5, 0.1, np.pi / 2], atol=1e-9)
    # Figure 3.2a ends at 12 m before the second face.
    np.testing.assert_allclose(end[1:], [-1.5, 12.0, np.pi / 2], atol=1e-9)
    assert 0.5 < end[0] < 1.0


@pytest.mark.parametrize("name", [*REPORT, "zigzag"])
def test_the_drone_stands_still_before_it_flies(name):
    flight = FlightSettings.preset(name, 14.0).replace(still_s=6.0, gust_sigma_m_s=0.5)
    flown, imu = fly(build_tower(), flight, 3)
    still = flown.stamp_s <= (5.0 if name == "zigzag" else 6.0)  # a rounded path begins a second early
    np.testing.assert_allclose(flown.position[still], flown.position[:1].repeat(still.sum(), axis=0), atol=1e-9)
    np.testing.assert_allclose(imu.angular_rate[still], 0, atol=1e-9)
    assert np.linalg.norm(flown.position[-1] - flown.position[0]) > 0.1
    moved = fly(build_tower(), flight.replace(still_s=0.0, gust_sigma_m_s=0.0, duration_s=8.0), 3)[0]
    calm = fly(build_tower(), flight.replace(gust_sigma_m_s=0.0), 3)[0]
    np.testing.assert_allclose(calm.position[-1], moved.position[-1], atol=2e-3)


def test_the_orbit_climbs_at_the_corner_behind_the_first_face():
    """As in the published file: level 1 flies the first face twice, and each climb begins at (2.5, 2.5)."""
    np.testing.assert_allclose(at("orbit", 20)[0, :3], [2.5, 2.5, 0.6], atol=1e-9)
    for k, height in enumerate((0.6, 2, 4, 6)):
        before, after, next_corner = at("orbit", 120 + 100 * k, 125 + 100 * k, 145 + 100 * k)
        np.testing.assert_allclose(before[:3], [2.5, 2.5, height], atol=1e-9)
        np.testing.assert_allclose(after[:3], [2.5, 2.5, (2, 4, 6, 8)[k]], atol=1e-9)
        np.testing.assert_allclose(next_corner[:2], [2.5, -2.5], atol=1e-9)
    np.testing.assert_allclose(at("orbit", 500, 545)[:, :3], [[-2.5, 2.5, 8], [0.5, 2.5, 0.1]], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "heights", "first_s", "level_s"),
    [("orbit", (0.6, 2, 4, 6, 8), 25, 100), ("orbit-3.3", np.linspace(0.6, 7, 6), 8.5, 34)],
)
def test_the_orbits_look_at_the_faces_at_their_heights(name, heights, first_s, level_s):
    for level, height in enumerate(heights):
        on_three_sides = level + np.array([0.05, 0.15, 0.26, 0.4, 0.52, 0.68])
        x, y, z, heading = at(name, *(first_s + on_three_sides * level_s)).T
        np.testing.assert_allclose(z, height, atol=1e-9)
        ahead, across = np.cos(heading) * x + np.sin(heading) * y, np.sin(heading) * x - np.cos(heading) * y
        np.testing.assert_allclose(ahead, -2.5, atol=1e-9)
        assert (np.abs(across) < 2.5).all()
        np.testing.assert_allclose(np.sin(2 * heading), 0, atol=1e-9)


def test_own_waypoints_turn_the_shorter_way_and_are_followed_in_time():
    path = ((2.0, 3.0, 1.0, 170.0, 0.0), (2.0, 3.0, 1.0, -170.0, 4.0), (2.0, 4.0, 1.0, -170.0, 4.0))
    flight = FlightSettings(trajectory="orbit", duration_s=8.0, waypoints=path, gust_sigma_m_s=0.0)
    pose, *_ = minimum_jerk(flight, np.array([0.0, 2.0, 4.0, 6.0, 8.0, 9.0]))
    np.testing.assert_allclose(np.degrees(pose[:, 3]), [170, 180, 190, 190, 190, 190])
    np.testing.assert_allclose(pose[:, 1], [3, 3, 3, 3.5, 4, 4])
    tower = build_tower()
    flown, _ = fly(tower, flight, 1)
    along = minimum_jerk(flight, flown.stamp_s)[0]
    assert np.linalg.norm(flown.position - along[:, :3], axis=1).max() < 0.06
    np.testing.assert_allclose(flown.position[-1], [2, 4, 1], atol=0.05)
    np.testing.assert_allclose(pose_on_path(tower, flight, 0.75)[:3, 3], [2, 3.5, 1], atol=1e-9)


def test_a_path_through_the_steel_is_a_collision():
    path = ((3.0, 1.9, 0.5, 180.0, 0.0), (-3.0, 1.9, 0.5, 180.0, 8.0))
    flight = FlightSettings(trajectory="vertical", duration_s=8.0, waypoints=path)
    with pytest.raises(CollisionError, match=r"vertical flight: the drone touches .* t = \d+\.\d\d s"):
        fly(build_tower(), flight, 1)
