import numpy as np
import pytest

from steelnb.errors import InputError
from steelnb.report import planned_flights
from steelnb.simulation import build_tower

SMALL = {"tof.rows": 24, "tof.columns": 24}


@pytest.fixture(scope="module")
def flown():
    cases = planned_flights.make_flights(["loops", "up a face"], "random-walk", "combined", "report-4cm", 3, 4.0, SMALL)
    return planned_flights.fly_all(cases)


def test_each_flight_is_of_its_kind(flown):
    loops, face = (flown[name].result.settings.flight for name in ("loops", "up a face"))
    assert loops.trajectory == "loops"
    assert face.goal == "face"
    assert face.height_max_m == 15.0
    with pytest.raises(InputError, match="unknown 'hole'; expected some of 'zigzag', 'wide loops'"):
        planned_flights.make_flights(["hole"], "none", "combined", "report-4cm", 1, 4.0)


def test_sight_is_that_of_the_true_poses(flown):
    for each in flown.values():
        count = len(each.result.corrected)
        assert len(each.returns) == len(each.seen) == count == 20
        assert (np.diff(each.seen) >= 0).all()
        assert 0.0 < each.seen[-1] < 0.5
        assert (each.returns > 0).all()
        assert (each.returns <= 24 * 24).all()


def test_what_was_seen_agrees_with_the_members_that_were(flown):
    tower = build_tower(flown["loops"].result.settings.tower)
    slices = planned_flights._slices(tower.axes)
    length_m = np.linalg.norm(tower.axes[:, 1] - tower.axes[:, 0], axis=1).sum()
    assert len(slices) == pytest.approx(length_m / planned_flights.SLICE_M, rel=0.05)
    for each in flown.values():
        counted = np.concatenate(each.result.truth.visibility.slices)
        assert each.seen[-1] == pytest.approx((counted > 0).mean(), abs=0.05)


def test_the_table_has_a_row_a_flight(flown):
    table = planned_flights.flight_table(flown)
    assert table["flight"].tolist() == ["loops", "up a face"]
    assert table.notna().all(axis=None)
    assert (table["clearance_m"] > 0.3).all()
    assert table["few_share"].tolist() == [
        float((flown[name].returns < planned_flights.FEW).mean()) for name in ("loops", "up a face")
    ]
