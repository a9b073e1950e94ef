import numpy as np
import pytest

from steelnb.planning import Planner
from steelnb.planning.coverage import ABOVE, BELOW, SCANS_MIN, SECTORS, STUCK_S, TWO_SIDES, Coverage
from steelnb.planning.planner import CLEARANCE_M
from steelnb.points import VoxelMap
from tests.planning.test_planner import AROUND, CAMERA, clearance, column, fly, pose, tower


def seen_from(steel: np.ndarray, *places: tuple[float, float, float]) -> tuple[Coverage, VoxelMap]:
    """Coverage of some steel that was seen, as often as it takes to count, from each of some places."""
    coverage, voxels = Coverage(CAMERA, 1.4, 0.75, (0.7, 3.0)), VoxelMap(0.1)
    for place in places:
        for _ in range(SCANS_MIN):
            coverage.add(voxels, voxels.insert(steel), np.array(place))
    return coverage, voxels


def test_two_sides_are_those_with_a_sector_between_them():
    assert not TWO_SIDES[0]
    for k in range(SECTORS):
        assert not TWO_SIDES[1 << k]
        assert not TWO_SIDES[1 << k | 1 << (k + 1) % SECTORS]
        assert TWO_SIDES[1 << k | 1 << (k + 2) % SECTORS]
        assert TWO_SIDES[1 << k | 1 << (k + SECTORS // 2) % SECTORS]
    assert TWO_SIDES[-1]


@pytest.mark.parametrize(
    ("places", "share"),
    [
        ([(0.4, -2.4, 1.0)], 0.0),
        ([(0.4, -2.4, 1.0), (2.0, -1.4, 1.0)], 0.0),
        ([(0.4, -2.4, 1.0), (2.4, 0.4, 1.0)], 1.0),
        ([(0.4, -2.4, 1.0), (-0.4, 2.4, 1.0)], 1.0),
    ],
)
def test_a_column_counts_as_seen_when_it_was_looked_at_from_two_sides(places, share):
    coverage, _ = seen_from(column(0, 0), *places)
    assert coverage.share() == pytest.approx(share, abs=0.02)
    assert coverage.summary().startswith(f"{share:.0%} of what is mapped")


def test_what_noise_fills_once_does_not_count():
    coverage, voxels = seen_from(column(0, 0), (0.4, -2.4, 1.0), (-0.4, 2.4, 1.0))
    before = coverage.share()
    coverage.add(voxels, voxels.insert(column(0.4, 0.4)), np.array([0.0, -2.4, 1.0]))
    assert coverage.share() == before > 0.9


def test_the_next_viewpoint_is_on_a_side_from_which_nothing_was_seen_yet():
    steel, place = column(0, 0, half_m=1.0), np.array([0.0, -2.4, 1.0])
    coverage, voxels = seen_from(steel, tuple(place))
    target = coverage.update(0.0, voxels, place)
    assert target is not None
    out = target.position[:2] / np.linalg.norm(target.position[:2])
    assert out[1] > -0.9, "not where it is"
    assert 2.0 < np.linalg.norm(target.position[:2]) < 3.2, "at the standoff from the structure"
    assert coverage.update(1.0, voxels, place) is target, "until it has been there"
    assert target.turn(place) == pytest.approx((target.azimuth + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi, abs=0.05)


def test_a_viewpoint_that_comes_no_nearer_is_out_of_reach_and_named():
    place = np.array([0.0, -2.4, 1.0])
    coverage, voxels = seen_from(column(0, 0, half_m=1.0), tuple(place))
    first = coverage.update(0.0, voxels, place)
    assert coverage.update(0.1, voxels, place) is first
    assert coverage.update(STUCK_S, voxels, place) is first
    second = coverage.update(STUCK_S + 0.2, voxels, place)
    assert second is not None
    assert not np.array_equal(second.position, first.position)
    assert [each.tolist() for each in coverage.out_of_reach] == [first.position.tolist()]
    assert ", ".join(f"{x:.1f}" for x in first.position) in coverage.summary()


def test_a_camera_above_and_one_below_see_other_sides():
    coverage, _ = seen_from(np.array([[0.0, 0.0, 1.5]]), (0.0, -2.0, 2.5), (0.0, -2.0, 0.5))
    assert coverage._sides[0] & (ABOVE | BELOW) == ABOVE | BELOW
    assert coverage.share() == 0.0


def test_it_flies_until_all_has_been_seen_and_says_so():
    steel = tower(half_m=1.0)
    steel = steel[steel[:, 2] < 3.0]
    planner = Planner(AROUND.replace(planner={"goal": "whole"}, height_max_m=2.5), CAMERA)
    poses, decisions = fly(planner, steel, pose(0, -2.4, 0.7, np.pi / 2), 200.0)
    assert decisions[-1].state == "end"
    assert "seen from two sides" in decisions[-1].reason
    assert planner.coverage.share() > 0.9
    assert len(poses) < 1500, "before its time is over"
    azimuth = np.arctan2(poses[:, 1, 3], poses[:, 0, 3])
    assert len(np.unique(np.round(azimuth / (np.pi / 2)))) >= 4, "from all around"
    assert clearance(poses, steel) > CLEARANCE_M
