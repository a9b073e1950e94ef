"""The Cramér-Rao bound on problems whose answer is known, and an estimator that reaches it."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from steelnb.errors import InputError
from steelnb.fusion.poses import DRIFT_SIGMA
from steelnb.metrics.limit import INCIDENCE_MAX_RAD, PATCH_M, Returns, batch, causal, gather, gradients, one_scan, see
from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation import build_tower, fly

SIGMA_M = 0.02
FREE = np.full(4, 1e6)
"""A prior that says nothing of the increments."""


def wall(axis: int, side: float, distance_m: float = 2.0, per_edge: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A grid of points on a wall of a box around the origin, even about its middle, and the normals towards there."""
    across = np.linspace(-1, 1, per_edge)
    points = np.full((per_edge**2, 3), side * distance_m)
    points[:, [(axis + 1) % 3, (axis + 2) % 3]] = np.stack(np.meshgrid(across, across), axis=2).reshape(-1, 2)
    normal = np.zeros_like(points)
    normal[:, axis] = -side
    return points, normal


def seen(points: np.ndarray, normal: np.ndarray, patch: np.ndarray | None = None) -> Returns:
    """Returns of rays that meet walls at a right angle, seen from the origin."""
    names = np.arange(len(points)) if patch is None else patch
    return Returns(np.zeros(3), points, normal, -normal, np.full(len(points), SIGMA_M), names)


def box() -> Returns:
    walls = [wall(axis, side) for axis in range(3) for side in (-1.0, 1.0)]
    return seen(*(np.concatenate(parts) for parts in zip(*walls, strict=True)))


