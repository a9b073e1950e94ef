"""Faults of a real Time-of-Flight camera, on walls about a sensor at (0, 0, 5) that looks along x."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.core import rng
from steelnb.core.types import Trajectory
from steelnb.settings import FlightSettings, TofSettings
from steelnb.simulation import build_tower, scan_flight
from steelnb.simulation.flight import pose_on_path
from steelnb.simulation.raycasting import cast_rays, make_scene, rays
from steelnb.simulation.tof import TofCamera, measured_ranges, take_view
from steelnb.simulation.tof_faults import (
    LATE_S,
    MIDDLE,
    MOMENTS,
    MOUNT_SIGMA_RAD,
    STARLING2_FAULTS,
    WIGGLE_PERIOD_M,
    Faults,
    amplitudes,
    draw_faults,
    draw_mount,
    expose,
    fill_bundle,
    mix_phasors,
)
from tests import naive

SMALL = TofSettings(
    columns=24, rows=20, fov_horizontal_rad=0.4, fov_vertical_rad=0.3, range_max_m=8.0, sigma_floor_m=0.0
)
HERE = np.eye(4)
HERE[2, 3] = 5.0
TOWER = build_tower()


def tower_of(*corners):
    """A tower of rectangles, each given by a corner and the two adjacent ones."""
    vertices = np.array([(a, b, b + c - a, c) for a, b, c in np.array(corners, dtype=float)]).reshape(-1, 3)
    triangles = np.array([(n, n + k, n + k + 1) for n in range(0, len(vertices), 4) for k in (1, 2)])
    return replace(TOWER, vertices=vertices, triangles=triangles, triangle_member=np.repeat(np.arange(len(corners)), 2))


def walls(*corners):
    return make_scene(tower_of(*corners))


def wall(x, y_from=-6.0, y_to=6.0, lean=0.0):
    """A wall perpendicular to the view; ``lean`` is the slope of x over y."""
    return ((x + lean * y_from, y_from, 0), (x + lean * y_to, y_to, 0), (x + lean * y_from, y_from, 10))


def seen(scene, faults, tof=SMALL, T=HERE, seed=1):
    return expose(scene, tof, faults, np.broadcast_to(T, (9, 4, 4)), rng.stream(seed, "test"))


def moving(velocity, seconds=1.0, step_s=0.008):
    stamp = np.arange(round(seconds / step_s) + 1) * step_s
    T = np.tile(HERE, (len(stamp), 1, 1))
    T[:, :3, 3] += (stamp[:, None] - 0.5 * seconds) * velocity
    return Trajectory(stamp, T)


def test_an_exposure_without_faults_equals_the_ideal_camera():
    scene, T = make_scene(TOWER), pose_on_path(TOWER, FlightSettings.preset("zigzag"), 0.3)
    tof = TofSettings.preset("report-4cm")
    exact, member = cast_rays(scene, T[None], rays(tof))
    found = seen(scene, Faults(), tof, T)
    same = found.member == member[0]
    assert same.mean() > 0.999  # rays that graze an edge may fall to either side
    np.testing.assert_allclose(found.range_m[same], exact[0][same], rtol=1e-5)
    np.testing.assert_array_equal(found.exact_m, found.range_m)


@pytest.mark.kernels
def test_mixing_phasors_equals_its_slow_twin():
    random = np.random.default_rng(2)
    range_m = random.uniform(1, 4, (9, 40)).astype(np.float32)
    range_m[random.random((9, 40)) < 0.3] = np.inf
    range_m[:, 3] = np.inf
    light = (random.uniform(0, 1, range_m.shape) / range_m**2).astype(np.float32)
    multipath_m = (range_m + random.uniform(0, 1, range_m.shape)).astype(np.float32)
    multipath_amplitude = np.where(random.random(range_m.shape) < 0.5, 0.3 * light, 0).astype(np.float32)
    mixed, equivalent = np.empty(40), np.empty(40)
    mix_phasors(range_m, light, multipath_m, multipath_amplitude, mixed, equivalent)
    expected = np.array(
        [naive.mixed(*column) for column in zip(range_m.T, light.T, multipath_m.T, multipath_amplitude.T, strict=True)]
    )
    np.testing.assert_allclose(mixed, expected[:, 0], rtol=1e-5)
    np.testing.assert_allclose(equivalent, expected[:, 1], rtol=1e-5)
    assert np.isinf(mixed[3])


def test_mixed_pixels_lie_between_two_depths_and_only_at_their_edge():
    # The near wall covers the right half and a quarter of the column beside it: three of the nine rays of its pixels.
    pitch = 2 * np.tan(0.2) / 24
    scene = walls(wall(2.0, -6.0, 2.0 * 0.2501 * pitch), wall(3.5))
    sharp, mixed = (seen(scene, Faults(footprint_px=width)) for width in (0.0, 1.0))
    near, far = (seen(walls(wall(x)), Faults()).range_m for x in (2.0, 3.5))
    between = (mixed.range_m > 1.001 * near) & (mixed.range_m < 0.999 * far)
    edge = np.zeros(between.shape, dtype=bool)
    edge[:, 11] = True
    np.testing.assert_array_equal(between, edge)
    np.testing.assert_allclose(mixed.range_m[~edge], sharp.range_m[~edge], rtol=1e-3)
    assert not ((sharp.range_m > 1.001 * near) & (sharp.range_m < 0.999 * far)).any()
    # Light 3 / 2² from near and 6 / 3.5² from far, 1.5 m apart of the 7.5 m of a period.
    apart = 2 * np.pi * 1.5 / 7.5
    share = np.angle(3 / 2**2 + 6 / 3.5**2 * np.exp(1j * apart)) / apart
    np.testing.assert_allclose(((mixed.range_m - near) / (far - near))[edge], share, atol=0.01)
    assert (mixed.equivalent_range_m[edge] > near[edge]).all()
    wider = seen(scene, Faults(footprint_px=3.0)).range_m
    assert ((wider > 1.001 * near) & (wider < 0.999 * far)).sum() > edge.sum()


def test_multipath_makes_corners_too_deep_and_does_not_change_a_plane():
    plane = walls(wall(3.0))
    corner = walls(((3, -6, 0), (3, 0.3, 0), (3, -6, 10)), ((3, 0.3, 0), (0.5, 0.3, 0), (3, 0.3, 10)))
    once, twice = Faults(), Faults(multipath=1.0)
    np.testing.assert_array_equal(seen(plane, once).range_m, seen(plane, twice).range_m)
    deeper = seen(corner, twice).range_m - seen(corner, once).range_m
    assert deeper.min() > -1e-3  # rays go on from 1 mm above the surface
    inside, away = deeper[:, 5:10].mean(), deeper[:, -4:].mean()  # the corner is left of the middle
    assert 0.01 < inside < 0.5
    assert away < 0.5 * inside
    half = seen(corner, Faults(multipath=0.5)).range_m - seen(corner, once).range_m
    assert 0.4 * inside < half[:, 5:10].mean() < 0.95 * inside


def test_motion_blurs_edges_but_not_a_plane_along_it():
    edge, plane = walls(wall(2.0, -6.0, 0.0), wall(3.5)), walls(wall(2.0))
    np.testing.assert_allclose([MOMENTS.reshape(3, 3).sum(axis=axis) for axis in (0, 1)], 0, atol=1e-12)
    assert MOMENTS[MIDDLE] == 0
    flight = moving(np.array([0.0, 2.0, 0.0]))
    faults = Faults(exposure_s=0.03)
    found = {}
    for name, scene in (("edge", edge), ("plane", plane)):
        poses = flight.between(0.5 + faults.exposure_s * MOMENTS)
        found[name] = seen(scene, faults, T=poses).range_m
    np.testing.assert_allclose(found["plane"], seen(plane, Faults()).range_m, rtol=1e-5)
    # The edge, between two columns of 34 mm, moves by 27 mm to either side: past the middle of both.
    near, far = (seen(walls(wall(x)), Faults()).range_m for x in (2.0, 3.5))
    between = (found["edge"] > 1.02 * near) & (found["edge"] < 0.98 * far)
    expected = np.zeros(between.shape, dtype=bool)
    expected[:, 11:13] = True
    np.testing.assert_array_equal(between, expected)


def test_exposures_are_centred_on_the_stamps():
    """Towards a wall at 2 m/s: the range is that in the middle of the exposure."""
    trajectory = moving(np.array([2.0, 0.0, 0.0]))
    blurred, sharp = (
        scan_flight(tower_of(wall(4.0)), trajectory, SMALL.replace(faults=each), 1)[0] for each in (("exposure",), ())
    )
    np.testing.assert_allclose(blurred.range_m[1:], sharp.range_m[1:], atol=5e-4)  # half the exposure is 30 mm


def test_late_stamps_are_those_of_earlier_images():
    trajectory = moving(np.array([2.0, 0.0, 0.0]))
    late, right = (
        scan_flight(tower_of(wall(4.0)), trajectory, SMALL.replace(faults=each), 1)[0] for each in (("latency",), ())
    )
    middle = np.s_[1:, SMALL.rows // 2, SMALL.columns // 2]
    np.testing.assert_array_equal(late.stamp_s, right.stamp_s)
    np.testing.assert_allclose(late.range_m[middle] - right.range_m[middle], 2.0 * LATE_S, rtol=0.01)


def test_a_camera_on_a_bracket_is_not_where_it_is_stated():
    named = SMALL.replace(faults=("mount",))
    trajectory, scene = moving(np.array([0.2, 0.0, 0.0])), tower_of(wall(4.0, lean=0.5))
    found = scan_flight(scene, trajectory, named, 3)[0]
    drawn = np.array([named.T_drone_sensor] * 2)
    drawn[1] = draw_mount(named, rng.stream(3, "tof-mount"))
    camera = walls(wall(4.0, lean=0.5))
    stated, true = (seen(camera, Faults(), T=trajectory.T_world_drone[0] @ T).range_m for T in drawn)
    np.testing.assert_allclose(found.range_m[0], true, atol=1e-4)
    assert np.abs(true - stated).max() > 0.01
    turns = [draw_mount(named, rng.stream(seed, "tof-mount"))[:3, :3] @ drawn[0, :3, :3].T for seed in range(300)]
    sizes = Rotation.from_matrix(np.array(turns)).as_rotvec()
    np.testing.assert_allclose(sizes.std(axis=0), MOUNT_SIGMA_RAD, rtol=0.15)
    assert named.T_drone_sensor.tolist() == SMALL.T_drone_sensor.tolist()


def test_regression_recovers_offset_scale_and_wiggle_of_a_camera():
    faults = Faults(wiggle_m=0.006, phase_rad=2.0, offset_m=0.01, scale_error=0.004)
    scene = walls(wall(3.0, -1.2, 6.0, lean=2.0))
    tof = SMALL.replace(columns=200, fov_horizontal_rad=1.2)
    exact, measured = (seen(scene, each, tof).range_m for each in (Faults(), faults))
    some = np.isfinite(exact)
    r, error = exact[some].astype(float), (measured[some] - exact[some]).astype(float)
    assert np.ptp(r) > 3
    turn = 2 * np.pi * r / WIGGLE_PERIOD_M
    fitted = np.linalg.lstsq(np.column_stack([np.ones_like(r), r, np.sin(turn), np.cos(turn)]), error, rcond=None)[0]
    np.testing.assert_allclose(fitted[:2], [0.01, 0.004], atol=1e-4)
    assert np.hypot(fitted[2], fitted[3]) == pytest.approx(0.006, abs=1e-4)
    assert np.arctan2(fitted[3], fitted[2]) == pytest.approx(2.0, abs=0.02)


def test_cameras_differ_by_their_seed_as_much_as_the_type_does():
    honest = TofSettings.preset("starling2-honest")
    cameras = [draw_faults(honest, rng.stream(seed, "tof-camera")) for seed in range(400)]
    errors = np.array([(camera.offset_m, camera.scale_error) for camera in cameras])
    sizes = STARLING2_FAULTS["calibration"]
    np.testing.assert_allclose(errors.std(axis=0), list(sizes.values()), rtol=0.12)
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=8e-4)
    assert draw_faults(honest, rng.stream(3, "tof-camera")) == cameras[3]
    assert draw_faults(honest.replace(faults=()), rng.stream(3, "tof-camera")) is None


def noisy(scene, faults, tof, times=60):
    """Measured images of many exposures of one scene, and the scene's exact range."""
    images = []
    for k in range(times):
        one = seen(scene, faults, tof, seed=k)
        images.append(measured_ranges(one.range_m, tof, rng.stream(k, "noise"), faults, one.equivalent_range_m))
    return np.array(images), one.exact_m


