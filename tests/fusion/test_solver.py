"""Normal equations of poses and bars against slow twins: derivatives by differences, and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from steelnb.fusion import factors, poses, problem, sections
from steelnb.fusion.poses import UPRIGHT_DOF
from steelnb.fusion.problem import BAR_DOF, Bars
from steelnb.fusion.solver import Chain
from steelnb.types import Segments
from tests.fusion.made import made_up


def chain_of(poses: int, seed: int):
    """A block tridiagonal matrix as blocks and dense, and columns that few poses have."""
    rng = np.random.default_rng(seed)
    lower = rng.normal(size=(poses, UPRIGHT_DOF, UPRIGHT_DOF)) + 3 * np.eye(UPRIGHT_DOF)
    below = rng.normal(size=(poses - 1, UPRIGHT_DOF, UPRIGHT_DOF))
    matrix = lower @ lower.transpose(0, 2, 1)
    matrix[1:] += below @ below.transpose(0, 2, 1)
    beside = lower[:-1] @ below.transpose(0, 2, 1)
    dense = block_diag(*matrix)
    for k in range(poses - 1):
        here, behind = (
            slice(UPRIGHT_DOF * k, UPRIGHT_DOF * k + UPRIGHT_DOF),
            slice(UPRIGHT_DOF * k + UPRIGHT_DOF, UPRIGHT_DOF * k + 2 * UPRIGHT_DOF),
        )
        dense[here, behind], dense[behind, here] = beside[k], beside[k].T
    columns = rng.normal(size=(poses, UPRIGHT_DOF, 30))
    for m, first in enumerate(rng.integers(0, poses - 3, 30)):
        columns[:first, :, m], columns[first + 3 :, :, m] = 0.0, 0.0
    return matrix, beside, dense, columns


def test_a_chain_is_solved_as_its_dense_matrix():
    matrix, beside, dense, columns = chain_of(50, 1)
    chain, flat = Chain.factored(matrix, beside), columns.reshape(50 * UPRIGHT_DOF, 30)
    forward = chain.forward(columns)
    squared = forward.reshape(flat.shape).T @ forward.reshape(flat.shape)
    np.testing.assert_allclose(squared, flat.T @ np.linalg.solve(dense, flat), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(chain.backward(forward).reshape(flat.shape), np.linalg.solve(dense, flat), atol=1e-9)
    inverse = np.linalg.inv(dense).reshape(50, UPRIGHT_DOF, 50, UPRIGHT_DOF)[np.arange(50), :, np.arange(50)]
    np.testing.assert_allclose(chain.inverse_blocks(), inverse, atol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    matrix, beside, _, _ = chain_of(5, 3)
    matrix[3] -= 100 * np.eye(UPRIGHT_DOF)
    with pytest.raises(np.linalg.LinAlgError):
        Chain.factored(matrix, beside)


def residuals_of(T, bars, observed, p):
    """Residuals of the points of pair p, and their standard deviations, straight from the definition."""
    k, b = observed.pair_scan[p], observed.pair_bar[p]
    corner, direction = sections.outlines(bars.turn, bars.flange)[b], bars.segments.direction[b]
    found = []
    for s in observed.point[observed.first[p] : observed.first[p + 1]].astype(np.float64):
        point = T[k, :3, :3] @ s + T[k, :3, 3]
        frame = np.vstack([bars.across[b], direction])
        at, towards = frame @ (point - bars.segments.start[b]), frame @ (T[k, :3, 3] - point)
        found.append(sections.face_distance(*at, *towards, corner, bars.segments.length[b])[:2])
    return np.array(found).T


def moved(T, bars, k, b, n, step, size):
    """Pose k or bar b moved by a step in one of its degrees of freedom, the pose's ``size`` or the six behind them."""
    if n < size:
        steps = np.zeros((len(T), size))
        steps[k, n] = step
        return poses.moved_poses(T, steps), bars
    segments, turn, flange = bars.segments, bars.turn.copy(), bars.flange.copy()
    ends = [segments.start.copy(), segments.end.copy()]
    half = 0.5 * segments.length[b]
    if n < size + 2:
        for end in ends:
            end[b] += step * bars.across[b, n - size]
    elif n < size + 4:
        for sign, end in zip((-1, 1), ends, strict=True):
            end[b] += sign * half * step * bars.across[b, n - size - 2]
    else:
        (turn, flange)[n - size - 4][b] += step
    new = Segments(*ends, segments.count, segments.radius)
    first = bars.across[:, 0] - (bars.across[:, 0] * new.direction).sum(axis=1)[:, None] * new.direction
    first /= np.linalg.norm(first, axis=1)[:, None]
    return T, Bars(new, np.stack([first, np.cross(new.direction, first)], axis=1), turn, flange)


