"""The final reconstruction of made-up clouds and of simulated scans."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.experiment import simulate
from steelnb.fusion import reconstruct
from steelnb.fusion.bars import VOXEL_M, Ridges, find_bars
from steelnb.metrics.segments import match_members
from steelnb.metrics.structure import reference, score_structure
from steelnb.points import VoxelMap
from steelnb.settings import ExperimentSettings, StructureSettings
from steelnb.simulation.mesh import ON_PLATE
from steelnb.simulation.truth import SliceCounter
from tests.fusion.made import around, small_tower
from tests.lattice import with_plate

WALL_X_M = 2.2
CORNERS = np.array([(0, 0, 0), (2, 0, 0), (0, 0, 3), (2, 0, 3)], dtype=float)
FRAME = CORNERS[[(0, 2), (1, 3), (2, 3), (0, 3), (0, 1)]]


def tube(start, end, rng, spacing=0.004, sigma=0.012):
    share = rng.random((int(np.linalg.norm(end - start) / spacing), 1))
    return start + share * (end - start) + sigma * rng.standard_normal((len(share), 3))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.8, 1.4), st.floats(-np.pi, np.pi))
def test_a_frame_is_found_wherever_it_stands(seed, size, yaw):
    """Five noisy bars of 1.6 to 5 m."""
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.from_rotvec([0, 0, yaw]), rng.uniform(-20, 20, 3)
    bars = (turn.apply((size * FRAME).reshape(-1, 3)) + shift).reshape(-1, 2, 3)
    cloud = np.concatenate([tube(*bar, rng) for bar in bars])
    voxels = VoxelMap(VOXEL_M)
    voxels.insert(cloud)
    found = find_bars(Ridges.of(voxels))[0]
    long = found.take(found.length > 0.5)  # where bars meet, a piece of one may be left
    match = match_members(long, bars, distance_max_m=0.03)
    assert {0, 1, 2, 3, 4} <= {*match.member}
    assert match.right.sum() <= 6
    assert np.median(match.offset_m[match.right]) < 0.01


def test_a_flight_without_scans_is_refused():
    with pytest.raises(InputError, match="without a return"):
        reconstruct([], np.zeros((0, 4, 4)))


@pytest.fixture(scope="module")
def flown():
    """Scans of 12 s around the tower, their true poses, the structure reconstructed at them, and the truth."""
    flight, truth = simulate(ExperimentSettings.preset("loops", "none", seed=11, duration_s=12.0, method="best"))
    poses = truth.trajectory.at(flight.scans.stamp_s).T_world_drone
    return flight, poses, rebuilt(flight, poses), reference(truth.tower, truth.visibility)


def rebuilt(flight, poses, adjust=False):
    return reconstruct(flight.scans, poses, flight.T_drone_sensor, StructureSettings(adjust=adjust))


@pytest.mark.slow
def test_a_flight_gives_right_bars_and_adjusting_undoes_a_drift(flown):
    flight, poses, true, visible = flown
    # Poses that slide away by 3 cm after the first five seconds.
    slid = poses.copy()
    slid[:, :3, 3] += np.clip((np.arange(len(poses)) - 25) / len(poses), 0, 1)[:, None] * [0.02, -0.02, 0.015]
    structures = {"true": true, "slid": rebuilt(flight, slid), "adjusted": rebuilt(flight, slid, adjust=True)}
    metrics = {name: score_structure(structure, visible).metrics for name, structure in structures.items()}
    assert metrics["true"]["precision"] > 0.9
    assert metrics["true"]["recall"] > 0.7
    assert metrics["true"]["offset_median_m"] < 0.006
    assert metrics["true"]["end_median_m"] < 0.03
    assert metrics["adjusted"]["offset_median_m"] < metrics["slid"]["offset_median_m"]


@pytest.mark.slow
def test_poses_that_move_take_the_structure_along(flown):
    """At another position and heading, voxels and blocks differ: same bars to a few millimetres, except weak ones."""
    flight, poses, true, _ = flown
    rng, T = np.random.default_rng(1), np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]).as_matrix()
    T[:2, 3] = rng.uniform(-50, 50, 2)
    one, other = true.segments, rebuilt(flight, T @ poses).segments
    assert len(other) == pytest.approx(len(one), rel=0.1)
    match = match_members(one.transformed(T), np.stack([other.start, other.end], axis=1), distance_max_m=0.05)
    assert match.right.mean() > 0.9
    assert np.nanmedian(match.offset_m) < 0.003


def before_a_wall(tower):
    """The tower with a wall of 10 m by 6 m behind it."""
    return with_plate(tower, np.array([[WALL_X_M, y, z] for y in (-5.0, 5.0) for z in (0.0, 6.0)]))


@pytest.mark.slow
def test_ground_and_a_wall_behind_the_tower_have_no_bars_and_take_none_away():
    tower = small_tower()
    alone, walled = (around(each, 30, 0.01, 1) for each in (tower, before_a_wall(tower)))
    bars, beside = (
        reconstruct(flight.scans, flight.prior.T_world_drone, settings=StructureSettings(floor_m=floor_m)).segments
        for flight, floor_m in ((alone, 0.2), (walled, -1.0))
    )
    on_wall = np.abs(beside.middle[:, 0] - WALL_X_M) < 0.3
    on_ground = np.maximum(beside.start[:, 2], beside.end[:, 2]) < 0.15
    assert not (on_wall | on_ground).any()
    match = match_members(bars, np.stack([beside.start, beside.end], axis=1), distance_max_m=0.03)
    assert match.right.mean() > 0.9
    assert len(beside) <= 1.1 * len(bars)


def test_a_bare_wall_has_no_bars_and_the_reason_says_where_its_points_are():
    walled = before_a_wall(small_tower())
    on_wall = walled.triangle_member == ON_PLATE
    wall = replace(walled, triangles=walled.triangles[on_wall], triangle_member=walled.triangle_member[on_wall])
    flight = around(wall, 20, 0.01, 1)
    found = reconstruct(flight.scans, flight.prior.T_world_drone)
    assert not len(found)
    assert "on surfaces" in found.reason


@pytest.mark.slow
def test_axes_are_more_accurate_with_the_thickness_of_the_sections():
    """Flanges a seventh thick, the thickest that are rolled: known, or estimated by an adjustment."""
    tower = small_tower(0.12 / 7, 0.072 / 7)
    flight, axes = around(tower, 30, 0.01, 1), reference(tower, SliceCounter(tower.axes).visibility()).axes
    given = {"usual": {}, "known": {"thickness": 1 / 7}, "adjusted": {"adjust": True}}
    offset_m = {}
    for name, values in given.items():
        found = reconstruct(flight.scans, flight.prior.T_world_drone, settings=StructureSettings(**values))
        offset_m[name] = np.nanmedian(match_members(found.segments, axes).offset_m)
    assert offset_m["known"] < 0.8 * offset_m["usual"]
    assert offset_m["adjusted"] < offset_m["usual"]
