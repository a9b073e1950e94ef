import numpy as np
import pytest

from steelnb.errors import DegenerateCloudError, EmptyCloudError, SettingsError
from steelnb.mapping import VoxelMap
from steelnb.registration import make_target, register, voxel_target
from tests.registration.scenes import apart, motion, moved, room

METHODS = {"icp": "point", "plane": "plane", "gicp": "gicp", "vgicp": "gicp"}
DOFS = ("xyz", "xyz_yaw", "se3")


def voxels(points, voxel_m=0.1):
    result = VoxelMap(voxel_m)
    result.update_shapes(result.insert(points))
    return result


def as_target(points, kind, method):
    if kind == "map":
        return voxels(points)
    if kind == "prepared":
        return voxel_target(voxels(points)) if method == "vgicp" else make_target(points, METHODS[method])
    return points


@pytest.mark.parametrize("kind", ["cloud", "prepared", "map"])
@pytest.mark.parametrize("dof", DOFS)
@pytest.mark.parametrize("method", METHODS)
def test_every_error_dof_and_target_finds_the_pose_forward_inverse_and_from_perturbed_starts(method, dof, kind):
    here = room(3000, 1)
    T_true = motion(3, 0.08, dof)
    there = moved(here, T_true)
    # The very same points are found to the solver's tolerance; means of voxels are other points than the source's.
    shift_m, turn_deg = (1e-3, 0.02) if kind != "map" and method != "vgicp" else (0.012, 0.2)
    settings = {"method": method, "dof": dof, "max_correspondence_m": 0.5, "voxel_m": 0.1}
    forward = register(here, as_target(there, kind, method), **settings)
    inverse = register(there, as_target(here, kind, method), **settings)
    starts = [motion(4, 0.1, dof, seed) @ T_true for seed in (1, 2)]
    perturbed = [register(here, as_target(there, kind, method), T_init=start, **settings) for start in starts]
    for result, T in [(forward, T_true), (inverse, np.linalg.inv(T_true)), *((one, T_true) for one in perturbed)]:
        assert result.converged, result.reason
        assert np.less(apart(result.T_target_source, T), (shift_m, turn_deg)).all()
    assert apart(starts[0], T_true)[0] > 5 * shift_m
    assert dof == "xyz" or apart(starts[0], T_true)[1] > 5 * turn_deg


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dof", ["xyz", "xyz_yaw"])
def test_a_restricted_solve_keeps_the_rest_of_the_start(method, dof):
    points = room(2000, 2)
    tilt = motion(2, 0.0, "se3", 5)
    # The start is tilted against the truth. What is not free keeps the tilt exactly; what is free finds its optimum.
    result = register(points, points, method, dof, T_init=tilt, max_correspondence_m=0.5)
    change = result.T_target_source[:3, :3] @ tilt[:3, :3].T
    np.testing.assert_allclose(change[2], [0, 0, 1], atol=1e-12)
    if dof == "xyz":
        np.testing.assert_allclose(change, np.eye(3), atol=1e-12)
    else:
        assert np.abs(change - np.eye(3)).max() > 1e-3


def test_yaw_is_about_the_gravity_that_is_given():
    points, up = room(2000, 2), np.array([0.0, 1.0, 0.0])
    T_true = motion(3, 0.05, "se3")
    T_true[:3, :3] = [[np.cos(0.05), 0, np.sin(0.05)], [0, 1, 0], [-np.sin(0.05), 0, np.cos(0.05)]]
    right = register(points, moved(points, T_true), "plane", "xyz_yaw", max_correspondence_m=0.5, gravity=-7 * up)
    wrong = register(points, moved(points, T_true), "plane", "xyz_yaw", max_correspondence_m=0.5)
    assert np.less(apart(right.T_target_source, T_true), (1e-3, 0.02)).all()
    assert apart(wrong.T_target_source, T_true)[1] > 1


def test_robust_kernels_resist_points_that_belong_to_nothing():
    here = room(3000, 3)
    stray = here[:900] + np.array([0.25, 0.1, 0.2])  # a third of the scan shifted to one side
    source = np.concatenate([here, stray])
    error_m = {
        robust: apart(register(source, here, "icp", robust=robust, robust_scale=0.03).T_target_source, np.eye(4))[0]
        for robust in ("none", "huber", "cauchy", "geman_mcclure")
    }
    assert error_m["none"] > 0.02
    assert max(error_m["huber"], error_m["cauchy"]) < 0.7 * error_m["none"]
    assert error_m["geman_mcclure"] < 2e-3