def test_noise_depends_on_range_reflectivity_and_incidence():
    """σ = 1 % of r / √(ρ cos θ)."""
    tof = SMALL.replace(sigma_relative=0.01)
    for x, lean, reflectivity in ((2.0, 0.0, 1.0), (4.0, 0.0, 1.0), (2.0, 0.0, 0.25), (2.0, 2.0, 1.0)):
        images, exact = noisy(walls(wall(x, lean=lean)), Faults(reflectivity=reflectivity), tof)
        cosine = np.abs(rays(tof) @ [1, -lean, 0]) / np.hypot(1, lean)
        score = (images - exact) / (0.01 * exact / np.sqrt(reflectivity * cosine))
        assert score.std() == pytest.approx(1, abs=0.03)
        assert abs(score.mean()) < 0.03


def test_lateral_noise_affects_a_slope_and_not_a_perpendicular_wall():
    square, slope = (noisy(walls(wall(2.0, lean=lean)), Faults(lateral_px=0.5), SMALL)[0] for lean in (0.0, 2.0))
    middle = (slice(None), slice(8, 12), slice(10, 14))
    pixel_m = 2 * 2.0 * np.tan(0.2) / 24
    assert square[middle].std(axis=0).max() < 1e-3
    # One pixel sideways on a slope of 2 is two pixels in depth.
    assert slope[middle].std(axis=0).mean() == pytest.approx(0.5 * 2 * pixel_m, rel=0.2)