def random_scans(scans: int, patches: int, returns: int = 40) -> list[Returns]:
    """Scans of patches with normals and places of their own, from several positions."""
    draw = np.random.default_rng(5)
    unit = draw.standard_normal((patches, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    found = []
    for k in range(scans):
        patch = draw.integers(0, patches, returns)
        position = np.array([0.3 * k, 0.1 * k, 0.0])
        points = position - 2 * unit[patch] + 0.5 * draw.standard_normal((returns, 3))
        ray = (points - position) / np.linalg.norm(points - position, axis=1)[:, None]
        found.append(Returns(position, points, unit[patch], ray, draw.uniform(0.01, 0.05, returns), patch))
    return found


def test_a_wall_tells_its_distance_and_nothing_along_it():
    bound = one_scan(gather([seen(*wall(0, 1.0))]))[0]
    assert bound[0] == pytest.approx(SIGMA_M / np.sqrt(16))
    assert np.isinf(bound[1:3]).all()
    assert bound[3] == pytest.approx(SIGMA_M / np.sqrt((wall(0, 1.0)[0][:, 1] ** 2).sum()))


def test_a_box_tells_the_place_by_two_walls_an_axis():
    np.testing.assert_allclose(one_scan(gather([box()]))[0, :3], SIGMA_M / np.sqrt(2 * 16))


def test_a_scan_of_nothing_tells_nothing():
    nothing = Returns(*(part[:0] if part.ndim > 1 or k > 0 else part for k, part in enumerate(box())))
    assert np.isinf(one_scan(gather([box(), nothing]))[1]).all()


def test_a_slanted_ray_feels_a_wall_less_by_the_cosine():
    points, normal = wall(0, 1.0)
    slanted = seen(points, normal)._replace(ray=np.tile([np.cos(1.0), np.sin(1.0), 0.0], (16, 1)))
    assert one_scan(gather([slanted]))[0, 0] == pytest.approx(np.cos(1.0) * SIGMA_M / np.sqrt(16))


def test_twice_the_returns_are_half_the_variance():
    once, twice = (gather([Returns(part.position, *(np.repeat(a, n, axis=0) for a in part[1:]))
                           for part in random_scans(3, 8)]) for n in (1, 2))  # fmt: skip
    stamp_s = np.arange(3.0)
    np.testing.assert_allclose(one_scan(twice) ** 2, one_scan(once) ** 2 / 2)
    np.testing.assert_allclose(batch(twice, stamp_s, drift=FREE) ** 2, batch(once, stamp_s, drift=FREE) ** 2 / 2)


def test_scans_of_a_known_surface_without_a_prior_say_what_each_says_alone():
    information = gather(random_scans(5, 30))
    np.testing.assert_allclose(batch(information, np.arange(5.0), 0.0, FREE)[1:], one_scan(information)[1:], rtol=1e-6)


def test_more_knowledge_of_the_surface_never_hurts():
    information, stamp_s = gather(random_scans(5, 30)), np.arange(5.0)
    known, half, unknown = (batch(information, stamp_s, sigma_m) for sigma_m in (0.0, 0.005, np.inf))
    assert (known[1:] < half[1:]).all()
    assert (half[1:] < unknown[1:]).all()


def dense_information(scans: list[Returns], patches: int, stamp_s: np.ndarray) -> np.ndarray:
    """The information about all poses and then all patches, written out."""
    poses = len(scans)
    matrix = np.zeros((4 * poses + patches,) * 2)
    for k, part in enumerate(scans):
        for g, sigma_m, patch in zip(gradients(part), part.sigma_m, part.patch, strict=True):
            row = np.zeros(len(matrix))
            row[4 * k : 4 * k + 4], row[4 * poses + patch] = g[:4], g[4]
            matrix += np.outer(row, row) / sigma_m**2
    for k in range(poses - 1):
        for axis in range(4):
            row = np.zeros(len(matrix))
            row[4 * k + axis], row[4 * k + 4 + axis] = -1, 1
            matrix += np.outer(row, row) / (DRIFT_SIGMA[axis] ** 2 * (stamp_s[k + 1] - stamp_s[k]) / 0.2)
    return matrix


def test_patches_eliminated_first_give_what_the_whole_matrix_gives():
    scans, stamp_s = random_scans(6, 12), np.array([0.0, 0.2, 0.4, 1.0, 1.2, 1.4])
    whole = batch(gather(scans), stamp_s)
    assert not whole[0].any()
    ends = causal(gather(scans), stamp_s, range(6))
    for poses in range(2, 7):
        dense = dense_information(scans[:poses], 12, stamp_s[:poses])
        used = np.flatnonzero(dense.diagonal() > 0)[4:]  # the first pose is known; patches not yet seen
        deviation = np.sqrt(np.diag(np.linalg.inv(dense[np.ix_(used, used)])))
        np.testing.assert_allclose(ends[poses - 1], deviation[4 * poses - 8 : 4 * poses - 4], rtol=1e-6)
    np.testing.assert_allclose(whole[1:].ravel(), deviation[:20], rtol=1e-6)
    assert not ends[0].any()


def test_the_most_probable_poses_of_a_simulated_flight_reach_the_bound():
    scans, patches, stamp_s = random_scans(3, 14, returns=60), 14, np.array([0.0, 0.2, 0.4])
    bound = batch(gather(scans), stamp_s)[1:].ravel()
    draw, trials, errors = np.random.default_rng(8), 150, []

    def ranges(poses: np.ndarray, shift: np.ndarray) -> list[np.ndarray]:
        """Ranges of the rays of each scan whose drone stands off its place by x, y, z and yaw."""
        found = []
        for part, (*step, yaw) in zip(scans, poses, strict=True):
            turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            away = part.points - part.position - step
            height = (part.normal * away).sum(axis=1) + shift[part.patch]
            found.append(height / (part.normal * (part.ray @ turn.T)).sum(axis=1))
        return found

    exact = ranges(np.zeros((3, 4)), np.zeros(patches))
    for _ in range(trials):
        measured = [r + part.sigma_m * draw.standard_normal(len(r)) for r, part in zip(exact, scans, strict=True)]
        increments = DRIFT_SIGMA * draw.standard_normal((2, 4))

        def residuals(x: np.ndarray, measured=measured, increments=increments) -> np.ndarray:
            poses = np.vstack([np.zeros(4), x[:8].reshape(2, 4)])
            off = [(a - b) / part.sigma_m for a, b, part in zip(ranges(poses, x[8:]), measured, scans, strict=True)]
            return np.concatenate([*off, ((np.diff(poses, axis=0) - increments) / DRIFT_SIGMA).ravel()])

        errors.append(least_squares(residuals, np.zeros(8 + patches), x_scale="jac").x[:8])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    spread = 1 / np.sqrt(2 * trials)  # of a standard deviation estimated from so many
    assert (np.abs(ratio - 1) < 4 * spread).all(), ratio
    assert abs(np.sqrt((ratio**2).mean()) - 1) < 2.5 * spread


@pytest.fixture(scope="module")
def flown():
    tower = build_tower()
    trajectory = fly(tower, FlightSettings.preset("zigzag", 3.0), 1)[0]
    return tower, trajectory.T_world_drone[:-1:25]


def test_returns_of_the_tower_are_within_the_sensor_s_reach_and_on_flat_patches(flown):
    tower, T_world_drone = flown
    settings = TofSettings.preset("report-4cm")
    scans = list(see(tower, T_world_drone, settings))
    assert len(scans) == len(T_world_drone)
    points, normal, patch = (
        np.concatenate([getattr(s, name) for s in scans]) for name in ("points", "normal", "patch")
    )
    assert len(points) > 1000
    for scan in scans:
        away = np.linalg.norm(scan.points - scan.position, axis=1)
        assert away.max() < settings.range_max_m + np.linalg.norm(settings.mount_m)
        assert (np.abs((scan.normal * scan.ray).sum(axis=1)) > np.cos(INCIDENCE_MAX_RAD)).all()
    for name in np.unique(patch)[::20]:
        here = points[patch == name]
        assert np.ptp(normal[patch == name], axis=0).max() < 1e-6
        assert np.ptp(here @ normal[patch == name][0]) < 1e-4
        assert np.ptp(here, axis=0).max() <= PATCH_M + 1e-6


def test_the_noise_of_a_return_is_the_sensor_s(flown):
    tower, T_world_drone = flown
    settings = TofSettings.preset("starling2").replace(sigma_relative=0.02)
    scan = next(see(tower, T_world_drone, settings))
    position = (T_world_drone[0] @ settings.T_drone_sensor)[:3, 3]
    away = np.linalg.norm(scan.points - position, axis=1)
    np.testing.assert_allclose(scan.sigma_m, np.maximum(0.01, 0.02 * away), rtol=1e-6)


def test_a_sensor_without_noise_has_no_bound(flown):
    with pytest.raises(InputError, match=r"tof.sigma_floor_m = 0.0: expected noise"):
        next(see(*flown, TofSettings.preset("report-4cm").replace(sigma_floor_m=0.0)))


def test_the_bound_halves_with_the_noise(flown):
    tower, T_world_drone = flown
    settings = TofSettings.preset("report-4cm")
    bounds = [one_scan(gather(see(tower, T_world_drone, settings.replace(sigma_floor_m=s)))) for s in (0.04, 0.02)]
    np.testing.assert_allclose(bounds[1], bounds[0] / 2)
    assert np.isfinite(bounds[0]).all()
