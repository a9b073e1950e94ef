"""Bars of merged clouds: one for one member, none in surfaces."""

import numpy as np
import pytest

from steelnb.core.types import Segments
from steelnb.fusion.cloud_bars import CloudBars, bars_of_cloud, widths_of
from steelnb.hough.near_segments import freedom_of
from steelnb.metrics.segments import DISTANCE_MAX_M, Match, match_members
from steelnb.points import voxel_grid
from tests.lattice import STEEL, TOWER, bare_tree, gussets, lattice, on_ground, rods, scanned, sheet, tree


def checked(found: CloudBars, members, right: float, has: float, near_m: float = DISTANCE_MAX_M) -> Match:
    """The members of the bars, if a share of the bars is ``right``, and a share of the members ``has`` one."""
    match = match_members(found.bars, np.asarray(members, dtype=float), distance_max_m=near_m)
    assert match.right.mean() >= right
    assert len({*match.member[match.right]}) >= has * len(members)
    return match


def sheets() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    slope = sheet(8.0, 8.0, per_m2=1500)
    slope[:, 2] += 0.4 * slope[:, 0]
    direction = rng.normal(size=(40_000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    corner = np.concatenate([sheet(4.0, 4.0, per_m2=1500)[:, order] for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0])])
    return {
        "ground": sheet(8.0, 8.0, per_m2=1500),
        "slope": slope,
        "corner": corner,
        "sphere": 2.0 * direction,
        "ball": 2.0 * direction * rng.uniform(0, 1, (len(direction), 1)) ** (1 / 3),
    }


@pytest.mark.parametrize("name", list(sheets()))
def test_surfaces_have_no_bars_and_scattered_points_few(name):
    assert len(bars_of_cloud(sheets()[name]).bars) <= (5 if name == "ball" else 0)


@pytest.mark.parametrize("radius_m", [0.05, 0.2])
def test_upright_cylinders_of_any_width_are_bars(radius_m):
    rng = np.random.default_rng(3)
    posts = [((x, y, 0), (x, y, 5)) for x in (0, 3) for y in (0, 3)]
    ground = sheet(7.0, 7.0, per_m2=1000) - [2.0, 2.0, 0.0]
    points = np.concatenate([rods(rng, *posts, radius_m=radius_m, noise_m=0.01), ground])
    found = bars_of_cloud(points, max(0.06, radius_m))
    assert len(found.bars) == 4
    assert found.bars.length.min() > 4.4
    assert found.width_m == pytest.approx(np.full(4, 2 * radius_m), abs=0.05)


@pytest.mark.parametrize(("radius_m", "per_m2"), [(0.1, 2000), (0.2, 2000), (0.2, 20000)])
def test_a_pipe_that_is_seen_from_one_side_is_one_bar(radius_m, per_m2):
    rng = np.random.default_rng(4)
    turn = rng.uniform(0, np.pi, int(np.pi * radius_m * 4 * per_m2))
    side = radius_m * np.column_stack([np.cos(turn), np.sin(turn)])
    points = np.column_stack([side, rng.uniform(0, 4, len(turn))]) + rng.normal(scale=0.005, size=(len(turn), 3))
    assert bars_of_cloud(points, radius_m).bars.length == pytest.approx([4.0], abs=0.1)


def uneven_ground() -> np.ndarray:
    """Ground whose density falls with the distance from a scanner."""
    rng = np.random.default_rng(4)
    place = rng.uniform(-6, 6, (200_000, 2))
    near = rng.random(len(place)) < 0.05 + np.exp(-np.linalg.norm(place - [6, -6], axis=1) / 4)
    return np.column_stack([place[near], rng.normal(0, 0.01, near.sum())])[::3]


DENSE, NOISY = (scanned(TOWER, 800, 0.08, noise_m) for noise_m in (0.005, 0.01))
FLAT = sheet(7.0, 7.0, per_m2=1200)
GROUND, WALL = FLAT - [3.5, 3.5, 0.0], FLAT[:, [0, 2, 1]] + [-3.5, 3.0, 0.0]
BESIDE = {
    "nothing": DENSE,
    "ground": np.concatenate([DENSE, GROUND]),
    "a wall": np.concatenate([DENSE, WALL]),
    "ground, in voxels": voxel_grid(np.concatenate([NOISY, GROUND]), 0.1),
    "uneven ground": np.concatenate([scanned(TOWER, 150, 0.08, 0.01), uneven_ground()]),
}


