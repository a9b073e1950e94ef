import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.planning.planner import CLEARANCE_M, SEARCH_STOP_S, SEARCH_TURN_S, Planner
from steelnb.settings import FlightSettings

TAN_HORIZONTAL, TAN_VERTICAL, RANGE_M = 0.93, 1.32, 6.0
AROUND = FlightSettings.preset("planned")
FACE = AROUND.replace(goal="face", standoff_m=1.2, speed_m_s=0.5, levels=4)
PERIOD_S = 0.1


def planner_of(flight: FlightSettings) -> Planner:
    return Planner(flight, 2 * np.arctan(TAN_HORIZONTAL), RANGE_M)


def pose(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    T, c, s = np.eye(4), np.cos(yaw), np.sin(yaw)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], (x, y, z)
    return T


def column(x: float, y: float, half_m: float = 0.0) -> np.ndarray:
    """Points of four uprights, 10 m high, at the corners of a square, or of one upright if ``half_m`` is 0."""
    z = np.arange(0.3, 10.0, 0.05)
    corners = [(-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)] if half_m else [(0, 0)]
    sides = [(0.03 * dx, 0.03 * dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    return np.concatenate(
        [np.column_stack([np.full(len(z), x + cx + sx), np.full(len(z), y + cy + sy), z])
         for cx, cy in corners for sx, sy in sides]
    )  # fmt: skip


def tower(half_m: float) -> np.ndarray:
    """Four uprights with a ring of bars every 0.8 m."""
    t = np.arange(-half_m, half_m, 0.05)
    rings = []
    for z in np.arange(0.8, 10.0, 0.8):
        for side in (-half_m, half_m):
            rings += [np.column_stack([t, np.full(len(t), side), np.full(len(t), z)]),
                      np.column_stack([np.full(len(t), side), t, np.full(len(t), z)])]  # fmt: skip
    return np.concatenate([column(0, 0, half_m), *rings])


def visible(steel: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points of the steel that the camera sees, drone frame."""
    seen = (steel - T[:3, 3]) @ T[:3, :3]
    ahead = np.maximum(seen[:, 0], 1e-6)
    inside = (np.abs(seen[:, 1]) < TAN_HORIZONTAL * ahead) & (np.abs(seen[:, 2]) < TAN_VERTICAL * ahead)
    return seen[inside & (np.linalg.norm(seen, axis=1) < RANGE_M)]


def fly(planner: Planner, steel: np.ndarray, T: np.ndarray, seconds: float, blind=lambda stamp_s: False):
    """A drone that follows each command immediately: its poses ``(K, 4, 4)`` and the decisions."""
    poses, decisions = [], []
    for k in range(round(seconds / PERIOD_S)):
        if k % 2 == 0:
            seen = np.zeros((0, 3)) if blind(k * PERIOD_S) else visible(steel, T)
            planner.see(seen, T, Segments.empty())
        decision = planner.decide(k * PERIOD_S, T)
        yaw = np.arctan2(T[1, 0], T[0, 0]) + decision.yaw_rate * PERIOD_S
        T = pose(*(T[:3, 3] + T[:3, :3] @ decision.velocity * PERIOD_S), yaw)
        poses.append(T)
        decisions.append(decision)
        if decision.state == "end":
            break
    return np.array(poses), decisions


def clearance(poses: np.ndarray, steel: np.ndarray) -> float:
    return min(float(np.linalg.norm(steel - T[:3, 3], axis=1).min()) for T in poses)


def test_around_a_tower_it_keeps_its_distance_and_faces_the_tower():
    steel = tower(half_m=1.0)
    poses, decisions = fly(planner_of(AROUND), steel, pose(0, -2.4, 0.7, np.pi / 2), 60.0)
    position = poses[:, :3, 3]
    azimuth = np.unwrap(np.arctan2(position[:, 1], position[:, 0]))
    assert azimuth[-1] - azimuth[0] > 2.2 * np.pi
    assert {each.state for each in decisions} == {"follow"}
    to_axis = -position[:, :2] / np.linalg.norm(position[:, :2], axis=1)[:, None]
    assert (poses[:, :2, 0] * to_axis).sum(axis=1).min() > np.cos(np.radians(40))
    assert clearance(poses, steel) > 0.8
    assert np.linalg.norm(position[:, :2], axis=1).max() < 4.5
    np.testing.assert_allclose(position[-1, 2] - 0.7, 60 / 200 * 6.3, atol=0.15)


def test_in_front_of_a_face_it_turns_back_at_both_edges_and_climbs():
    steel = tower(half_m=1.5)
    poses, _ = fly(planner_of(FACE), steel, pose(0, -2.7, 0.7, np.pi / 2), 90.0)
    position = poses[:, :3, 3]
    assert position[:, 0].min() < -0.5
    assert position[:, 0].max() > 0.5
    assert np.abs(position[:, 0]).max() < 3.5
    assert position[-1, 2] > 2.5
    assert clearance(poses, steel) > 0.8
    assert poses[:, 1, 0].min() > 0.95  # the heading of the start


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_it_does_not_hit_mapped_obstacles(seed):
    random = np.random.default_rng(seed)
    steel = np.concatenate([tower(half_m=1.0), *(column(*random.uniform(-4, 4, 2)) for _ in range(3))])
    start = pose(*random.uniform(-5, 5, 2), 1.0, random.uniform(-np.pi, np.pi))
    if clearance(start[None], steel) < 1.0:
        return
    planner, nearest = planner_of(AROUND), []
    decide = planner.decide

    def watched(stamp_s, T):
        """Record the distances to the mapped points, before this decision and after it."""
        known, decision = planner.map.means(), decide(stamp_s, T)
        then = T[:3, 3] + T[:3, :3] @ decision.velocity * PERIOD_S
        nearest.append([np.linalg.norm(known - at, axis=1).min(initial=np.inf) for at in (T[:3, 3], then)])
        return decision

    planner.decide = watched
    fly(planner, steel, start, 15.0)
    before, after = np.array(nearest).T
    # An obstacle that appears within the clearance is not approached further.
    assert (after > np.minimum(CLEARANCE_M - 0.05, before - 0.02)).all()


def test_new_obstacles_of_a_scan_count_at_once():
    planner, T = planner_of(AROUND), pose(0, -2.4, 1.0, np.pi / 2)
    steel = tower(half_m=1.0)
    fly(planner, steel, T, 1.0)
    obstacle = np.array([[0.3, -0.2, 0.0]])  # nearer than the clearance, too little to be mapped
    planner.see(obstacle, T, Segments.empty())
    decision = planner.decide(1.1, T)
    assert decision.velocity @ obstacle[0] < 0


@pytest.mark.parametrize("goal", ["around", "face"])
def test_a_map_out_of_reach_is_lost_sight(goal):
    wall = np.stack(np.broadcast_arrays(1.5, *np.mgrid[-1:1:0.1, -1:1:0.1]), axis=-1).reshape(-1, 3)
    T = pose(0, 0, 2, 0)
    for reach_m, at in ((0.5, T), (RANGE_M, pose(1000, 0, 2, 0))):
        planner = Planner(AROUND.replace(goal=goal), 1.2, reach_m)
        planner.see(wall, T, Segments.empty())
        decisions = [planner.decide(stamp_s, at) for stamp_s in (0.1, 0.2 + SEARCH_STOP_S)]
        assert [each.state for each in decisions] == ["stop", "return"]
        assert decisions[1].velocity[0] <= 0
        planner.see(wall, at, Segments.empty())
        assert planner.decide(2.0, at).state == ("return" if reach_m < 1 else "follow")


def test_it_waits_for_a_scan_and_turns_until_it_sees_a_structure():
    assert planner_of(AROUND).decide(0.0, pose(0, 0, 1, 0)).state == "wait"
    _, decisions = fly(planner_of(AROUND), tower(half_m=1.0), pose(0, -2.4, 0.7, -np.pi / 2), 15.0)
    assert (decisions[0].state, decisions[-1].state) == ("search", "follow")


def test_with_nothing_in_sight_it_turns_once_and_ends():
    poses, decisions = fly(planner_of(AROUND), np.zeros((0, 3)), pose(0, 0, 1, 0), 30.0)
    assert decisions[-1].state == "end"
    assert {each.state for each in decisions[:-1]} == {"search"}
    assert np.ptp(poses[:, :3, 3], axis=0).max() == 0
    assert np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))[-1] == pytest.approx(2 * np.pi, abs=0.2)


def test_after_loss_of_sight_it_stops_turns_and_returns_until_it_sees_the_structure():
    steel, planner = tower(half_m=1.0), planner_of(AROUND)
    end = 5.0 + SEARCH_STOP_S + SEARCH_TURN_S + 3.0
    poses, decisions = fly(
        planner, steel, pose(0, -2.4, 0.7, np.pi / 2), end + 2.0, blind=lambda stamp_s: 5.0 <= stamp_s < end
    )
    states = [each.state for each in decisions]
    assert [name for k, name in enumerate(states) if k == 0 or states[k - 1] != name] == [
        "follow", "stop", "turn", "return", "follow",
    ]  # fmt: skip
    at = lambda stamp_s: poses[round(stamp_s / PERIOD_S), :3, 3]  # noqa: E731
    assert np.linalg.norm(at(end - 3.1) - at(5.2)) < 0.05
    was = poses[: round(5.0 / PERIOD_S), :3, 3]
    assert np.linalg.norm(was - at(end - 0.1), axis=1).min() < 0.3
    assert np.linalg.norm(at(end - 0.1) - at(5.2)) > 0.3
