import numpy as np
import pytest

from steelnb.core.types import Scan
from steelnb.experiment import estimate, simulate
from steelnb.fusion.point_to_bar import world_points
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.near_side import ASIDE_M, parted, pixels_on_surfaces, within_plane
from steelnb.settings import ExperimentSettings, OdometrySettings
from tests.odometry.test_near_side import strip


def over(distance_m, columns, rows=240):
    """Organised scan of a wall that covers the first ``columns``, and of a strip 10 cm wide before it."""
    wall, bar = strip(20.0, 0, distance_m=distance_m, rows=rows), strip(0.1, 20, rows=rows)
    wall[:, columns:] = np.nan
    return np.where(np.isfinite(bar), bar, wall), np.isfinite(bar[..., 0]), np.isfinite(wall[..., 0])


def used(scan, range_max_m=6.0, floor_m=-10.0):
    """Index of the points within range and above the floor, of a sensor at the origin."""
    return world_points(np.ascontiguousarray(scan).reshape(-1, 3), np.eye(4), range_max_m, floor_m)[2]


def test_walls_are_told_from_bars_and_a_cloud_without_order_has_none():
    scan, bar, wall = over(4.0, 240)
    found = pixels_on_surfaces(scan, used(scan))
    assert not found[bar].any()
    assert found[wall & ~bar].mean() > 0.95
    assert not pixels_on_surfaces(scan.reshape(-1, 3), used(scan)).any()
    assert not pixels_on_surfaces(scan[:2], used(scan[:2])).any()


def test_what_is_out_of_range_or_below_the_floor_does_not_count():
    scan, *_ = over(4.0, 240)
    assert not pixels_on_surfaces(scan, used(scan, range_max_m=3.9)).any()  # only the strip is in range
    assert not pixels_on_surfaces(scan, used(scan, floor_m=10.0)).any()
    strip_alone = over(4.0, 0)[0]
    assert not pixels_on_surfaces(strip_alone, used(strip_alone)).any()


def test_points_beside_a_surface_join_it_with_its_normal():
    x, y = np.meshgrid(np.arange(-1, 1, 0.05), np.arange(-1, 1, 0.05))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    bar = np.column_stack([np.zeros((21, 2)), np.linspace(0.0, 1.0, 21)])
    bars, surfaces, normal = parted(np.concatenate([bar, [[1.2, 0.0, 0.01], [3.5, 0.0, 0.0]]]), ground)
    assert (bars[:-1, 2] >= ASIDE_M).all()
    assert bars[-1] == pytest.approx([3.5, 0.0, 0.0])  # too far from what is known to be ground
    assert len(bars) + len(surfaces) == len(ground) + 23
    assert np.abs(normal[:, 2]) == pytest.approx(np.ones(len(surfaces)))
    assert within_plane(normal[:1])[0] == pytest.approx([1, 0, 0, 1, 0, 0], abs=1e-9)
    assert len(parted(np.zeros((0, 3)), ground)[0]) == 0


class Thinned(CloudOdometry):
    """A user's odometry, which registers every other point."""

    def preprocessed(self, scan, T_world_drone):
        return super().preprocessed(scan, T_world_drone)[::2]


def test_a_subclass_may_choose_among_the_points():
    odometry = Thinned(OdometrySettings.preset("best", overrides={"preprocess.floor_m": -10.0}))
    scan, *_ = over(4.0, 240)
    for k in range(3):
        step = odometry.update(Scan(0.2 * k, scan), np.eye(4))
    assert step.used
    assert np.isfinite(step.T_world_drone).all()


def test_ground_in_view_costs_little_accuracy():
    settings = ExperimentSettings.preset("zigzag", "random-walk", "best", "starling2", 11, 5.0, tower="slender")
    flight, truth = simulate(settings)
    cut, whole = (
        estimate(settings.override({"preprocess.floor_m": floor_m}), flight, truth).metrics["ate_rmse_m"]
        for floor_m in (settings.odometry.preprocess.floor_m, -10.0)
    )
    assert whole < 1.25 * cut  # 1.5 to 3 times as large when ground was taken for bars
