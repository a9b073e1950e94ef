"""Localisation in a known structure, on scans of a small tower."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import KnownStructureOdometry, odometry
from steelnb.errors import InputError
from steelnb.fusion import Structure
from steelnb.odometry.known_structure import FIRST_SCANS
from steelnb.types import Flight, Trajectory
from tests.fusion.made import around, small_tower, true_structure


@pytest.fixture(scope="module")
def tower():
    return small_tower()


@pytest.fixture(scope="module")
def exact(tower):
    return around(tower)


def moved_start(flight: Flight, by=(0.0, 0.0, 0.0), yaw_deg: float = 0.0) -> Flight:
    """The same flight, its prior turned about its first position and then moved."""
    turn, at = np.eye(4), flight.prior.position[0]
    turn[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(yaw_deg)]).as_matrix()
    turn[:3, 3] = at - turn[:3, :3] @ at + by
    return replace(flight, prior=Trajectory(flight.prior.stamp_s, turn @ flight.prior.T_world_drone))


def errors(found: np.ndarray, flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Distances in metres and angles in radians from the true poses."""
    true = flight.prior.T_world_drone
    apart = found[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    return np.linalg.norm((found - true)[:, :3, 3], axis=1), Rotation.from_matrix(apart).magnitude()


def test_scans_without_noise_are_placed_exactly(tower, exact):
    found = odometry.run(exact, KnownStructureOdometry(true_structure(tower)))
    distance, angle = errors(found.corrected.T_world_drone, exact)
    assert not any(found.reason)
    assert distance.max() < 1.5e-3
    assert angle.max() < 1e-3
    assert len(found.segments) == len(tower.members)
    assert len(found.points) > 500


@pytest.mark.parametrize(("by", "yaw_deg"), [((0.45, -0.3, 0.2), 5.0), ((-0.2, 0.48, -0.4), -4.6)])
def test_a_start_half_a_metre_and_five_degrees_off_is_found(tower, exact, by, yaw_deg):
    flight = moved_start(exact.first(4), by, yaw_deg)
    found = odometry.run(flight, KnownStructureOdometry(true_structure(tower)))
    distance, angle = errors(found.corrected.T_world_drone, exact.first(4))
    assert distance.max() < 3e-3
    assert angle.max() < 2e-3


def test_roll_and_pitch_are_found_where_the_prior_may_err(tower, exact):
    tilted = exact.prior.T_world_drone.copy()
    tilted[:, :3, :3] = Rotation.from_rotvec([0.015, -0.012, 0.0]).as_matrix() @ tilted[:, :3, :3]
    flight = replace(exact, prior=Trajectory(exact.prior.stamp_s, tilted))
    kept, found = (
        odometry.run(flight, KnownStructureOdometry(true_structure(tower), tilt_sigma_rad=sigma_rad))
        for sigma_rad in (0.0, 0.02)
    )
    distance, angle = errors(found.corrected.T_world_drone, exact)
    assert distance.max() < 2e-3
    assert angle.max() < 1.5e-3
    assert errors(kept.corrected.T_world_drone, exact)[0].max() > 0.01


def test_range_noise_averages_out(tower):
    flight = around(tower, 6, noise_m=0.01)
    found = odometry.run(flight, KnownStructureOdometry(true_structure(tower)))
    assert errors(found.corrected.T_world_drone, flight)[0].max() < 5e-3


def test_a_map_of_another_place_is_refused(exact):
    lattice = np.random.default_rng(3).uniform((-3, -3, 0), (3, 3, 6), (40, 2, 3))
    elsewhere = Structure(
        replace(true_structure(small_tower()).segments.take(np.zeros(40, dtype=int)), start=lattice[:, 0],
                end=lattice[:, 1]), np.full(40, np.nan), np.full(40, 5), np.full(40, 0.002), np.zeros((0, 3)),
        np.zeros((0, 2), np.int64),
    )  # fmt: skip
    with pytest.raises(InputError, match=rf"\d+ of 40 bars matched in the first {FIRST_SCANS} scans; expected"):
        odometry.run(exact, KnownStructureOdometry(elsewhere))


def test_a_map_far_away_is_refused_and_aligns_nothing(tower, exact):
    steps = []
    estimator = KnownStructureOdometry(true_structure(tower).moved(np.array([200.0, 0, 0])))
    with pytest.raises(InputError, match=rf"0 of {len(tower.members)} bars matched"):
        odometry.run(exact, estimator, lambda k, scan, step: steps.append(step))
    assert len(steps) == FIRST_SCANS - 1
    for k, step in enumerate(steps):
        np.testing.assert_array_equal(step.T_world_drone, exact.prior.T_world_drone[k])
        assert "too little of the map in sight" in step.reason


def test_scans_that_tell_nothing_follow_the_prior_s_increments(tower, exact):
    flight = moved_start(exact, (0.2, 0.1, -0.1), 3.0)
    scans = [exact.scans[k] for k in range(5)]
    scans[2] = replace(scans[2], points=np.full_like(scans[2].points, np.nan))
    scans[3] = replace(scans[3], points=np.zeros((0, 3)))
    found = odometry.run(replace(flight.first(5), scans=scans), KnownStructureOdometry(true_structure(tower)))
    assert found.reason[2] == found.reason[3] == "too few points"
    assert found.reason[4] == ""
    distance, _ = errors(found.corrected.T_world_drone, exact.first(5))
    assert distance.max() < 4e-3  # the increments are true ones here


def test_bars_without_a_section_take_part_as_round_tubes(tower, exact):
    known = true_structure(tower)
    width, opening = known.width_m.copy(), known.opening.copy()
    width[::3], opening[::3] = np.nan, np.nan
    found = odometry.run(exact.first(8), KnownStructureOdometry(replace(known, width_m=width, opening=opening)))
    assert not any(found.reason)
    assert errors(found.corrected.T_world_drone, exact.first(8))[0].max() < 0.01
    alone = odometry.run(exact.first(8), KnownStructureOdometry(replace(known, opening=None)))
    assert errors(alone.corrected.T_world_drone, exact.first(8))[0].max() < 0.04


def test_an_uncertain_bar_counts_less(tower, exact):
    known, far = true_structure(tower), []
    legs = np.array([member.kind == "leg" for member in tower.members])
    shifted = replace(known.segments, start=known.segments.start + 0.02 * legs[:, None],
                      end=known.segments.end + 0.02 * legs[:, None])  # fmt: skip
    for sigma_m in (0.001, 0.03):
        wrong = replace(known, segments=shifted, sigma_m=np.where(legs, sigma_m, 0.001))
        found = odometry.run(exact.first(6), KnownStructureOdometry(wrong))
        far.append(errors(found.corrected.T_world_drone, exact.first(6))[0].mean())
    assert far[1] < 0.6 * far[0]


def test_bad_input_is_named(tower):
    with pytest.raises(InputError, match="no bars; expected at least one"):
        KnownStructureOdometry(Structure.empty("nothing found"))
    with pytest.raises(InputError, match="T_drone_sensor"):
        KnownStructureOdometry(true_structure(tower), np.zeros((4, 4)))
    with pytest.raises(InputError, match="expected \\(N, 3\\)"):
        KnownStructureOdometry(true_structure(tower)).update(np.zeros((4, 2)), np.eye(4))
