"""Bend of clouds with known motion, basin of convergence, and slip."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.metrics import basin_radius_m, bend, largest_slip


@pytest.fixture
def tower():
    """5000 points in a box 10 m high and 1.5 m wide."""
    rng = np.random.default_rng(3)
    return rng.uniform([-0.7, -0.7, 0.0], [0.8, 0.8, 10.0], (5000, 3))


def transformed(points, axis, degrees, offset):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).apply(points) + offset


def by_slice(built, true, **options):
    """The bend of each slice of a metre on its own."""
    level = np.floor(true[:, 2])
    return [bend(built[level == each], true[level == each], **options) for each in np.unique(level)]


def column(numbers, name):
    return np.array([each[name] for each in numbers])


def test_a_tilt_is_equal_in_all_slices_and_shifts_the_top(tower):
    built = transformed(tower, [0, 1, 0], 2.0, [0.1, -0.2, 0.3])
    slices, angle, height = by_slice(built, tower), np.radians(2), np.arange(10) + 0.5
    shift = np.column_stack([height * np.sin(angle) + 0.1, np.full(10, -0.2), height * (np.cos(angle) - 1) + 0.3])
    assert column(slices, "tilt_max_deg") == pytest.approx(np.full(10, 2.0))
    assert column(slices, "yaw_max_deg") == pytest.approx(np.zeros(10), abs=1e-9)
    assert column(slices, "offset_max_m") == pytest.approx(np.linalg.norm(shift, axis=1), abs=1e-12)
    whole = bend(built, tower)
    assert whole["bend_deg"] == pytest.approx(0, abs=1e-5)
    assert whole["blur_mean_m"] == pytest.approx(0, abs=1e-12)
    for name in ("tilt_max_deg", "yaw_max_deg", "offset_max_m"):
        assert whole[name] == column(slices, name).max()


def test_yaw_is_no_tilt_and_does_not_move_the_axis(tower):
    built = transformed(tower, [0, 0, 1], -7.0, [0, 0, 0])
    slices = by_slice(built, tower)
    assert column(slices, "yaw_max_deg") == pytest.approx(np.full(10, 7.0))
    assert column(slices, "tilt_max_deg") == pytest.approx(np.zeros(10), abs=1e-5)
    assert column(slices, "offset_max_m") == pytest.approx(0, abs=1e-12)
    beside = column(by_slice(built, tower, axis=(1.0, 0.0)), "offset_max_m")
    assert beside == pytest.approx(2 * np.sin(np.radians(3.5)))


def test_the_bend_is_the_rotation_between_the_lowest_and_highest_slice(tower):
    angle = np.radians(0.5 * np.floor(tower[:, 2]))  # half a degree more with every slice
    built = Rotation.from_rotvec(np.outer(angle, [1.0, 0, 0])).apply(tower)
    assert column(by_slice(built, tower), "tilt_max_deg") == pytest.approx(0.5 * np.arange(10), abs=1e-5)
    numbers = bend(built, tower)
    assert numbers["bend_deg"] == pytest.approx(4.5)
    assert numbers["tilt_max_deg"] == pytest.approx(4.5)
    assert numbers["offset_max_m"] == pytest.approx(2 * 9.5 * np.sin(np.radians(2.25)))


def test_doubled_surfaces_are_blur_and_no_bend(tower):
    doubled = np.concatenate([tower, tower])
    side = np.repeat([[0.1, 0, 0], [-0.1, 0, 0]], len(tower), axis=0)
    assert column(by_slice(doubled + side, doubled), "blur_mean_m") == pytest.approx(np.full(10, 0.1), rel=1e-6)
    numbers = bend(doubled + side, doubled)
    assert numbers["blur_mean_m"] == pytest.approx(0.1, rel=1e-6)
    assert numbers["tilt_max_deg"] < 1e-4
    assert numbers["offset_max_m"] == pytest.approx(0, abs=1e-6)


def test_slices_of_few_points_are_dropped_and_no_slice_is_an_error(tower):
    for count, offset_m in ((199, 0.0), (200, np.sqrt(3))):
        top = tower[tower[:, 2] > 9][:count]
        points = np.concatenate([tower[tower[:, 2] < 5], top])
        built = np.concatenate([tower[tower[:, 2] < 5], top + 1.0])
        assert bend(built, points)["offset_max_m"] == pytest.approx(offset_m, abs=1e-6)
    with pytest.raises(InputError, match="no slice of"):
        bend(points[:50], points[:50])
    with pytest.raises(InputError, match="expected pairs"):
        bend(points, points[1:])


def test_the_basin_ends_before_the_nearest_failure():
    offset = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, -0.5], [0.6, 0, 0.8]])
    assert basin_radius_m(offset, np.array([True, True, False, True])) == pytest.approx(0.3)
    assert basin_radius_m(offset, np.array([True, True, True, True])) == pytest.approx(1.0)
    assert basin_radius_m(offset, np.array([True, False, True, True])) == 0
    assert basin_radius_m(offset, np.array([False, True, True, True])) == 0


def test_largest_slip_finds_the_scan_where_the_error_has_grown():
    error = np.concatenate([np.full(20, 0.05), np.linspace(0.05, 0.55, 6), np.full(20, 0.55)])
    scan, growth = largest_slip(error, 0.2 * np.arange(len(error)))
    assert (scan, growth) == (24, pytest.approx(0.5)) or (scan, growth) == (25, pytest.approx(0.5))
    assert largest_slip(np.array([0.0, 0.2, 0.1]), np.array([0.0, 0.2, 0.4])) == (2, pytest.approx(0.1))


@pytest.mark.parametrize(
    "stamp_s",
    [
        0.1 * np.arange(300),
        np.concatenate([0.1 * np.arange(100), 10 + np.arange(20.0)]),
        np.concatenate([0.1 * np.arange(100), 40 + 0.1 * np.arange(100)]),
        2.0 * np.arange(20),
    ],
    ids=["10 Hz", "10, then 1 Hz", "a gap", "0.5 Hz"],
)
def test_a_drift_of_1_cm_a_second_slips_by_1_cm_at_any_rate(stamp_s):
    assert largest_slip(0.01 * stamp_s, stamp_s)[1] == pytest.approx(0.01)
