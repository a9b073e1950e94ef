import numpy as np
import pytest

from steelnb.errors import DegenerateCloudError, EmptyCloudError, SettingsError
from steelnb.points import VoxelMap
from steelnb.registration import make_target, register
from tests.registration.scenes import apart, corner, motion, moved


def test_invalid_returns_and_images_are_taken():
    points = corner(1200, 4)
    image = points.reshape(30, 40, 3).copy()
    image[3, 5, 1], image[7, 7, 0] = np.nan, np.inf
    result = register(image, moved(points, motion(1, 0.05)), "icp")
    assert np.less(apart(result.T_target_source, motion(1, 0.05)), (1e-3, 0.02)).all()
    assert result.inliers == 1198


def test_clouds_without_overlap_do_not_converge():
    points = corner(500, 5)
    result = register(points, points + 100.0, "gicp", max_correspondence_m=0.5)
    assert not result.converged
    assert (result.reason, result.inliers) == ("too few pairs", 0)
    np.testing.assert_array_equal(result.T_target_source, np.eye(4))


@pytest.mark.parametrize(
    ("change", "fault", "message"),
    [
        ({"source": np.zeros((0, 3))}, EmptyCloudError, "source: no finite point"),
        ({"source": np.full((5, 3), np.nan)}, EmptyCloudError, "source: no finite point"),
        ({"target": np.full((4, 4, 3), np.nan)}, EmptyCloudError, "target: no finite point"),
        ({"target": VoxelMap(0.1)}, EmptyCloudError, "target: "),
        ({"source": np.zeros((7, 2))}, SettingsError, r"source: an array of shape \(7, 2\)"),
        ({"source": np.eye(3)[:2], "method": "icp"}, DegenerateCloudError, "source: 2 finite .* at least 3"),
        ({"source": np.ones((5, 3)), "method": "plane"}, DegenerateCloudError, "source: 5 finite .* at least 6"),
        ({"target": np.ones((3, 3))}, DegenerateCloudError, "target: 3 finite points, expected at least 4"),
        ({"T_init": np.eye(3)}, SettingsError, r"T_init: an array of shape \(3, 3\)"),
        ({"method": "icpp"}, SettingsError, "method = 'icpp': expected one of 'icp'"),
        ({"dof": "yaw"}, SettingsError, "dof = 'yaw'"),
        ({"dof": ""}, SettingsError, "dof = ''"),
        ({"robust_scale": 0.0}, SettingsError, "robust_scale = 0.0"),
        ({"max_correspondence_m": 0.0}, SettingsError, "max_correspondence_m = 0.0: expected a positive"),
        ({"max_correspondence_m": -1.0}, SettingsError, "max_correspondence_m = -1.0"),
        ({"max_correspondence_m": np.nan}, SettingsError, "max_correspondence_m = nan"),
        ({"max_correspondence_m": np.inf}, SettingsError, "max_correspondence_m = inf"),
        ({"gravity": np.zeros(3), "dof": "xyz_yaw"}, SettingsError, "gravity"),
        ({"iterations_max": 0}, SettingsError, "iterations_max = 0"),
        ({"neighbours": 3}, SettingsError, "neighbours = 3"),
        ({"target": make_target(corner(50, 1), "point")}, SettingsError, "prepared for another error"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, fault, message):
    given = {"source": corner(50, 1), "target": corner(50, 1), **change}
    with pytest.raises(fault, match=message) as caught:
        register(**given)
    assert "\n" not in str(caught.value)