@pytest.mark.parametrize("beside", BESIDE)
def test_each_member_is_one_bar_with_a_surface_beside_and_in_voxels(beside):
    found = bars_of_cloud(BESIDE[beside])
    match = checked(found, TOWER, 0.95, 1.0)
    assert match.right.sum() - len(np.unique(match.member[match.right])) <= 1
    assert np.median(match.offset_m[match.right]) < 0.015
    assert len(found.surfaces) == (beside != "nothing")
    assert found.confidence.min() > 10
    assert (found.surface >= 0).sum() == sum(surface.points for surface in found.surfaces)


def bent_legs(bend_deg: float, lower_m: float, upper_m: float) -> np.ndarray:
    """Four upright members, and four on top of them that lean by an angle: ``(8, 2, 3)``."""
    turn = np.radians(bend_deg)
    feet = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]])
    knees = feet + np.array([0.0, 0, lower_m])
    heads = knees + upper_m * np.array([np.sin(turn), 0.0, np.cos(turn)])
    return np.concatenate([np.stack([feet, knees], axis=1), np.stack([knees, heads], axis=1)])


@pytest.mark.parametrize(("bend_deg", "lower_m", "upper_m"), [(0.0, 1.2, 1.2), (6.0, 1.2, 1.2), (3.0, 3.5, 2.5)])
def test_members_that_meet_at_a_bend_are_two_bars_and_in_line_one(bend_deg, lower_m, upper_m):
    rng, members = np.random.default_rng(0), bent_legs(bend_deg, lower_m, upper_m)
    points = scanned(members, 800, 0.0, 0.02)
    flange = rng.uniform(0, 0.08, (len(points), 1))
    points += np.where(rng.uniform(size=(len(points), 1)) < 0.5, flange * [1, 0, 0], flange * [0, 1, 0])
    found = bars_of_cloud(points)
    match = checked(found, members, 1.0, 1.0 if bend_deg else 0.5)
    assert len(match.member) == (8 if bend_deg else 4)


def test_wide_bars_that_bend_are_two():
    members = bent_legs(6.0, 1.2, 1.2)
    found = bars_of_cloud(scanned(members, 400, 0.14, 0.02))
    assert np.median(found.width_m) > 0.15
    checked(found, members, 1.0, 1.0)


def test_a_bar_on_a_wall_is_not_free_and_its_width_is_that_of_its_points():
    rng = np.random.default_rng(6)
    along = rng.uniform(0, 3, 3000)
    bar = np.column_stack([along, rng.uniform(-0.05, 0.05, (3000, 2))])
    axis = Segments(np.zeros((1, 3)), np.array([[3.0, 0.0, 0.0]]), np.array([3000]), np.array([0.04]))
    width_m = widths_of(bar, axis)
    assert 0.08 < width_m[0] < 0.14
    assert freedom_of(bar, axis, np.maximum(width_m / 2, 0.06))[0] > 0.95
    wall = sheet(3.0, 2.0) - [0.0, 1.0, 0.0]
    assert freedom_of(np.concatenate([bar[:500], wall]), axis, np.maximum(width_m / 2, 0.06))[0] < 0.5


@pytest.mark.parametrize(("per_m", "has"), [(25, 0.8), (30, 0.95)])
def test_steel_that_is_sampled_more_sparsely_than_the_ground_has_its_members(per_m, has):
    """As a scanner on a tripod sees a tower: the ground around it is dense."""
    cloud = on_ground(scanned(TOWER, per_m, 0.08, 0.005), 6.0, per_m2=1500)
    assert len(checked(bars_of_cloud(cloud), TOWER, 0.95, has).member) <= 44


@pytest.mark.parametrize("size_m", [0.25, 0.45])
def test_lines_on_gusset_plates_are_no_bars(size_m):
    found = bars_of_cloud(on_ground(np.concatenate([DENSE, gussets(TOWER[6::3], size_m)]), 5.0))
    checked(found, TOWER, 0.9, 1.0)


