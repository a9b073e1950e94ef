"""Changes of a small tower, told from scans of it at true poses."""

import numpy as np
import pytest

from steelnb import find_changes
from steelnb.errors import InputError
from steelnb.fusion import Structure
from steelnb.fusion.changes import holm
from steelnb.settings import StructureSettings
from steelnb.simulation import changed_tower
from tests.fusion.made import around, small_tower, true_structure

SETTINGS = StructureSettings(floor_m=0.1)
POSES = 80


@pytest.fixture(scope="module")
def tower():
    return small_tower()


def front(tower, kind: str) -> list[int]:
    """Members of a kind in the face before which the flight is, lowest first."""
    middle = tower.axes.mean(axis=1)
    found = [m for m, member in enumerate(tower.members) if member.kind == kind and middle[m, 0] < -0.6]
    return sorted(found, key=lambda m: middle[m, 2])


@pytest.fixture(scope="module")
def found(tower):
    """A brace gone, one moved by 3 cm, one bent by 4 cm, and the members before which that was done."""
    removed, moved, bent = front(tower, "bracing")[1:4]
    now = changed_tower(tower, [removed], {moved: np.array([-0.03, 0, 0])}, {bent: np.array([0.04, 0, 0])})
    flight = around(now, POSES, noise_m=0.01)
    changes = find_changes(true_structure(tower), flight.scans, flight.prior.T_world_drone, settings=SETTINGS)
    return changes, removed, moved, bent


def test_each_change_is_told(found):
    changes, removed, moved, bent = found
    assert [changes.kind[m] for m in (removed, moved, bent)] == ["missing", "moved", "bent"]
    assert changes.offset_m[moved] == pytest.approx(0.03, abs=0.008)
    assert changes.offset_m[bent] == pytest.approx(0.04, abs=0.012)
    assert np.isnan(changes.offset_m[removed])
    assert (changes.significance[[removed, moved, bent]] < 0.01).all()


def test_nothing_else_has_changed(found):
    changes, *changed = found
    others = {kind for m, kind in enumerate(changes.kind) if m not in changed}
    assert others <= {"same", "not seen"}
    assert len(changes.of("same")) > 10


def test_an_unchanged_tower_has_no_changes(tower):
    flight = around(tower, POSES, noise_m=0.01, seed=2)
    changes = find_changes(true_structure(tower), flight.scans, flight.prior.T_world_drone, settings=SETTINGS)
    assert set(changes.kind) <= {"same", "not seen"}
    same = changes.of("same")
    assert (changes.significance[same] > 0.01).all()


def test_hidden_and_distant_bars_are_not_missing(tower):
    flight = around(tower, 10, turn_rad=0.05)
    changes = find_changes(true_structure(tower), flight.scans, flight.prior.T_world_drone, settings=SETTINGS)
    assert not len(changes.of("missing"))
    away = flight.prior.T_world_drone.copy()
    away[:, :3, :3] = away[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])  # looking away, with the sky before it
    blank = [type(scan)(scan.stamp_s, np.full_like(scan.points, np.nan)) for scan in flight.scans]
    nothing = find_changes(true_structure(tower), blank, away, settings=SETTINGS)
    assert set(nothing.kind) == {"not seen"}
    assert np.isnan(nothing.significance).all()


def test_a_bar_that_the_map_does_not_hold_is_new(tower):
    flight = around(tower, POSES, noise_m=0.01)
    unknown = front(tower, "leg")[0]
    known = true_structure(tower)
    rest = np.arange(len(known)) != unknown
    less = Structure(known.segments.take(rest), known.width_m[rest], known.sightings[rest], known.sigma_m[rest],
                     known.joint, known.tie, opening=known.opening[rest])  # fmt: skip
    changes = find_changes(less, flight.scans, flight.prior.T_world_drone, settings=SETTINGS)
    assert len(changes.new) >= 1
    apart = changes.new.segments.middle[0] - known.segments.start[unknown]
    axis = known.segments.direction[unknown]
    assert np.linalg.norm(apart - apart @ axis * axis) < 0.06
    assert changes.kind[len(less) :] == ("new",) * len(changes.new)
    assert (changes.significance[len(less) :] < 0.01).all()


def test_a_map_without_bars_is_refused(tower):
    flight = around(tower, 2)
    with pytest.raises(InputError, match="no bars"):
        find_changes(Structure.empty(), flight.scans, flight.prior.T_world_drone)


def test_poses_that_do_not_fit_the_scans_are_refused(tower):
    flight = around(tower, 2)
    with pytest.raises(InputError, match=r"shape \(1, 4, 4\): expected \(2, 4, 4\)"):
        find_changes(true_structure(tower), flight.scans, flight.prior.T_world_drone[:1])


def test_holm_is_the_step_down_of_bonferroni():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
