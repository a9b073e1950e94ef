import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steelnb.core.types import Trajectory
from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation import build_tower, fly, scan_flight
from steelnb.simulation.flight import pose_on_path
from steelnb.simulation.raycasting import Hits, cast_bundle, cast_rays, make_scene, ray_distance, rays, resolve_hits
from steelnb.simulation.tof import RANGE_MIN_M, add_noise, measured_ranges, noise_free, reported_rays

TOWER = build_tower()
SCENE = make_scene(TOWER)
EXACT = TofSettings.preset("report-4cm").replace(sigma_floor_m=0.0)


@pytest.fixture(scope="module")
def flight():
    return fly(TOWER, FlightSettings.preset("zigzag", 10.0), 1)[0]


class Perturbed:
    """A mesh whose distances differ by some units in the last place, as on a processor of another vendor."""

    def __init__(self, scene, ulps):
        self._mesh, self._ulps = scene.mesh, ulps

    def cast_rays(self, bundle, nthreads):
        hit = {name: found.numpy().copy() for name, found in self._mesh.cast_rays(bundle, nthreads=nthreads).items()}
        distance = hit["t_hit"].view(np.int32)
        distance[np.isfinite(hit["t_hit"])] += self._ulps
        return {name: SimpleNamespace(numpy=lambda found=found: found) for name, found in hit.items()}


@pytest.mark.parametrize("ulps", [-2, -1, 1, 2])
def test_scans_do_not_depend_on_the_last_digits_of_embree_s_distances(ulps):
    ray, T = rays(EXACT), pose_on_path(TOWER, FlightSettings.preset("zigzag"), 0.3)[None]
    exact, _ = cast_rays(SCENE, T, ray)
    perturbed, _ = cast_rays(SCENE._replace(mesh=Perturbed(SCENE, ulps)), T, ray)
    np.testing.assert_array_equal(exact, perturbed)
    assert np.isfinite(exact).sum() > 1000


def no_hits(count):
    range_m, member = np.empty(count, np.float32), np.empty(count, np.int64)
    return Hits(range_m, member, np.empty((count, 3), np.float32), member.copy())


def test_a_ray_on_the_edge_of_two_faces_hits_the_same_one_whichever_embree_proposes():
    """A roof whose ridge the rays hit, and a plate that lies in one of its sides."""
    roof = np.array([(0, -1, 1), (0, 1, 1), (1, 1, 2), (1, -1, 2), (2, 1, 1), (2, -1, 1)], dtype=float)
    plate = np.array([(0.3, -0.5, 1.3), (0.3, 0.5, 1.3), (0.7, 0.5, 1.7), (0.7, -0.5, 1.7)])
    triangles = np.array([(0, 1, 2), (0, 2, 3), (3, 2, 4), (3, 4, 5), (6, 7, 8), (6, 8, 9)])
    tower = replace(TOWER, vertices=np.vstack([roof, plate]), triangles=triangles, triangle_member=[0, 0, 1, 1, 2, 2])
    scene = make_scene(tower)
    down = np.zeros((2, 6), np.float32)
    down[:, 5] = -1
    down[0, :3], down[1, :3] = (1, 0.3, 5), (0.5, 0.1, 5)  # on the ridge; on the plate and the roof below it
    found = []
    for named in [(1, 1), (2, 4)]:
        hits = no_hits(2)
        missed = resolve_hits(down, np.arange(2), np.array(named, np.uint32), scene.triangles, scene.member, hits)
        assert not len(missed)
        found.append(hits)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found[0][0], [3.0, 3.5])


