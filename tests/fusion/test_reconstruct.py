"""The final reconstruction of made-up clouds and of simulated scans."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.experiment import simulate
from steelnb.fusion import reconstruct, reconstruct_cloud
from steelnb.fusion.scales import Scales
from steelnb.hough.tube import tube_radius
from steelnb.metrics.matching import match_members
from steelnb.metrics.reconstruction import reference, score_structure
from steelnb.settings import ExperimentSettings, StructureSettings
from tests.lattice import lattice, scanned, thinned

CORNERS = np.array([(0, 0, 0), (2, 0, 0), (0, 0, 3), (2, 0, 3)], dtype=float)
FRAME = CORNERS[[(0, 2), (1, 3), (2, 3), (0, 3), (0, 1)]]


def tube(start, end, rng, spacing=0.004, sigma=0.012):
    share = rng.random((int(np.linalg.norm(end - start) / spacing), 1))
    return start + share * (end - start) + sigma * rng.standard_normal((len(share), 3))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.8, 1.4), st.floats(-np.pi, np.pi), st.sampled_from([1.0, 4.0]))
@example(seed=179, size=0.9135084173559536, yaw=0.21875, scale=4.0)  # the longest extension was no length of the scale
def test_a_frame_is_found_with_its_joints_wherever_it_stands_and_however_large(seed, size, yaw, scale):
    """Five noisy bars of 1.6 to 5 m; all lengths, those of the settings too, times ``scale``."""
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.from_rotvec([0, 0, yaw]), rng.uniform(-20, 20, 3)
    corners, frame = (turn.apply((scale * size * at).reshape(-1, 3)) + shift for at in (CORNERS, FRAME))
    bars = frame.reshape(-1, 2, 3)
    cloud = np.concatenate([tube(*bar, rng, 0.004 * scale, 0.012 * scale) for bar in bars])
    settings = StructureSettings(floor_m=-1e6, tube_m=0.06 * scale, copy_distance_m=0.2 * scale)
    structure = reconstruct_cloud(cloud, settings)
    match = match_members(structure.segments, bars, distance_max_m=0.03 * scale)
    assert sorted(match.member) == [0, 1, 2, 3, 4]
    assert np.median(match.offset_m) < 0.01 * scale
    assert len(structure.joint) == 4
    assert np.linalg.norm(structure.joint[:, None] - corners, axis=2).min(axis=0).max() < 0.03 * scale
    assert structure.graph().number_of_edges() == 5


@pytest.mark.parametrize("what", ["plane", "ball", "noise", "few"])
def test_a_cloud_without_lines_gives_an_empty_structure_and_says_so(what):
    rng = np.random.default_rng(1)
    sphere = rng.normal(size=(20000, 3))
    cloud = {
        "plane": np.column_stack([rng.uniform(-1, 1, (20000, 2)), rng.normal(0, 0.01, 20000)]),
        "ball": sphere / np.linalg.norm(sphere, axis=1)[:, None],
        "noise": rng.uniform(-1, 1, (8000, 3)),
        "few": rng.uniform(0, 0.1, (5, 3)),
    }[what]
    structure = reconstruct_cloud(cloud)
    assert len(structure) == len(structure.joint) == 0
    assert ("too few" if what == "few" else "planar or volumetric regions") in structure.reason


def leg_coverage(structure, legs, near_m):
    """Share ``(L,)`` of the length of each leg ``(L, 2, 3)`` that the bar which covers most of it runs along."""
    at = legs[:, 0, None] + np.linspace(0, 1, 60)[:, None] * (legs[:, 1] - legs[:, 0])[:, None]
    axis = (legs[:, 1] - legs[:, 0]) / np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1)[:, None]
    bars = structure.segments
    away = at[:, :, None] - bars.start
    along = np.einsum("lsbc,bc->lsb", away, bars.direction)
    beside = np.linalg.norm(away - along[..., None] * bars.direction, axis=-1)
    on = (beside < near_m) & (along > -near_m) & (along < bars.length + near_m)
    on &= np.abs(axis @ bars.direction.T)[:, None] > np.cos(np.radians(5))
    return on.mean(axis=1).max(axis=1)


def test_one_bar_covers_most_of_a_leg_whose_braces_are_few_tubes_apart():
    # As a drone's LiDAR sees a tower from afar: points 0.2 m apart, 8 cm of noise.
    bars = lattice(15, 4, 2, 5)
    points = thinned(scanned(bars, 120, 0.1, 0.08), 0.2)
    structure = reconstruct_cloud(points, StructureSettings.for_cloud(tube_radius(points)))
    assert leg_coverage(structure, bars[:4], 0.3).mean() > 0.65


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="0 points"):
        reconstruct_cloud(np.zeros((0, 3)))
    with pytest.raises(InputError, match="1 of them not finite"):
        reconstruct_cloud(np.array([[0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises(InputError, match=r"expected \(N, 3\)"):
        reconstruct_cloud(np.zeros((4, 2)))
    with pytest.raises(InputError, match="without a return"):
        reconstruct([], np.zeros((0, 4, 4)))
    with pytest.raises(InputError, match=r"expected \(0, 4, 4\)"):
        reconstruct([], np.zeros((1, 4, 4)))


def test_lengths_are_in_proportion_to_the_tube():
    """The defaults to the bit, and for a cloud the copies within two tubes, without a floor."""
    assert Scales.at(StructureSettings().tube_m) == Scales()
    for name, length in vars(Scales.at(0.3)).items():
        assert length == pytest.approx(5 * getattr(Scales(), name)), name
    cloud = StructureSettings.for_cloud(0.3)
    assert (cloud.tube_m, cloud.copy_distance_m, cloud.floor_m) == (0.3, 0.6, -1e6)


@pytest.fixture(scope="module")
def flown():
    """Scans of 16 s around the tower, their true poses, the structure at these, and the truth."""
    flight, truth = simulate(ExperimentSettings.preset("loops", "none", seed=11, duration_s=16.0, method="best"))
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
@pytest.mark.parametrize("seed", [1, 2])
def test_poses_that_move_take_the_structure_along(flown, seed):
    """Another place and heading, so other voxels and blocks: the same bars to some millimetres, but for weak ones."""
    flight, poses, true, _ = flown
    rng, T = np.random.default_rng(seed), np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]).as_matrix()
    T[:2, 3] = rng.uniform(-50, 50, 2)
    one, other = true.segments, rebuilt(flight, T @ poses).segments
    assert len(other) == pytest.approx(len(one), rel=0.1)
    match = match_members(one.transformed(T), np.stack([other.start, other.end], axis=1), distance_max_m=0.05)
    assert match.right.mean() > 0.9
    assert np.nanmedian(match.offset_m) < 0.003
