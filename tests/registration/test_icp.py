import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.points import VoxelMap
from steelnb.registration import register
from tests.registration.scenes import corner, motion, pose_error, transformed


def test_images_and_invalid_returns_are_accepted():
    points = corner(1200, 4)
    image = points.reshape(30, 40, 3).copy()
    image[3, 5, 1], image[7, 7, 0] = np.nan, np.inf
    result = register(image, transformed(points, motion(1, 0.05)), "icp")
    assert np.less(pose_error(result.T_target_source, motion(1, 0.05)), (1e-3, 0.02)).all()
    assert result.inliers == 1198


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source": np.zeros((0, 3))}, "source"),
        ({"target": np.full((4, 4, 3), np.nan)}, "target"),
        ({"target": VoxelMap(0.1)}, "target"),
        ({"source": np.eye(3)[:2], "method": "icp"}, "source"),
        ({"T_init": np.eye(3)}, "T_init"),
        ({"dof": ""}, "dof"),
        ({"robust_scale": 0.0}, "robust_scale"),
        ({"max_correspondence_m": np.inf}, "max_correspondence_m"),
        ({"translation_epsilon_m": np.nan}, "translation_epsilon_m"),
    ],
)
def test_invalid_input_is_named_in_the_error(change, message):
    given = {"source": corner(50, 1), "target": corner(50, 1), **change}
    with pytest.raises(InputError, match=message):
        register(**given)
