import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.points import VoxelMap
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.registration import AlignOptions, Target, align, make_target, prior_term, register, solver
from steelnb.registration import normal_equations as kernels
from steelnb.registration.target import CACHED, VoxelTarget, correspond_points
from tests import naive
from tests.registration.scenes import corner, motion, pose_error, transformed

ERRORS = ("point", "plane", "gicp")
SCALE = {"point": 0.05, "plane": 0.03, "gicp": 2.0}
NONE = np.zeros((0, 6))


class Problem:
    """A small registration problem, with its terms by the kernel and by the slow twin."""

    def __init__(self, error, robust):
        self.error, self.scale = error, SCALE[error] if robust else math.inf
        self.source = corner(150, 1)
        self.target = make_target(corner(220, 2), error)
        self.C_source = regularised(neighbour_covariances(self.source)) if error == "gicp" else NONE
        self.T = motion(4, 0.05)
        self.match = naive.pairs(transformed(self.source, self.T), self.target.point, 0.6)
        if self.target.filled:
            self.target.filled.fill(np.arange(len(self.target.point)))
        self.centre = np.array([0.3, -0.2, 0.5])

    def fast(self, T):
        H, b = np.zeros((6, 6)), np.zeros(6)
        t = self.target
        answer = kernels.linearise(
            int(kernels.PairError[self.error.upper()]), self.source, self.C_source,
            t.point, t.normal, t.covariance, self.match, T,
            self.T[:3, :3], self.centre, math.inf, self.scale, H, b,
        )  # fmt: skip
        return *answer, H, b

    def terms(self, T):
        C_target = naive.full(self.target.covariance) if self.error == "gicp" else None
        C_source = naive.full(self.C_source) if self.error == "gicp" else None
        return naive.registration_terms(
            self.error, self.source, C_source, self.target.point, self.target.normal, C_target, self.match, T,
            self.T[:3, :3], math.inf,
        )  # fmt: skip

    def loss(self, xi):
        """Loss by its definition, at the pose after a twist about the centre."""
        R = Rotation.from_rotvec(xi[:3]).as_matrix()
        T = np.eye(4)
        T[:3, :3] = R @ self.T[:3, :3]
        T[:3, 3] = R @ (self.T[:3, 3] - self.centre) + self.centre + xi[3:]
        return sum(naive.robust(float((root @ e) @ (root @ e)), self.scale) for e, root, _ in self.terms(T))


@pytest.mark.kernels
@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("error", ERRORS)
def test_loss_gradient_and_hessian_equal_the_definition(error, robust):
    problem, step = Problem(error, robust), 1e-6
    loss, inliers, _, H, b = problem.fast(problem.T)
    assert inliers == (problem.match >= 0).sum() > 100
    assert loss == pytest.approx(problem.loss(np.zeros(6)), rel=1e-9)
    gradient = [(problem.loss(step * d) - problem.loss(-step * d)) / (2 * step) for d in np.eye(6)]
    np.testing.assert_allclose(b, gradient, rtol=1e-4, atol=1e-5 * np.abs(b).max())
    H_slow = np.zeros((6, 6))
    for e, root, q in problem.terms(problem.T):
        arm = q - problem.centre
        J = root @ np.column_stack([*np.cross(np.eye(3), arm), *np.eye(3)])
        squared = (root @ e) @ (root @ e)
        ahead, behind = (naive.robust(squared * (1 + d), problem.scale) for d in (step, -step))
        H_slow += (ahead - behind) / (step * squared) * J.T @ J  # the weight is twice the slope of the loss
    np.testing.assert_allclose(H, H_slow, atol=1e-5 * np.abs(H_slow).max())


@pytest.mark.kernels
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), limit=st.floats(0.02, 0.4))
def test_cached_pairs_are_exact_after_jumps_of_the_pose_and_save_searches_after_small_steps(seed, limit):
    rng = np.random.default_rng(seed)
    source, tree, searches = corner(60, seed), make_target(corner(90, seed + 1), "point").tree, []
    match, state = np.full(60, -1), (np.full((60, CACHED), -1), np.full(60, -1.0), np.zeros((60, 3)))
    jumps = [motion(20 * size, size, seed=seed) for size in rng.choice([1e-12, 1e-3, 0.03, 0.2, 5.0], 15)]
    for T in [*jumps, motion(0, 1e-12) @ jumps[-1]]:
        searches.append(correspond_points(tree, source, T, limit, match, *state))
        np.testing.assert_array_equal(match, naive.pairs(transformed(source, T), tree.point, limit))
    assert searches[0] == 60
    assert searches[-1] < 6


def test_a_step_that_raises_the_loss_of_the_same_pairs_is_rejected(monkeypatch):
    # A dozen points far from their planes: steps of Gauss–Newton overshoot, and it often does not converge.
    here, target, decisions = corner(12, 7), make_target(corner(48, 6), "plane"), []

    def converged():
        starts = [motion(40, 0.5, seed=k) for k in range(40)]
        options = AlignOptions("plane", np.eye(6), 3.0, iterations_max=80)
        return sum(align(here, target, T, options).converged for T in starts)

    def worse(linearise, source, target, limit, T, now, T_best, best, match):
        answer = really_worse(linearise, source, target, limit, T, now, T_best, best, match)
        rose = now.loss > best.loss and now.loss * best.inliers > best.loss * now.inliers
        if rose or now.inliers < 0.9 * best.inliers:
            before, after = (loss_of_pairs(here, target, match, T_best, pose, limit) for pose in (T_best, T))
            decisions.append((answer, after > before))
        return answer

    really_worse = solver.worse
    monkeypatch.setattr(solver, "worse", worse)
    damped = converged()
    assert 50 < sum(answer for answer, _ in decisions) < len(decisions) - 50
    assert all(answer == truth for answer, truth in decisions)
    monkeypatch.setattr(solver, "worse", lambda *_: False)
    assert damped > converged() + 3