def test_dropout_grows_with_range_and_incidence_and_with_a_darker_surface():
    tof = SMALL.replace(sigma_relative=0.01)

    def lost(x, lean=0.0, reflectivity=0.5):
        faults = Faults(reflectivity=reflectivity, sigma_max_m=0.05)
        return np.isnan(noisy(walls(wall(x, lean=lean)), faults, tof, 40)[0][:, 8:12, 11:13]).mean()

    by_range = [lost(x) for x in (2.0, 3.2, 3.6, 4.5)]
    by_incidence = [lost(2.5, lean) for lean in (0.0, 1.5, 2.5, 6.0)]
    by_darkness = [lost(2.5, reflectivity=rho) for rho in (1.0, 0.25, 0.2, 0.1)]
    for shares in (by_range, by_incidence, by_darkness):
        assert shares[0] < 0.01
        assert np.all(np.diff(shares) > 0)
        assert shares[-1] > 0.9


def test_a_view_with_faults_is_an_exposure():
    T = pose_on_path(TOWER, FlightSettings.preset("zigzag"), 0.4)
    tof = TofSettings.preset("starling2").replace(columns=45, rows=60, sigma_floor_m=0.0, sigma_relative=0.0)
    ideal, worse = (
        take_view(TofCamera(TOWER, tof.replace(faults=faults), 0), T, rng.stream(1, "view"))
        for faults in ((), ("footprint",))
    )
    assert np.linalg.norm(ideal.points - ideal.surface, axis=1).max() < 1e-4
    assert np.linalg.norm(worse.points - worse.surface, axis=1).max() > 0.05


def test_rays_and_amplitudes_of_kernels_are_those_of_numpy_to_the_bit():
    random = np.random.default_rng(3)
    T = np.stack([pose_on_path(TOWER, FlightSettings.preset("zigzag"), share) for share in np.linspace(0.1, 0.3, 9)])
    plane, grid, lateral = random.normal(size=(50, 2)), random.normal(size=(9, 2)), random.normal(size=(50, 2))
    pixel, bundle = np.array([-0.01, -0.02]), np.empty((9, 50, 6), np.float32)
    fill_bundle(T, plane, grid, lateral, pixel, bundle)
    np.testing.assert_array_equal(bundle, naive.fill_bundle(T, plane, grid, lateral, pixel))
    range_m = random.uniform(0.2, 6.0, (9, 50)).astype(np.float32)
    range_m[:, ::7] = np.inf
    normal = random.normal(size=(9, 50, 3)).astype(np.float32)
    found = amplitudes(bundle, range_m, normal, 0.5)
    np.testing.assert_array_equal(found, naive.amplitudes(bundle, range_m, normal, 0.5))
    assert (found[:, ::7] == 0).all()
    assert (found[:, 1::7] > 0).all()
