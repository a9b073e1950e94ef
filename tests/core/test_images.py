import numpy as np
import pytest

from steelnb.core.types import CameraImages, project, unproject

K = np.array([[100.0, 0.0, 79.5], [0.0, 110.0, 59.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("stamp_s", "number"), [(0.3, 3), (0.34, 3), (0.36, None), (0.3999999, 4), (0.399, None), (-0.01, None), (0.94, 9)]
)
def test_a_stamp_has_the_last_image_up_to_half_a_period_before_it(stamp_s, number):
    images = CameraImages(0.1 * np.arange(10), [], K, np.eye(4))
    assert images.at(stamp_s) == number
    assert CameraImages(np.zeros(0), [], K, np.eye(4)).at(0.0) is None


def test_u_points_right_and_v_down():
    points = np.array([[2.0, 0.0, 0.0], [2.0, 0.5, 0.0], [2.0, 0.0, 0.5], [-1.0, 0.0, 0.0]])
    pixel = project(points, K)
    np.testing.assert_allclose(pixel[:3], [[79.5, 59.5], [54.5, 59.5], [79.5, 32.0]])
    assert np.isnan(pixel[3]).all()
    homogeneous = points[:3] @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]]) @ K.T  # K (−y, −z, x)
    np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], pixel[:3])
    np.testing.assert_allclose(2.0 * unproject(pixel[:3], K), points[:3], atol=1e-12)
