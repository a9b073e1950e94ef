"""Covariances of smoothing: against a dense inverse, against many runs, and with an undetermined direction."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import yaw_of
from steelnb.fusion.adjustment import factors, problem, smooth, solver
from steelnb.fusion.adjustment.problem import BAR_DOF
from steelnb.fusion.sections import shapes
from tests import naive
from tests.fusion.made import bars_of, made_up

STAMP_S = 0.2 * np.arange(40)
NONE = 1e-9
"""Standard deviation of a displacement shared by the points of a scan, metres: practically none."""


def state_of(T, bars, tilt_sigma_rad=0.0) -> problem.Problem:
    return problem.start(T, T, bars, tilt_sigma_rad)


def marginals(state, observed, prior, shared_sigma_m=smooth.SHARED_SIGMA_M):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth, "SHARED_SIGMA_M", shared_sigma_m / state.sigma_ratio**2)
        return smooth.marginals(state, factors.linearised(state, observed), prior, STAMP_S)


def dense(state, observed, prior, stamp_s, shared_sigma_m):
    """The inverse of all equations, with the displacement of each pair of a scan and a bar as an unknown."""
    eq = factors.linearised(state, observed)
    K, n, P = len(eq.matrix), len(eq.block), len(observed.pair_bar)
    chained, beside, _ = factors.prior_equations(state.T_world_sensor, prior, stamp_s, state.tilt_sigma_rad)
    D = problem.pose_size(state.tilt_sigma_rad)
    size = D * K + BAR_DOF * n
    matrix = np.zeros((size + 2 * P, size + 2 * P))
    matrix[: D * K, : D * K] = naive.block_tridiagonal(eq.matrix + chained, beside)
    eq = eq._replace(**{name: getattr(eq, name)[..., :BAR_DOF] for name in ("cross", "block", "shares")})
    matrix[D * K : size, D * K : size] = block_diag(*(eq.block[:, :BAR_DOF] + np.diag(problem.BAR_SIGMA**-2.0)))
    for p, (k, b) in enumerate(zip(observed.pair_scan, observed.pair_bar, strict=True)):
        pose, bar = slice(D * k, D * k + D), slice(D * K + BAR_DOF * b, D * K + BAR_DOF * b + BAR_DOF)
        displacement = slice(size + 2 * p, size + 2 * p + 2)
        matrix[pose, bar], matrix[bar, pose] = eq.cross[p], eq.cross[p].T
        matrix[pose, displacement], matrix[displacement, pose] = eq.cross[p][:, :2], eq.cross[p][:, :2].T
        matrix[bar, displacement], matrix[displacement, bar] = eq.shares[p][:BAR_DOF, :2], eq.shares[p][:BAR_DOF, :2].T
        matrix[displacement, displacement] = eq.shares[p][:2, :2] + np.eye(2) / shared_sigma_m**2
    inverse = np.linalg.inv(matrix[D:, D:])  # without the first pose, which is held
    pose = [inverse[at : at + D, at : at + D] for at in range(0, D * (K - 1), D)]
    bar = [inverse[at : at + BAR_DOF, at : at + BAR_DOF] for at in range(D * (K - 1), size - D, BAR_DOF)]
    return np.array(pose), np.array(bar)


@pytest.mark.parametrize("tilt_sigma_rad", [0.0, 0.02])
def test_they_are_the_blocks_of_the_dense_inverse(tilt_sigma_rad):
    T, bars, observed = made_up(1, 0.004)
    state = state_of(T, bars, tilt_sigma_rad)
    pose, bar = dense(state, observed, T, STAMP_S, 0.003)
    found = marginals(state, observed, T, 0.003)
    np.testing.assert_allclose(found[0][1:], pose, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(found[1], bar, rtol=1e-4, atol=1e-12)
    assert not found[0][0].any()


def test_many_runs_scatter_as_they_say():
    """30 made-up flights with the stated noise in ranges and increments: the NEES is near its degrees of freedom."""
    rng, squared, scaled = np.random.default_rng(5), [], []
    T, bars, exact = made_up(1, 0.0)
    range_m = np.linalg.norm(exact.point, axis=1)[:, None]
    for _ in range(30):
        noise = 0.01 * np.maximum(1.0, range_m) * rng.standard_normal(range_m.shape)
        observed = exact._replace(point=(exact.point * (1.0 + noise / range_m)).astype(np.float32))
        drift = rng.normal(size=(39, 4)) * factors.DRIFT_SIGMA
        prior = T.copy()
        prior[1:, :3, 3] += np.cumsum(drift[:, 1:], axis=0)
        turn = Rotation.from_rotvec(np.outer(np.cumsum(drift[:, 0]), [0, 0, 1])).as_matrix()
        prior[1:, :3, :3] = turn @ T[1:, :3, :3]
        state = problem.start(T, prior, bars)
        for _ in range(4):
            state = solver.improve(state, factors.linearised(state, observed), prior, STAMP_S)
        pose = marginals(state, observed, prior, NONE)[0]
        error = np.empty((39, 4))
        error[:, 1:] = (T - state.T_world_sensor)[1:, :3, 3]
        error[:, 0] = yaw_of(T[1:, :3, :3] @ state.T_world_sensor[1:, :3, :3].transpose(0, 2, 1))
        squared.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(pose[1:]), error).mean() / 4)
        scaled.append(error[20] / np.sqrt(np.diag(pose[21])))
    assert 0.8 < np.mean(squared) < 1.25
    assert np.all((np.std(scaled, axis=0) > 0.7) & (np.std(scaled, axis=0) < 1.4))


def wall_of_posts():
    """Only four posts, all seen at one height: the prior alone determines z."""
    T, bars, observed = made_up(1, 0.004)
    posts = np.arange(len(bars.flange)) < 4
    kind, flange = np.where(posts, bars.kind, shapes.UNKNOWN), np.where(posts, bars.flange, np.nan)
    return T, replace(bars, kind=kind, flange=flange), observed


def test_along_the_posts_of_a_wall_a_pose_has_the_sigma_of_the_drift():
    T, bars, observed = wall_of_posts()
    pose, bar, _ = marginals(state_of(T, bars), observed, T)
    np.testing.assert_allclose(np.sqrt(pose[:, 3, 3]), 0.01 * np.sqrt(np.arange(40)), rtol=0.01)
    assert np.sqrt(pose[-1, 2, 2]) < 0.01
    np.testing.assert_allclose(np.sqrt(np.diagonal(bar[4])), problem.BAR_SIGMA, rtol=1e-6)  # no point is on it


def test_a_free_direction_is_named(monkeypatch):
    monkeypatch.setattr(factors, "DRIFT_SIGMA", np.array([0.002, 1e9, 1e9, 1e9]))
    T, bars, observed = wall_of_posts()
    with pytest.raises(InputError, match="pose 1 is singular: nothing holds it, mostly along z"):
        marginals(state_of(T, bars), observed, T)


def test_the_drone_s_position_has_the_yaw_of_its_sensor_s_arm():
    mount = np.eye(4)
    mount[:3, 3] = [0.5, 0.0, 0.0]
    T = np.tile(np.eye(4), (2, 1, 1))
    pose = np.tile(np.diag([1e-4, 1e-6, 1e-6, 1e-6]), (2, 1, 1))
    found = smooth.pose_covariances(pose, T @ mount, mount)[1]
    np.testing.assert_allclose(np.diag(found)[:3], [1e-6, 1e-6 + 0.5**2 * 1e-4, 1e-6])
    assert found[1, 5] == pytest.approx(-0.5e-4)
    assert np.sqrt(found[3, 3]) == smooth.ATTITUDE_SIGMA_RAD


def test_axes_keep_their_covariance_in_another_frame(monkeypatch):
    monkeypatch.setattr(smooth, "END_SIGMA_M", 0.0)
    segments = bars_of([[0, 0, 0], [1, 2, 2]])
    frame = shapes.frames(segments.direction)
    cosine, sine = np.cos(0.7), np.sin(0.7)
    across = np.array([[cosine, sine], [-sine, cosine]]) @ frame
    bar = np.zeros((1, 6, 6))
    bar[0, :4, :4] = np.diag([4e-6, 1e-6, 9e-6, 1e-6])
    found = smooth.axis_covariances(bar, segments, across, 1.0)
    in_world = across[0].T @ bar[0, :2, :2] @ across[0]
    np.testing.assert_allclose(frame[0].T @ found[0, :2, :2] @ frame[0], in_world, atol=1e-15)
    assert smooth.axis_sigma_m(found, np.zeros(1))[0] == pytest.approx(2e-3)


def test_ends_of_an_axis_have_their_own_error():
    segments = bars_of([[0, 0, 0], [0, 0, 2.0]])
    found = smooth.axis_covariances(np.zeros((1, 6, 6)), segments, shapes.frames(segments.direction), 1.0)
    for along_m, sigma_m in ((-1.0, 1.0), (0.0, 0.5**0.5), (1.0, 1.0)):
        sigma = smooth.axis_sigma_m(found, np.array([along_m]))[0]
        assert sigma == pytest.approx(sigma_m * smooth.END_SIGMA_M)