@pytest.mark.parametrize("scale", [1 / 5, 1 / 100])
def test_a_scale_model_on_a_plate_has_its_bars(scale):
    cloud = scale * on_ground(scanned(TOWER, 800, 0.08, 0.005), 5.0)
    checked(bars_of_cloud(cloud, 0.06 * scale), scale * TOWER, 0.95, 0.9, 0.1 * scale)


def test_posts_between_the_ground_and_a_handrail_are_bars():
    rng = np.random.default_rng(7)
    posts = [((x, 0, 0), (x, 0, 0.95)) for x in range(7)]
    cloud = np.concatenate(
        [rods(rng, *posts, ((0, 0, 0.95), (6, 0, 0.95)), radius_m=0.02), sheet(9.0, 4.0, per_m2=1500) - [1, 2, 0]]
    )
    upright = np.abs(bars_of_cloud(cloud).bars.direction[:, 2]) > 0.9
    assert upright.sum() == 7
    assert len(upright) == 8


@pytest.mark.parametrize("spacing_m", [0.05, 0.1])
def test_lines_on_sparse_ground_and_on_a_sparse_wall_are_no_bars(spacing_m):
    rng, mast = np.random.default_rng(1), lattice(6, 1.5, 1.0, 4)
    flat = [[rng.uniform(-4, 4, int(size / spacing_m**2)) for size in (64, 64)] for _ in range(2)]
    ground = np.column_stack([*flat[0], rng.normal(0, 0.01, len(flat[0][0]))])
    wall = np.column_stack([rng.normal(2, 0.01, len(flat[1][0])), flat[1][0], flat[1][1] + 4.0])
    checked(bars_of_cloud(np.concatenate([scanned(mast, 300, 0.08, 0.01), ground, wall])), mast, 0.85, 1.0)


@pytest.mark.parametrize("per_m2", [50, 300])
def test_ground_that_is_sampled_more_sparsely_than_the_steel_is_a_surface(per_m2):
    rng = np.random.default_rng(0)
    pole = rods(rng, ((0, 0, 0), (0, 0, 6)), radius_m=0.04, per_m2=26_000)
    found = bars_of_cloud(on_ground(pole, 4.0, per_m2))
    assert found.bars.length == pytest.approx([6.0], abs=0.4)
    assert (found.surface[len(pole) :] >= 0).mean() > 0.9


@pytest.mark.parametrize(("gap_m", "rise_m"), [(0.15, 0.0), (0.12, 0.1), (0.1, -0.2), (-1.0, -0.25)])
def test_chords_beside_and_beams_below_a_deck_are_bars(gap_m, rise_m):
    deck, y = sheet(10.0, 3.0), [-gap_m - 0.05, 3.0 + gap_m + 0.05]
    chords = np.array([[[0.0, each, rise_m], [10.0, each, rise_m]] for each in y])
    points = np.concatenate([deck, scanned(chords, 800, 0.1, 0.005)])
    found = bars_of_cloud(points)
    assert found.bars.length == pytest.approx([10.0, 10.0], abs=0.2)
    assert len(found.surfaces) == 1


@pytest.mark.parametrize("aside_m", [0.0, 0.08])
@pytest.mark.parametrize("beyond", ["posts over a wall", "beams past a deck"])
def test_members_that_continue_a_surface_in_its_plane_keep_their_length(beyond, aside_m):
    order, surface = ([0, 2, 1], sheet(4.0, 2.0)) if beyond == "posts over a wall" else ([0, 1, 2], sheet(4.0, 4.0))
    rim = surface[:, 1].max()
    bars = np.array([[[x, rim, aside_m], [x, rim + 2.0, aside_m]] for x in (0.5, 2.0, 3.5)])
    edge = np.array([[[0.5, rim + 1.9, aside_m], [3.5, rim + 1.9, aside_m]]])
    steel = scanned(np.concatenate([bars, edge]), 600, 0.08, 0.005)
    found = bars_of_cloud(np.concatenate([surface, steel])[:, order])
    assert len(found.bars) == 4
    assert found.bars.length.min() > 1.0


def test_ground_that_is_rougher_and_sparser_than_the_steel_does_not_set_the_tube():
    rng = np.random.default_rng(6)
    ground = sheet(10.0, 10.0, per_m2=400) - [5.0, 5.0, 0.0]
    ground[:, 2] += 0.04 * rng.normal(size=len(ground))
    found = bars_of_cloud(voxel_grid(np.concatenate([ground, NOISY]), 0.1))
    assert found.tube_m < 0.13
    checked(found, TOWER, 0.95, 0.9)