def test_invalid_returns_and_images_are_taken():
    points = room(1200, 4)
    image = points.reshape(30, 40, 3).copy()
    image[3, 5, 1], image[7, 7, 0] = np.nan, np.inf
    result = register(image, moved(points, motion(1, 0.05)), "icp")
    assert np.less(apart(result.T_target_source, motion(1, 0.05)), (1e-3, 0.02)).all()
    assert result.inliers == 1198


def test_clouds_without_overlap_do_not_converge():
    points = room(500, 5)
    result = register(points, points + 100.0, "gicp", max_correspondence_m=0.5)
    assert not result.converged
    assert (result.reason, result.inliers) == ("too few pairs", 0)
    np.testing.assert_array_equal(result.T_target_source, np.eye(4))


SHEAR = np.eye(4) + 0.1 * np.eye(4, k=1)
MIRROR = np.diag([1.0, 1, -1, 1])


@pytest.mark.parametrize(
    ("change", "fault", "message"),
    [
        ({"source": np.zeros((0, 3))}, EmptyCloudError, "source: no finite point"),
        ({"source": np.full((5, 3), np.nan)}, EmptyCloudError, "source: no finite point"),
        ({"target": np.full((4, 4, 3), np.nan)}, EmptyCloudError, "target: no finite point"),
        ({"target": VoxelMap(0.1)}, EmptyCloudError, "target: "),
        ({"target": VoxelMap(0.1), "method": "vgicp"}, EmptyCloudError, "empty voxel map"),
        ({"source": np.zeros((7, 2))}, EmptyCloudError, r"source: an array of shape \(7, 2\)"),
        ({"source": np.eye(3)[:2], "method": "icp"}, DegenerateCloudError, "source: 2 finite .* at least 3"),
        ({"source": np.ones((5, 3)), "method": "plane"}, DegenerateCloudError, "source: 5 finite .* at least 6"),
        ({"target": np.ones((3, 3))}, DegenerateCloudError, "target: 3 finite points, expected at least 4"),
        ({"T_init": np.eye(3)}, SettingsError, r"T_init of shape \(3, 3\)"),
        ({"T_init": np.full((4, 4), np.inf)}, SettingsError, "finite numbers"),
        ({"T_init": SHEAR}, SettingsError, "not rigid"),
        ({"T_init": MIRROR}, SettingsError, "det R = -1"),
        ({"T_init": np.diag([2.0, 2, 2, 1])}, SettingsError, "not rigid"),
        ({"method": "icpp"}, SettingsError, "method = 'icpp': expected one of 'icp'"),
        ({"dof": "yaw"}, SettingsError, "dof = 'yaw'"),
        ({"dof": ""}, SettingsError, "dof = ''"),
        ({"robust": "tukey"}, SettingsError, "robust = 'tukey'"),
        ({"robust_scale": 0.0}, SettingsError, "robust_scale = 0.0"),
        ({"max_correspondence_m": 0.0}, SettingsError, "max_correspondence_m = 0.0: expected a positive"),
        ({"max_correspondence_m": -1.0}, SettingsError, "max_correspondence_m = -1.0"),
        ({"max_correspondence_m": np.nan}, SettingsError, "max_correspondence_m = nan"),
        ({"max_correspondence_m": np.inf}, SettingsError, "max_correspondence_m = inf"),
        ({"gravity": np.zeros(3), "dof": "xyz_yaw"}, SettingsError, "gravity"),
        ({"iterations_max": 0}, SettingsError, "iterations_max = 0"),
        ({"neighbours": 3}, SettingsError, "neighbours = 3"),
        ({"voxel_m": 0.0, "method": "vgicp"}, SettingsError, "voxel_m = 0.0"),
        ({"target": make_target(room(50, 1), "point")}, SettingsError, "prepared for another error"),
        ({"target": voxel_target(voxels(room(50, 1)))}, SettingsError, "'vgicp' only"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, fault, message):
    given = {"source": room(50, 1), "target": room(50, 1), **change}
    with pytest.raises(fault, match=message) as caught:
        register(**given)
    assert "\n" not in str(caught.value)