def test_a_ray_that_misses_a_proposed_triangle_continues_behind_it():
    """A wall at x = 2, which is enlarged for Embree, and a larger wall at x = 4."""
    near, far = ([(x, -y, 5 - y), (x, y, 5 - y), (x, y, 5 + y), (x, -y, 5 + y)] for x, y in ((2, 1), (4, 3)))
    triangles = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)])
    tower = replace(TOWER, vertices=np.array([*near, *far], float), triangles=triangles, triangle_member=[0, 0, 1, 1])
    scene = make_scene(tower)
    along = np.zeros((4, 6), np.float32)
    along[:, 3] = 1
    along[:, 1:3] = [(0.5, 4.5), (1 + 5e-6, 4.5), (1 + 1.5e-5, 4.5), (1.5, 4.5)]
    hits = no_hits(4)
    missed = resolve_hits(along, np.arange(4), np.zeros(4, np.uint32), scene.triangles, scene.member, hits)
    np.testing.assert_array_equal(missed, [2, 3])
    np.testing.assert_array_equal(cast_bundle(scene, along).range_m, [2, 2, 4, 4])


def test_a_ray_that_grazes_a_plane_ends_on_the_triangle():
    corner = np.array([(1, -1, 0), (2, -1, 0), (1, 1, 0)], dtype=float)
    for fall in (0.0, 1e-30, -1e-9):
        ray = np.array([0, 0, 1e-7, 1, 0, fall])
        assert 1 <= ray_distance(ray, corner, np.array([0, 0, 1.0, 0])) <= 2


def distance_to_axes(points):
    begin, end = TOWER.axes[:, 0], TOWER.axes[:, 1]
    axis = end - begin
    t = np.clip(((points[:, None] - begin) * axis).sum(axis=2) / (axis**2).sum(axis=1), 0, 1)
    return np.linalg.norm(points[:, None] - begin - t[..., None] * axis, axis=2).min(axis=1)


def test_rays_have_the_fields_of_view_of_a_pinhole_camera():
    ray = rays(TofSettings.preset("starling2"))
    assert ray.shape == (240, 180, 3)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=2), 1)
    pixel = ray / ray[..., :1]
    np.testing.assert_allclose(np.diff(pixel[..., 1], axis=1), -2 * np.tan(np.radians(43)) / 180)
    np.testing.assert_allclose(np.diff(pixel[..., 2], axis=0), -2 * np.tan(np.radians(53)) / 240)
    assert pixel[0, 0, 1] > 0  # the first pixel is up and to the left
    assert pixel[0, 0, 2] > 0


def test_exact_returns_lie_on_the_structure_or_the_ground(flight):
    mounted = EXACT.replace(mount_m=(0.06, 0.02, -0.01), mount_rpy_deg=(0.0, 10.0, 0.0))
    scans, visibility = scan_flight(TOWER, flight, mounted.replace(rate_hz=2.0), 1)
    poses = flight.at(scans.stamp_s).T_world_drone @ mounted.T_drone_sensor
    steel = 0
    for scan, T in zip(scans, poses, strict=True):
        points = scan.points.reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])] @ T[:3, :3].T + T[:3, 3]
        points = points[np.abs(points[:, 2]) > 1e-3]
        steel += len(points)
        assert distance_to_axes(points).max() <= np.hypot(0.12, 0.12)
    assert visibility.returns.sum() == pytest.approx(steel, rel=0.01)
    assert len(scans) == 20


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 20), st.floats(-math.pi, math.pi), st.floats(0.2, 1.5), st.floats(-0.5, 0.5))
def test_ranges_to_the_ground_are_exact(height, yaw, pitch, roll):
    """Beside the tower: range = height / −z of the ray, and no return above the horizon."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[:3, 3] = [30, 0, height]
    ray = rays(EXACT)
    exact, member = cast_rays(SCENE, T[None], ray)
    world = ray @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        at = -height / world[..., 2:] * world + T[:3, 3]
    ground = (world[..., 2] < -1e-3) & (np.abs(at[..., :2]).max(axis=-1) < TOWER.settings.floor_half_m - 0.1)
    tower = member[0] >= 0
    assert ground.any()
    np.testing.assert_allclose(exact[0][ground & ~tower], (-height / world[..., 2])[ground & ~tower], rtol=1e-4)
    assert np.isinf(exact[0][(world[..., 2] > 1e-3) & ~tower]).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_ray_hits_the_reported_member(seed):
    """A ray aimed at a point on a member from 2 m away hits it there, or another member before."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(len(TOWER.members)))
    begin, end = TOWER.axes[m]
    flange = np.array(TOWER.members[m].flange_a) * TOWER.members[m].section_m[0]
    target = begin + rng.uniform(0.05, 0.95) * (end - begin) + 0.5 * flange
    aim = rng.normal(size=3) * [1, 1, 0.2]
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(aim[None], [[1, 0, 0]])[0].as_matrix()
    T[:3, 3] = target - 2.0 * aim / np.linalg.norm(aim)
    exact, member = cast_rays(SCENE, T[None], np.array([[[1.0, 0, 0]]]))
    at = T[:3, 3] + exact[0, 0, 0] * T[:3, 0]
    if exact[0, 0, 0] < 2.0 - 0.15:
        assert T[2, 3] < 0 or member[0, 0, 0] >= 0
    else:
        assert np.linalg.norm(at - target) < 0.15
    if member[0, 0, 0] >= 0:
        begin, end = TOWER.axes[member[0, 0, 0]]
        away = np.linalg.norm(np.cross(at - begin, (end - begin) / np.linalg.norm(end - begin)))
        assert away < TOWER.members[member[0, 0, 0]].section_m[0] * 1.01 * np.sqrt(2)


