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
    fit = bend(transformed(tower, [0, 1, 0], 2.0, [0.1, -0.2, 0.3]), tower)
    assert fit.tilt_deg == pytest.approx(np.full(10, 2.0))
    assert fit.yaw_deg == pytest.approx(np.zeros(10), abs=1e-9)
    assert fit.bend_deg == pytest.approx(0, abs=1e-5)
    height = fit.height_m
    expected = np.column_stack(
        [
            height * np.sin(np.radians(2)) + 0.1,
            np.full(10, -0.2),
            height * (np.cos(np.radians(2)) - 1) + 0.3,
        ]
    )
    assert fit.offset_m(np.zeros(2)) == pytest.approx(expected, abs=1e-12)


def test_yaw_is_no_tilt_and_does_not_move_the_axis(tower):
    fit = bend(transformed(tower, [0, 0, 1], -7.0, [0, 0, 0]), tower)
    assert fit.yaw_deg == pytest.approx(np.full(10, -7.0))
    assert fit.tilt_deg == pytest.approx(np.zeros(10), abs=1e-5)
    assert fit.offset_m(np.zeros(2)) == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(fit.offset_m(np.array([1.0, 0.0])), axis=1) == pytest.approx(2 * np.sin(np.radians(3.5)))


def test_the_bend_is_the_rotation_between_the_lowest_and_highest_slice(tower):
    angle = np.radians(0.5 * np.floor(tower[:, 2]))  # half a degree more with every slice
    built = Rotation.from_rotvec(np.outer(angle, [1.0, 0, 0])).apply(tower)
    fit = bend(built, tower)
    assert fit.tilt_deg == pytest.approx(0.5 * np.arange(10), abs=1e-5)
    assert fit.bend_deg == pytest.approx(4.5)
    numbers = fit.metrics(np.zeros(2))
    assert numbers["tilt_max_deg"] == pytest.approx(4.5)
    assert numbers["offset_max_m"] == pytest.approx(2 * 9.5 * np.sin(np.radians(2.25)))


def test_doubled_surfaces_are_blur_and_no_bend(tower):
    doubled = np.concatenate([tower, tower])
    side = np.repeat([[0.1, 0, 0], [-0.1, 0, 0]], len(tower), axis=0)
    fit = bend(doubled + side, doubled)
    assert fit.blur_m == pytest.approx(np.full(10, 0.1), rel=1e-6)
    assert fit.tilt_deg.max() < 1e-4
    assert fit.offset_m(np.zeros(2)) == pytest.approx(0, abs=1e-6)


def test_slices_of_few_points_are_dropped_and_no_slice_is_an_error(tower):
    points = np.concatenate([tower[tower[:, 2] < 5], tower[tower[:, 2] > 9][:10]])
    fit = bend(points, points)
    assert fit.height_m == pytest.approx(np.arange(5) + 0.5)
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