@pytest.mark.parametrize(("tilt_sigma_rad", "tubes"), [(0.0, ()), (0.02, (1, 4))])
def test_equations_are_those_of_derivatives_by_differences(tilt_sigma_rad, tubes):
    T, bars, observed = made_up(4, 0.0, tubes, scans=8)
    bars = replace(bars, segments=bars.segments.transformed(np.eye(4)))
    T = T.copy()
    tilted = Rotation.from_rotvec([0.05, -0.08, 0.0]).as_matrix()  # roll and pitch, and a face seen aslant
    T_world = np.eye(4)
    T_world[:3, :3], T_world[:3, 3] = tilted, [0.3, -0.2, 0.5]
    T, segments = T_world @ T, bars.segments.transformed(T_world)
    bars = Bars(segments, bars.across @ tilted.T, bars.turn, bars.flange)
    state = problem.start(T, T, bars, tilt_sigma_rad)
    eq = factors.linearised(state, observed)
    step, size = 1e-6, 6 if tilt_sigma_rad else UPRIGHT_DOF
    matrix, block = np.zeros((len(T), size, size)), np.zeros((6, BAR_DOF, BAR_DOF))
    for p, (k, b) in enumerate(zip(observed.pair_scan, observed.pair_bar, strict=True)):
        columns = [
            (residuals_of(*moved(T, bars, k, b, n, step, size), observed, p)[0]
             - residuals_of(*moved(T, bars, k, b, n, -step, size), observed, p)[0]) / (2 * step)
            for n in range(size + BAR_DOF)
        ]  # fmt: skip
        sigma = residuals_of(T, bars, observed, p)[1]
        g = np.column_stack(columns) / sigma[:, None]
        g = g[np.isfinite(g).all(axis=1)]
        matrix[k] += g[:, :size].T @ g[:, :size]
        block[b] += g[:, size:].T @ g[:, size:]
        if len(g) == observed.first[p + 1] - observed.first[p]:
            scale = np.abs(g.T @ g).max()
            np.testing.assert_allclose(eq.cross[p], g[:, :size].T @ g[:, size:], atol=0.01 * scale)
            np.testing.assert_allclose(eq.shares[p], g[:, size:].T @ g[:, size:], atol=0.01 * scale)
    np.testing.assert_allclose(eq.matrix, matrix, atol=0.02 * np.abs(matrix).max())
    np.testing.assert_allclose(eq.block, block, atol=0.02 * np.abs(block).max())


def test_increments_are_the_derivatives_of_their_cost(monkeypatch):
    monkeypatch.setattr(poses, "FIXED", 1e4)  # as weighty as the increments
    # The prior's attitude lies 1° to 3° off, so the cost has slopes in all degrees of freedom.
    rng, n, sigma = np.random.default_rng(5), 4, 0.02
    T, prior = np.tile(np.eye(4), (2, n, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.normal(scale=0.1, size=(n, 3)), axis=0)
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.1, size=(n, 3))).as_matrix()
    off = Rotation.from_rotvec(rng.normal(scale=0.03, size=(n, 3))).as_matrix()
    prior[:, :3, :3], prior[:, :3, 3] = off @ T[:, :3, :3], T[:, :3, 3] + rng.normal(scale=0.02, size=(n, 3))
    stamp_s = 0.2 * np.arange(n)

    def vector(step):
        return poses.prior_equations(poses.moved_poses(T, step.reshape(n, 6)), prior, stamp_s, sigma)[2].ravel()

    matrix, beside, _ = poses.prior_equations(T, prior, stamp_s, sigma)
    dense = block_diag(*matrix)
    for k in range(n - 1):
        dense[6 * k : 6 * k + 6, 6 * k + 6 : 6 * k + 12] = beside[k]
        dense[6 * k + 6 : 6 * k + 12, 6 * k : 6 * k + 6] = beside[k].T
    by_differences = np.array([(vector(1e-6 * e) - vector(-1e-6 * e)) / -2e-6 for e in np.eye(6 * n)]).T
    np.testing.assert_allclose(by_differences, dense, atol=0.06 * np.abs(dense).max())