def test_noise_has_the_sigma_of_its_settings(flight):
    flight = Trajectory(flight.stamp_s[:251], flight.T_world_drone[:251])
    for sensor in (TofSettings.preset("report-4cm"), TofSettings.preset("starling2")):
        exact, _ = scan_flight(TOWER, flight, sensor.replace(sigma_floor_m=0.0, sigma_relative=0.0), 1)
        noisy, _ = scan_flight(TOWER, flight, sensor, 1)
        np.testing.assert_array_equal(np.isnan(exact.range_m), np.isnan(noisy.range_m))
        sigma = np.maximum(sensor.sigma_floor_m, sensor.sigma_relative * exact.range_m)
        score = ((noisy.range_m - exact.range_m) / sigma)[np.isfinite(exact.range_m)]
        assert score.std() == pytest.approx(1, abs=0.02)
        assert abs(score.mean()) < 0.02
        limits = exact.range_m[np.isfinite(exact.range_m)]
        assert limits.min() >= RANGE_MIN_M
        assert limits.max() <= sensor.range_max_m


def test_noise_on_the_depth_is_the_same_at_the_corner_as_at_the_centre():
    """A wall ahead: each pixel's depth has the noise and the limits, and its range is the depth over the cosine."""
    sensor = TofSettings.preset("report")
    ahead, reported = rays(sensor)[..., 0], reported_rays(sensor)[..., 0]

    def measured(depth_m, seed=0):
        return measured_ranges((depth_m / ahead).astype(np.float32), sensor, np.random.default_rng(seed))

    depth = np.array([measured(2.0, seed) for seed in range(400)]) * reported
    corner, middle = depth[:, :8, :8], depth[:, 28:36, 28:36]
    assert ahead[:8, :8].max() < 0.5
    for part in (corner, middle):
        assert part.mean() == pytest.approx(2.0, abs=5e-4)
        assert part.std() == pytest.approx(0.01, rel=0.03)
    assert np.isfinite(measured(3.99)).all()  # though ranges reach 8 m
    assert np.isnan(measured(4.01)).all()
    assert np.isnan(measured(RANGE_MIN_M - 0.01)).all()