@pytest.mark.parametrize(
    ("face_m", "beside", "per_m", "least"),
    [(0.25, "", 500, 0.95), (0.3, "", 110, 0.9)],
)
def test_the_members_of_a_slim_mast_are_told_apart(face_m, beside, per_m, least):
    mast, rng = lattice(2.5, face_m, face_m, round(2.5 / face_m)), np.random.default_rng(3)
    bars, points = mast, scanned(mast, per_m, 0.02, 0.002)
    if beside == "a tree":
        points = np.concatenate([points, tree(rng, 3.0, 0.0)])
    cloud = on_ground(points, 5.0 if beside else 3.0, 400)
    match = checked(bars_of_cloud(cloud, 0.02), bars, 0.9, 0.0, 0.05)
    long = np.flatnonzero(np.linalg.norm(bars[:, 1] - bars[:, 0], axis=1) > 0.35)
    assert len({*match.member[match.right]} & {*long}) >= least * len(long)


def test_lines_in_a_tree_are_no_bars_and_those_of_a_tower_beside_it_are():
    trees = tree(np.random.default_rng(3), 5.0, 0.0)
    found = bars_of_cloud(on_ground(np.concatenate([trees, STEEL]), 6.0, 400))
    match = checked(found, TOWER, 0.0, 1.0)
    assert found.apart > 3 >= (~match.right).sum()  # branches that stand alone remain


def test_a_tower_among_trees_that_reach_into_it_keeps_its_bars():
    rng = np.random.default_rng(3)
    trees = [tree(rng, *place) for place in [(3.0, 0.0), (-2.5, 2.0), (0.0, -3.0)]]
    checked(bars_of_cloud(on_ground(np.concatenate([*trees, STEEL]), 5.0, 400)), TOWER, 0.0, 0.95)


@pytest.mark.parametrize("places", [[(2.5, 0.0)], [(5.0, 0.0), (-3.0, 5.0)]], ids=["reaching into", "in pieces"])
def test_branches_without_leaves_are_no_bars_and_the_members_among_them_are(places):
    rng = np.random.default_rng(3)
    wood = [bare_tree(rng, *place) for place in places]
    checked(bars_of_cloud(on_ground(np.concatenate([*wood, STEEL]), 6.0, 400)), TOWER, 0.85, 1.0)


def test_a_pole_with_many_arms_is_no_tree():
    rng, turns = np.random.default_rng(3), np.linspace(0, 2 * np.pi, 14)[1:]
    arms = [
        ((0.0, 0.0, 1.0 + 0.3 * k), (1.8 * np.cos(3 * turn), 1.8 * np.sin(3 * turn), 1.2 + 0.35 * k))
        for k, turn in enumerate(turns)
    ]
    bars = [((0.0, 0.0, 0.0), (0.0, 0.0, 5.5)), *arms]
    checked(bars_of_cloud(on_ground(rods(rng, *bars, radius_m=0.03), 3.0, 400)), bars, 0.9, 0.9)


def test_poles_in_high_grass_and_a_fence_before_bushes_are_bars():
    rng = np.random.default_rng(3)
    poles = [((x, 3.0, 0.0), (x, 3.0, 2.2)) for x in (-3.0, 0.0, 3.0)]
    fence = [((x, -3.0, 0.0), (x, -3.0, 1.2)) for x in (-2.0, 0.0, 2.0)] + [((-2.0, -3.0, 1.2), (2.0, -3.0, 1.2))]
    grass = np.concatenate([rng.normal([x, 3.0, 0.3], 0.25, (3000, 3)) for x in (-3.0, 0.0, 3.0)])
    bush = rng.normal([0.0, -3.7, 0.7], [1.0, 0.15, 0.3], (9000, 3))
    points = np.concatenate(
        [rods(rng, *poles, *fence, radius_m=0.04), *(some[some[:, 2] > 0] for some in (grass, bush))]
    )
    checked(bars_of_cloud(on_ground(points, 5.0)), poles + fence, 0.0, 1.0)
