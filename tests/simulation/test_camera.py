import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.types import Trajectory, project
from steelnb.settings import ExperimentSettings
from steelnb.simulation import FORWARD, Camera, build_tower, camera, photograph
from steelnb.simulation.camera import SAMPLES, SIZE, _sample_tile, intrinsics, make_texture
from steelnb.simulation.raycasting import cast_rays, make_scene, rays

TOWER = build_tower()
SMALL = FORWARD.replace(columns=211, rows=160)


def pose(x=-3.2, y=0.2, z=5.0, yaw=0.0, pitch=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, 0.0]).as_matrix()
    T[:3, 3] = x, y, z
    return T


def moving(velocity=(0.0, 0.4, 0.0), yaw_rate=0.0):
    """A flight of two seconds in front of a face of the tower."""
    stamp_s = 0.008 * np.arange(251)
    T = np.array([pose(y=-0.4 + velocity[1] * t, z=5.0 + velocity[2] * t, yaw=yaw_rate * t) for t in stamp_s])
    return Trajectory(stamp_s, T)


def test_intrinsics_are_those_of_the_rays():
    v, u = np.mgrid[: FORWARD.rows, : FORWARD.columns]
    pixel = project(7.0 * rays(FORWARD).reshape(-1, 3), intrinsics(FORWARD))
    np.testing.assert_allclose(pixel, np.column_stack([u.ravel(), v.ravel()]), atol=1e-9)


def test_images_depend_on_the_seed_and_not_on_the_order_of_access():
    images, again, other = (photograph(TOWER, moving(), SMALL, seed).images for seed in (3, 3, 4))
    later = again[4].copy()
    for k in (0, 4):
        assert images[k].dtype == np.uint8
        assert images[k].shape == (160, 211)
        np.testing.assert_array_equal(images[k], again[k])
    np.testing.assert_array_equal(later, images[4])
    apart = images[0].astype(float) - other[0]
    assert 1.0 < apart.std() < 5.0
    assert (images[0] != images[4]).mean() > 0.5
    assert len(images) == 21
    with pytest.raises(IndexError):
        images[21]


def test_a_texture_moves_with_its_member():
    """Patches on steel are found within a pixel of the position predicted by depth and motion."""
    camera, ray, apart = Camera(TOWER, FORWARD), rays(FORWARD), []
    T = np.array([pose(x=-2.6), pose(x=-2.55, y=0.26, z=5.03, yaw=0.05)])
    first, second = (camera.render(np.tile(each, (SAMPLES, 1, 1))) for each in T)
    range_m, hit = cast_rays(make_scene(TOWER), T, ray)
    depth = range_m[0] * ray[..., 0]
    for v in range(20, 300, 3):
        for u in range(20, 402, 3):
            here = np.s_[v - 4 : v + 5, u - 4 : u + 5]
            member, patch = hit[0][here], first[here]
            if member[4, 4] < 0 or (member != member[4, 4]).any() or patch.std() < 18 or np.ptp(depth[here]) > 0.05:
                continue
            point = range_m[0][v, u] * ray[v, u]
            moved = np.linalg.inv(T[1]) @ T[0] @ np.append(point, 1)
            expected = project(moved[None, :3], intrinsics(FORWARD))[0]
            i, j = np.rint(expected).astype(int)
            if not (10 < i < 411 and 10 < j < 309) or (hit[1][j - 4 : j + 5, i - 4 : i + 5] != member[4, 4]).any():
                continue
            scores = {
                (du, dv): np.corrcoef(patch.ravel(), second[b - 4 : b + 5, a - 4 : a + 5].ravel())[0, 1]
                for du in range(-5, 6)
                for dv in range(-5, 6)
                for a, b in [(i + du, j + dv)]
            }
            du, dv = max(scores, key=scores.get)
            apart.append(np.hypot(i + du - expected[0], j + dv - expected[1]))
            assert np.linalg.norm(expected - (u, v)) > 2
    assert len(apart) > 20
    assert np.mean(np.array(apart) <= 1.0) > 0.9


def test_motion_blurs_only_along_its_direction(monkeypatch):
    monkeypatch.setattr(camera, "READ_NOISE", 0.0)
    monkeypatch.setattr(camera, "GAIN", 0.0)
    monkeypatch.setattr(camera, "SAMPLES", 9)
    still, moved, found = moving((0.0, 0.0, 0.0)), moving((0.0, 0.4, 0.0)), []
    for path, exposure_s in ((moved, 0.0), (still, 0.6), (moved, 0.6)):
        monkeypatch.setattr(camera, "EXPOSURE_S", exposure_s)
        found.append(photograph(TOWER, path, SMALL, 1).images[10].astype(float))
    crisp, unmoved, blurred = found
    across = [np.abs(np.diff(image[:90], axis=1)).mean() for image in (crisp, unmoved, blurred)]
    assert across[1] > 0.85 * across[0]
    assert across[2] < 0.7 * across[0]
    assert np.abs(np.diff(blurred[:90], axis=0)).mean() > across[2]


def test_distant_textures_are_averaged_and_near_ones_are_not():
    pyramid = make_texture(TOWER).pyramid
    tile = pyramid[: SIZE * SIZE].reshape(SIZE, SIZE)
    places = np.random.default_rng(1).uniform(0, 3 * SIZE, (100, 2))
    near, far = ([_sample_tile(pyramid, u, v, patch) for u, v in places] for patch in (1.0, 0.9 * SIZE))
    assert np.std(near) > 0.5
    np.testing.assert_allclose(far, tile.mean(), atol=0.1)
    assert _sample_tile(pyramid, 17.5, 33.5, 1.0) == pytest.approx(tile[33, 17])


def test_images_are_rendered_only_for_methods_that_use_them():
    settings = ExperimentSettings.preset(method="best", duration_s=1.0)
    assert experiment.simulate(settings)[0].images is None
    settings = ExperimentSettings.preset(method="orb", duration_s=1.0)
    flight, _ = experiment.simulate(settings)
    np.testing.assert_array_equal(flight.images.K, intrinsics(FORWARD))
    assert all(flight.images.at(stamp_s) is not None for stamp_s in flight.prior.stamp_s)