def test_the_report_s_driver_places_points_half_a_pixel_too_far_left_and_up(flight):
    report = TofSettings.preset("report").replace(sigma_floor_m=0.0, range_max_m=6.0)
    assert (report.pixel_origin, TofSettings.preset("starling2").pixel_origin) == ("corner", "centre")
    at_corner, at_centre = (
        scan_flight(TOWER, flight, report.replace(pixel_origin=origin), 1)[0][3].points
        for origin in ("corner", "centre")
    )
    off, depth = at_corner - at_centre, at_centre[..., 0]
    assert np.isfinite(depth).sum() > 300
    np.testing.assert_array_equal(np.isfinite(at_corner), np.isfinite(at_centre))
    half_pixel = np.tan(1.02) / 64  # of the depth
    np.testing.assert_allclose(off[..., 0], np.where(np.isfinite(depth), 0.0, np.nan), atol=1e-5)
    np.testing.assert_allclose(off[..., 1:], (half_pixel * depth)[..., None].repeat(2, axis=2), atol=1e-5)
    assert half_pixel == pytest.approx(0.5 / 19.65, rel=2e-3)
    along_ray = report.replace(noise_on="range")
    points = scan_flight(TOWER, flight, along_ray, 1)[0][3].points
    both = np.isfinite(points) & np.isfinite(at_corner)
    np.testing.assert_allclose(points[both], at_corner[both], atol=1e-5)


def test_draws_of_the_noise_share_the_flight_and_differ_in_nothing_else(flight):
    for sensor in ("report", "starling2"):
        tof = TofSettings.preset(sensor).replace(columns=30, rows=30, rate_hz=2.0)
        exact = scan_flight(TOWER, flight, noise_free(tof), 1)[0]
        scans = [scan_flight(TOWER, flight, tof.replace(draw=draw), 1)[0].range_m for draw in (0, 1, 2)]
        for draw, range_m in enumerate(scans):
            np.testing.assert_array_equal(range_m, add_noise(exact, tof.replace(draw=draw), 1).range_m)
            np.testing.assert_array_equal(np.isnan(range_m), np.isnan(exact.range_m))
        noise = np.array(scans) - exact.range_m
        seen = noise[:, np.isfinite(exact.range_m)]
        assert np.abs(np.corrcoef(seen) - np.eye(3)).max() < 0.1
        assert 0.005 < seen.std() < 0.05


def test_scans_are_taken_at_the_nearest_steps_from_the_start_on_or_at_given_ones(flight):
    sensor = TofSettings.preset("report").replace(rows=2, columns=2)

    def steps(**changes):
        return scan_flight(TOWER, flight, sensor.replace(**changes), 1)[0].stamp_s / 0.008

    np.testing.assert_allclose(steps(), 26 * np.arange(49), atol=1e-6)
    np.testing.assert_allclose(steps(start_s=1.0), 125 + 26 * np.arange(44), atol=1e-6)
    np.testing.assert_allclose(steps(samples=(3, 8, 700, 1000)), [3, 8, 700, 1000])
    np.testing.assert_allclose(steps(samples=(3, 8, 700, 1000), start_s=5.0), [700, 1000])
    uneven = steps(rate_hz=1 / 0.212, start_s=0.08)  # 26.5 steps a scan: to the nearest step
    np.testing.assert_allclose(uneven, np.round(uneven), atol=1e-6)
    np.testing.assert_allclose(uneven, 10 + 26.5 * np.arange(len(uneven)), atol=0.5001)


@pytest.mark.parametrize("sensor", ["report-4cm", "starling2-honest"])
def test_scans_depend_on_the_seed_and_a_longer_flight_begins_with_those_of_a_shorter_one(flight, sensor):
    shorter = Trajectory(flight.stamp_s[:251], flight.T_world_drone[:251])
    tof = TofSettings.preset(sensor).replace(columns=40, rows=40)
    longer, short, other = (
        scan_flight(TOWER, flown, tof, seed)[0].range_m for flown, seed in ((flight, 4), (shorter, 4), (shorter, 5))
    )
    assert (len(longer), len(short)) == (50, 10)
    np.testing.assert_array_equal(longer[:10], short)
    assert np.nanmax(np.abs(short - other)) > 0.01
