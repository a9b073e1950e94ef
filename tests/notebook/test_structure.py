"""Distances towards the sensor; notebook 07 tests the rest of `notebook.structure`."""

import numpy as np

from steelnb.core.types import Segments
from steelnb.notebook.structure import fly_tower
from steelnb.settings import ExperimentSettings


def test_a_bar_moved_to_the_sensor_is_nearer_by_as_much():
    overrides = {"tof.columns": 90, "tof.rows": 120}
    settings = ExperimentSettings.preset("zigzag", method="none", seed=11, duration_s=12.0, overrides=overrides)
    source = fly_tower("tapered", settings)
    begin, end = source.reference.axes[:, 0], source.reference.axes[:, 1]
    count = len(begin)
    member = np.arange(count)

    def nearer(shift):
        bars = Segments(begin + shift, end + shift, np.full(count, 100), np.full(count, 0.01))
        return source.toward_sensor_m(bars, member)

    still = nearer(np.zeros(3))[source.reference.observed]
    assert np.isnan(still).mean() < 0.5  # of some members the middle was out of range
    np.testing.assert_allclose(still[np.isfinite(still)], 0, atol=1e-9)
    # To a drone at negative x, the rings that run along y are nearer when they move towards it.
    drone = source.poses["true"][:, :3, 3].mean(axis=0)
    away = np.array([*(drone - source.result.truth.tower.vertices.mean(axis=0))[:2], 0])
    moved = nearer(0.01 * away / np.linalg.norm(away))[source.reference.observed]
    # No bar by more than the shift, those across the view by all of it.
    assert np.nanmax(moved) <= 0.01 + 1e-9
    assert np.nanpercentile(moved, 90) > 0.009
    assert np.isnan(source.toward_sensor_m(Segments(begin, end, member, member * 1.0), np.full(count, -1))).all()
