"""A walk along a line visits the points near the line, and few others."""

import numpy as np
import pytest
from numba import config

from steelnb.hough.near_segments import Cubes, Line, sort_into_cubes, walk

JIT = not config.DISABLE_JIT
AHEAD = np.array([1.0, 2.0, -2.0]) / 3


def points_on_walk(cubes: Cubes, at: np.ndarray, along: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Indices of the points that a walk visits, once per visit."""
    visited, near = np.zeros(len(cubes.first), np.int64), np.empty(2 * len(cubes.px), np.int64)
    return cubes.order[near[: walk(cubes, Line(*at, *along, begin, end), visited, near)]]


def distances(points: np.ndarray, at: np.ndarray, along: np.ndarray, begin: float, end: float) -> np.ndarray:
    t = np.clip((points - at) @ along, begin, end)[:, None]
    return np.linalg.norm(points - at - t * along, axis=1)


@pytest.mark.kernels
@pytest.mark.parametrize("distance", [0.03, 0.2, 3.0])
@pytest.mark.parametrize("along", [AHEAD, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.6, 0.8])])
def test_a_walk_visits_all_points_near_the_line_once(distance: float, along: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    points = np.array([300.0, 0, -7]) + rng.uniform(-1, 1, (4000 if JIT else 100, 3))
    cubes = sort_into_cubes(points, distance)
    for at in points[: 20 if JIT else 2] + rng.normal(0, 0.05, (20 if JIT else 2, 3)):
        for begin, end in ((0.0, 0.7), (-5.0, 5.0), (0.2, 0.2), (-1e9, 1e9)):
            found = points_on_walk(cubes, at, along, begin, end)
            assert len(found) == len(set(found.tolist()))
            near = distances(points, at, along, begin, end) <= distance
            assert set(np.flatnonzero(near).tolist()) <= set(found.tolist())


def test_a_walk_does_not_visit_points_far_from_the_line() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (3000, 3))
    alone = points_on_walk(sort_into_cubes(points, 0.05), np.zeros(3), AHEAD, -0.5, 0.5)
    assert 0 < len(alone) < len(points) / 10
    row = np.concatenate([points + np.array([shift, 0, 0]) for shift in (0.0, 4.0, -8.0, 512.0)])
    among = points_on_walk(sort_into_cubes(row, 0.05), np.zeros(3), AHEAD, -0.5, 0.5)
    assert len(among) < 2 * len(alone)
    near = np.flatnonzero(distances(points, np.zeros(3), AHEAD, -0.5, 0.5) <= 0.05)
    assert set(near.tolist()) <= set(among.tolist())


@pytest.mark.kernels
def test_a_walk_through_no_points_and_through_identical_points() -> None:
    assert len(points_on_walk(sort_into_cubes(np.zeros((0, 3)), 0.1), np.zeros(3), AHEAD, -1, 1)) == 0
    cubes = sort_into_cubes(np.ones((5, 3)), 1e-7)
    assert sorted(points_on_walk(cubes, np.ones(3), AHEAD, -30.0, 30.0).tolist()) == [0, 1, 2, 3, 4]
    assert len(points_on_walk(cubes, np.zeros(3), AHEAD, -1e9, 1e9)) == 0
