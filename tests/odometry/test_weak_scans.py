"""Never worse than the drift: scans that determine the pose poorly, or only in some directions."""

import numpy as np
import pytest

from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.odometry import make_odometry, run
from steelnb.settings import OdometrySettings, TofSettings
from steelnb.simulation.raycasting import rays
from steelnb.simulation.tof import measured_ranges

X_M, SCANS = 2.0, 40


def before_a_wall(sensor, seed, corner=False, **changed):
    """A flight back and forth in front of a wall at x = 2 m, or in its corner with the ground and a second wall. Its
    drift is a random walk of twice the report's. Returns the flight and the true positions."""
    g = np.random.default_rng(seed)
    half = {"columns": 90, "rows": 120} if sensor == "starling2" else {}
    tof = TofSettings.preset(sensor).replace(**half | changed)
    ray, stamp_s = rays(tof), 0.2 * np.arange(SCANS)
    wide_m = 0.5 if corner else 1.5
    true = np.column_stack(
        [0.2 * np.sin(0.13 * stamp_s), wide_m * np.sin(0.2 * stamp_s), 1.5 + 0.3 * np.sin(0.1 * stamp_s)]
    )
    walls = [(0, X_M)] + ([(2, 0.6), (1, 1.1)] if corner else [])
    scans = []
    for place, at_s in zip(true, stamp_s, strict=True):
        with np.errstate(divide="ignore"):
            away = np.stack([(at - place[axis]) / ray[..., axis] for axis, at in walls])
        away = np.where(away > 0, away, np.inf).min(axis=0)
        scans.append(Scan(float(at_s), measured_ranges(away, tof, g)[..., None] * ray))
    T = np.tile(np.eye(4), (SCANS, 1, 1))
    T[:, :3, 3] = true + np.cumsum(g.normal(0, 0.02, (SCANS, 3)) * (stamp_s > 0)[:, None], axis=0)
    return Flight(scans, Trajectory(stamp_s, T), np.eye(4)), true


def ate_m(poses, true, axes=(0, 1, 2)):
    return float(np.sqrt(((poses.position - true)[:, axes] ** 2).sum(axis=1).mean()))


def fly(flight, method, sensor):
    return run(flight, make_odometry(OdometrySettings.preset(method, sensor), np.eye(4)))


@pytest.mark.parametrize(
    ("method", "sensor"),
    [("best", "starling2"), ("faces", "starling2"), ("best", "report-4cm")],
)
def test_before_a_wall_the_distance_is_corrected_and_along_it_the_prior_is_followed(method, sensor):
    flight, true = before_a_wall(sensor, seed=1)
    estimate = fly(flight, method, sensor)
    assert ate_m(estimate.corrected, true) <= 1.02 * ate_m(flight.prior, true)
    assert ate_m(estimate.corrected, true, [0]) < 0.5 * ate_m(flight.prior, true, [0])
    assert (estimate.unobserved[1:] == 2).mean() > 0.95


def test_in_a_corner_every_direction_is_corrected():
    flight, true = before_a_wall("starling2", seed=2, corner=True)
    flight, true = flight.first(30), true[:30]
    estimate = fly(flight, "best", "starling2")
    assert ate_m(estimate.corrected, true) < 0.3 * ate_m(flight.prior, true)
    assert (estimate.unobserved == 0).all()


@pytest.mark.parametrize("method", ["best", "faces"])
def test_eight_by_eight_pixels_follow_the_prior_and_say_so(method):
    flight, _ = before_a_wall("starling2", seed=3, columns=8, rows=8)
    estimate = fly(flight, method, "starling2")
    np.testing.assert_allclose(estimate.corrected.T_world_drone, flight.prior.T_world_drone, atol=1e-9)
    assert set(estimate.reason) == {"too few points"}


def test_methods_without_a_stated_uncertainty_of_the_prior_use_every_scan_as_the_report_did():
    flight, _ = before_a_wall("starling2", seed=1)
    estimate = fly(flight.first(20), "gicp-4dof", "starling2")
    assert not estimate.unobserved.any()
    assert not any(estimate.reason[1:])