def loss_of_pairs(points, target, match, T_pairs, T, limit):
    kept = np.linalg.norm(transformed(points, T_pairs) - target.point[match], axis=1) <= limit
    e = (transformed(points, T) - target.point[match]) * target.normal[match]
    return 0.5 * (e.sum(axis=1)[kept & (match >= 0)] ** 2).sum()


@pytest.mark.parametrize("known", [False, True])
def test_directions_that_a_floor_does_not_constrain_keep_the_start_or_follow_a_prior(known):
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (1000, 2)), np.zeros(1000)]) + known * np.array([50.0, 0, 0])
    start = motion(known, 0.0, seed=3)
    start[:3, 3] = [0.02, -0.03, 0.05]
    information = np.diag([0.3**-2.0] * 3 + [0.8**-2.0] * 3)  # a pair has a standard deviation of 1 m
    terms = [prior_term(information, start, floor)] if known else []
    result = align(floor, make_target(floor, "plane"), start, AlignOptions("plane", np.eye(6), 2.0), terms=terms)
    before, after = (transformed(floor.mean(axis=0)[None], T)[0] for T in (start, result.T_target_source))
    np.testing.assert_allclose(after[:2], before[:2], atol=2e-3 if known else 1e-6)
    assert abs(after[2]) < (2e-3 if known else 1e-6) < (0.5 if known else 0.04) < abs(before[2])


@pytest.mark.filterwarnings("error")
def test_zero_covariances_are_singular():
    points = corner(200, 1)
    target = make_target(points, "point")
    flat = Target(target.tree, target.normal, np.zeros((200, 6)))
    result = align(points, flat, np.eye(4), AlignOptions("gicp", np.eye(6), 1.0), np.zeros((200, 6)))
    assert (result.converged, result.reason) == (False, "singular")
    np.testing.assert_array_equal(result.T_target_source, np.eye(4))


@pytest.mark.parametrize("error", ["point", "plane"])
def test_extrapolation_finds_the_same_pose_in_fewer_iterations(error):
    source, target = corner(3000, 1), make_target(corner(3000, 2), error)
    plain = AlignOptions(error, np.eye(6), 0.5, SCALE[error], 200, 1e-7, 1e-7)
    ends = [
        align(source, target, motion(4, 0.15), options) for options in (plain, replace(plain, accelerated=True))
    ]  # fmt: skip
    assert all(end.converged for end in ends)
    assert ends[1].iterations < ends[0].iterations
    shift_m, turn_deg = pose_error(ends[0].T_target_source, ends[1].T_target_source)
    assert shift_m < 1e-5
    assert turn_deg < 1e-3


def test_the_result_says_why_it_stopped_and_counts_the_inliers():
    source = corner(500, 1)
    short = register(source, source + 0.1, "icp", iterations_max=1)
    assert (short.converged, short.iterations, short.reason) == (False, 1, "iterations exhausted")
    source[:50] += 10.0
    result = register(source, corner(500, 1), "icp", max_correspondence_m=0.2)
    assert result.inliers == 450
    assert pose_error(result.T_target_source, np.eye(4))[0] < 1e-6


@pytest.mark.parametrize("floor_m2", [None, 1e-4])
def test_a_map_with_a_tree_has_the_pairs_and_covariances_of_one_without_until_it_grows(floor_m2):
    rng = np.random.default_rng(5)
    voxels = VoxelMap(0.1)
    voxels.insert(rng.normal(size=(2000, 3)) * [1, 0.5, 0.2])
    plain = copy.deepcopy(voxels)
    voxels.index()
    source, T = 2 * rng.normal(size=(300, 3)), np.eye(4)
    both = [VoxelTarget(each, floor_m2) for each in (plain, voxels)]
    searches = [target.search(source, 0.5) for target in both]
    for _ in range(4):
        T[:3, 3] += rng.normal(size=3) * 0.1
        expected, found = (search(T) for search in searches)
        assert {-1} < {*expected.tolist()}
        np.testing.assert_array_equal(found, expected)
        used = expected[expected >= 0]
        if floor_m2:
            np.testing.assert_array_equal(both[1].covariance[used], both[0].covariance[used])
    more = rng.normal(size=(500, 3))
    for each in (plain, voxels):
        each.insert(more)
    assert voxels.tree is None
    expected, found = (VoxelTarget(each, floor_m2).search(source, 0.5)(T) for each in (plain, voxels))
    np.testing.assert_array_equal(found, expected)


def test_an_empty_map_has_no_tree():
    voxels = VoxelMap(0.1)
    voxels.index()
    assert voxels.tree is None
    assert (VoxelTarget(voxels).search(np.zeros((3, 3)), 0.5)(np.eye(4)) == -1).all()
