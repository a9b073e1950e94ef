"""Normal equations of poses and bars against numerical derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core.geometry import UPRIGHT_DOF, moved_poses
from steelnb.fusion.adjustment import factors, problem
from steelnb.fusion.adjustment.factors import FACE_DOF
from steelnb.fusion.adjustment.problem import BAR_DOF
from steelnb.fusion.sections import shapes
from tests import naive
from tests.fusion.made import made_up


def residuals_of(state, observed, p):
    """Residuals of the points of pair p, and their standard deviations, directly from the definition."""
    T, bars, b = state.T_world_sensor[observed.pair_scan[p]], state.bars, observed.pair_bar[p]
    corner, direction = bars.faces()[5][b], bars.segments.direction[b]
    found = []
    for s in observed.point[observed.first[p] : observed.first[p + 1]].astype(np.float64):
        point = T[:3, :3] @ s + T[:3, 3]
        frame = np.vstack([bars.across[b], direction])
        at, towards = frame @ (point - bars.segments.start[b]), frame @ (T[:3, 3] - point)
        found.append(shapes.face_distance(*at, *towards, bars.kind[b], corner, bars.segments.length[b])[:2])
    return np.array(found).T


@pytest.mark.parametrize(("tilt_sigma_rad", "tubes"), [(0.0, ()), (0.02, (1, 4))])
def test_equations_are_those_of_derivatives_by_differences(tilt_sigma_rad, tubes):
    T, bars, observed = made_up(4, 0.0, tubes, scans=4)
    T_world = np.eye(4)  # roll and pitch, and a face seen aslant
    T_world[:3, :3], T_world[:3, 3] = Rotation.from_rotvec([0.05, -0.08, 0.0]).as_matrix(), [0.3, -0.2, 0.5]
    T = T_world @ T
    bars = replace(bars, segments=bars.segments.transformed(T_world), across=bars.across @ T_world[:3, :3].T)
    state = problem.start(T, T, bars, tilt_sigma_rad)
    eq = factors.linearised(state, observed)
    step, size = 1e-6, 6 if tilt_sigma_rad else UPRIGHT_DOF
    matrix, block = np.zeros((len(T), size, size)), np.zeros((6, FACE_DOF, FACE_DOF))
    for p, (k, b) in enumerate(zip(observed.pair_scan, observed.pair_bar, strict=True)):

        def changed(steps, p=p, k=k, b=b):
            states, bars = np.zeros((len(T), size)), np.zeros((6, BAR_DOF))
            states[k], bars[b], thickness = steps[:size], steps[size:-1], state.bars.thickness + steps[-1]
            return residuals_of(state.moved(states, bars, 1.0, thickness), observed, p)[0]

        columns = [(changed(e) - changed(-e)) / (2 * step) for e in step * np.eye(size + FACE_DOF)]
        g = np.column_stack(columns) / residuals_of(state, observed, p)[1][:, None]
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
    monkeypatch.setattr(factors, "FIXED", 1e4)  # as weighty as the increments
    # The prior's attitude lies 1° to 3° off, so the cost has slopes in all degrees of freedom.
    rng, n, sigma = np.random.default_rng(5), 4, 0.02
    T, prior = np.tile(np.eye(4), (2, n, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.normal(scale=0.1, size=(n, 3)), axis=0)
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.1, size=(n, 3))).as_matrix()
    off = Rotation.from_rotvec(rng.normal(scale=0.03, size=(n, 3))).as_matrix()
    prior[:, :3, :3], prior[:, :3, 3] = off @ T[:, :3, :3], T[:, :3, 3] + rng.normal(scale=0.02, size=(n, 3))
    stamp_s = 0.2 * np.arange(n)

    def vector(step):
        T_moved = moved_poses(T, step.reshape(n, 6))
        return factors.prior_equations(T_moved, prior, stamp_s, sigma)[2].ravel()

    matrix, beside, _ = factors.prior_equations(T, prior, stamp_s, sigma)
    dense = naive.block_tridiagonal(matrix, beside)
    by_differences = np.array([(vector(1e-6 * e) - vector(-1e-6 * e)) / -2e-6 for e in np.eye(6 * n)]).T
    np.testing.assert_allclose(by_differences, dense, atol=0.06 * np.abs(dense).max())
