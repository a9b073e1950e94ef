import numpy as np
import pytest

from steelnb.odometry.near_side import SHARE_OF_WIDTH, NearSide, apparent_width, strip_widths
from steelnb.settings import TofSettings
from steelnb.simulation.raycasting import rays


def strip(width_m, angle_deg, distance_m=3.0, columns=240, rows=240):
    """Organised scan of a flat strip that faces the sensor, turned by an angle in the picture."""
    settings = TofSettings(columns=columns, rows=rows, fov_horizontal_rad=1.0, fov_vertical_rad=1.0)
    points = rays(settings)
    points = points / points[..., :1] * distance_m
    across = np.cos(np.radians(angle_deg)) * points[..., 1] + np.sin(np.radians(angle_deg)) * points[..., 2]
    points[np.abs(across) > width_m / 2] = np.nan
    return points


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90])
@pytest.mark.parametrize("width_m", [0.1, 0.2])
def test_the_width_of_a_strip_is_seen_whatever_its_direction(width_m, angle_deg):
    total, pixels = apparent_width(strip_widths(strip(width_m, angle_deg)))
    assert pixels > 1000
    assert total / pixels == pytest.approx(width_m, rel=0.12)


def test_walls_and_lone_pixels_do_not_count():
    assert apparent_width(strip_widths(strip(2.0, 0)))[1] == 0
    lone = np.full((9, 9, 3), np.nan)
    lone[4, 4] = [2, 0, 0]
    assert apparent_width(strip_widths(lone)) == (0.0, 0)


@pytest.mark.parametrize("x", [0.0, -1.0])
def test_what_is_not_before_the_sensor_is_no_return(x):
    scan = strip(0.1, 30)
    marked = np.where(np.isfinite(scan), scan, [x, 0.0, 0.0])
    assert apparent_width(strip_widths(marked)) == apparent_width(strip_widths(scan))
    scan[:, :2] = [x, 0.5, 0.1]
    assert np.isfinite(apparent_width(strip_widths(scan))[0])


def test_a_step_in_range_ends_a_run():
    near, far = strip(0.1, 0), strip(0.6, 0, distance_m=4.0)
    both = np.where(np.isfinite(near), near, far)
    total, pixels = apparent_width(strip_widths(both))
    assert total / pixels > 0.1  # the strip, and the two pieces of wall beside it
    assert pixels > 2 * apparent_width(strip_widths(near))[1]


def test_the_share_is_that_of_an_angle_section_with_thickness():
    # Random rays on the outline of an equal-leg angle, flange 1, thickness 1/12: how far in front of the centroid they
    # end, and how wide the section appears to the pixels that see it.
    rng, t = np.random.default_rng(0), 1 / 12
    corners = np.array([(0, 0), (1, 0), (1, t), (t, t), (t, 1), (0, 1)])
    centroid = (np.array([0.5, t / 2]) * t + np.array([t / 2, (1 + t) / 2]) * t * (1 - t)) / (2 * t - t * t)
    outline = corners - centroid
    depth, seen_width = [], []
    for angle in rng.uniform(0, 2 * np.pi, 5_000):
        to_viewer = np.array([np.cos(angle), np.sin(angle)])
        lateral, nearer = outline @ [-to_viewer[1], to_viewer[0]], outline @ to_viewer
        ray = rng.uniform(-1.2, 1.2)
        following = np.roll(lateral, -1)
        crossed = (lateral <= ray) != (following <= ray)
        if crossed.any():
            along = (ray - lateral[crossed]) / (following - lateral)[crossed]
            depth.append(np.max(nearer[crossed] + along * (np.roll(nearer, -1) - nearer)[crossed]))
            seen_width.append(np.ptp(lateral))
    assert np.mean(depth) / np.mean(seen_width) == pytest.approx(SHARE_OF_WIDTH, rel=0.05)


def test_the_shift_follows_the_width_and_needs_an_organised_scan():
    state = NearSide()
    state.update(np.zeros((50, 3)))
    assert state.shift_m == 0.0
    state.update(strip(0.1, 20))
    state.update(strip(0.2, 20))
    assert 0.1 < state.shift_m / SHARE_OF_WIDTH < 0.2
