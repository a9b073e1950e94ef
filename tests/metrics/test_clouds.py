"""Bend of clouds with known motion, basin of convergence, and slip."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.metrics import basin_radius_m, bend, largest_slip


@pytest.fixture
def tower():
    """5000 points in a box 10 m high and 1.5 m wide."""
    rng = np.random.default_rng(3)
    return rng.uniform([-0.7, -0.7, 0.0], [0.8, 0.8, 10.0], (5000, 3))


def transformed(points, axis, degrees, offset):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).apply(points) + offset


def test_a_tilt_is_equal_in_all_slices_and_shifts_the_top(tower):
    numbers = bend(transformed(tower, [0, 1, 0], 2.0, [0.1, -0.2, 0.3]), tower)
    angle, height = np.radians(2), 9.5  # of the middle of the highest slice
    shift = [height * np.sin(angle) + 0.1, -0.2, height * (np.cos(angle) - 1) + 0.3]
    assert numbers["tilt_max_deg"] == pytest.approx(2.0)
    assert numbers["offset_max_m"] == pytest.approx(np.linalg.norm(shift))
    assert [numbers[name] for name in ("yaw_max_deg", "bend_deg", "blur_mean_m")] == pytest.approx([0] * 3, abs=1e-5)


def test_yaw_is_no_tilt_and_does_not_move_the_axis(tower):
    built = transformed(tower, [0, 0, 1], -7.0, [0, 0, 0])
    numbers = bend(built, tower)
    assert numbers["yaw_max_deg"] == pytest.approx(7.0)
    assert [numbers[name] for name in ("tilt_max_deg", "offset_max_m")] == pytest.approx([0, 0], abs=1e-5)
    assert bend(built, tower, axis=(1.0, 0.0))["offset_max_m"] == pytest.approx(2 * np.sin(np.radians(3.5)))


def test_the_bend_is_the_rotation_between_the_lowest_and_highest_slice(tower):
    angle = np.radians(0.5 * np.floor(tower[:, 2]))  # half a degree more with every slice
    numbers = bend(Rotation.from_rotvec(np.outer(angle, [1.0, 0, 0])).apply(tower), tower)
    assert numbers["bend_deg"] == pytest.approx(4.5)
    assert numbers["tilt_max_deg"] == pytest.approx(4.5)
    assert numbers["offset_max_m"] == pytest.approx(2 * 9.5 * np.sin(np.radians(2.25)))


def test_doubled_surfaces_are_blur_and_no_bend(tower):
    doubled = np.concatenate([tower, tower])
    side = np.repeat([[0.1, 0, 0], [-0.1, 0, 0]], len(tower), axis=0)
    numbers = bend(doubled + side, doubled)
    assert numbers["blur_mean_m"] == pytest.approx(0.1, rel=1e-6)
    assert [numbers[name] for name in ("tilt_max_deg", "offset_max_m")] == pytest.approx([0, 0], abs=1e-4)


def test_slices_of_few_points_are_dropped_and_no_slice_is_an_error(tower):
    few = tower[tower[:, 2] > 9][:10]
    points = np.concatenate([tower[tower[:, 2] < 5], few])
    built = np.concatenate([tower[tower[:, 2] < 5], few + 1.0])
    assert bend(built, points)["offset_max_m"] == pytest.approx(0, abs=1e-9)
    with pytest.raises(ValueError, match="no slice of"):
        bend(points[:50], points[:50])
    with pytest.raises(ValueError, match="expected pairs"):
        bend(points, points[1:])


def test_the_basin_ends_before_the_nearest_failure():
    offset = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, -0.5], [0.6, 0, 0.8]])
    assert basin_radius_m(offset, np.array([True, True, False, True])) == pytest.approx(0.3)
    assert basin_radius_m(offset, np.array([True, True, True, True])) == pytest.approx(1.0)
    assert basin_radius_m(offset, np.array([True, False, True, True])) == 0
    assert basin_radius_m(offset, np.array([False, True, True, True])) == 0


def test_largest_slip_finds_the_scan_where_the_error_has_grown():
    error = np.concatenate([np.full(20, 0.05), np.linspace(0.05, 0.55, 6), np.full(20, 0.55)])
    scan, growth = largest_slip(error, 5)
    assert (scan, growth) == (24, pytest.approx(0.5)) or (scan, growth) == (25, pytest.approx(0.5))
    assert largest_slip(np.array([0.0, 0.2, 0.1]), 5) == (2, pytest.approx(0.1))
