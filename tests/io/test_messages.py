"""Points and depth from the bytes of messages, as their definitions say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from steelnb.core.errors import InputError
from steelnb.io.bag_writer import Messages
from steelnb.io.messages import POINT_TYPES, camera_matrix, cloud_points, depth_points, typestore

MAKE = Messages(2)


def cloud(points, kind=7, order="<", offset=0, step=None, row_step=None, padding=0, names="xyz"):  # type: ignore[no-untyped-def]
    """A PointCloud2 of points ``(H, W, 3)`` of one type, with bytes before and behind each."""
    rows, columns = points.shape[:2]
    dtype = np.dtype(order + POINT_TYPES[kind])
    step = step or offset + 3 * dtype.itemsize + 1
    data = np.full((rows, columns * step + padding), 0xEE, np.uint8)
    for k in range(3):
        at = offset + k * dtype.itemsize + step * np.arange(columns)
        values = np.ascontiguousarray(points[..., k].astype(dtype))
        each = values.view(np.uint8).reshape(rows, columns, dtype.itemsize)
        for byte in range(dtype.itemsize):
            data[:, at + byte] = each[..., byte]
    fields = [
        MAKE.make("sensor_msgs/msg/PointField", n, offset + k * dtype.itemsize, kind, 1) for k, n in enumerate(names)
    ]
    of_row = columns * step + padding if row_step is None else row_step
    header = MAKE.header(0, "tof")
    kinds = "sensor_msgs/msg/PointCloud2"
    return MAKE.make(kinds, header, rows, columns, fields, order == ">", step, of_row, data.reshape(-1), True)


@given(
    kind=st.sampled_from([1, 3, 5, 7, 8]), order=st.sampled_from("<>"), offset=st.integers(0, 9),
    padding=st.integers(0, 5), rows=st.integers(1, 4), columns=st.integers(1, 5),
)  # fmt: skip
def test_points_of_every_layout_come_back(kind, order, offset, padding, rows, columns) -> None:  # type: ignore[no-untyped-def]
    points = np.arange(1, 3 * rows * columns + 1, dtype=float).reshape(rows, columns, 3)
    read = cloud_points(cloud(points, kind, order, offset, padding=padding))
    np.testing.assert_array_equal(read, points if min(rows, columns) > 1 else points.reshape(-1, 3))
    np.testing.assert_array_equal(cloud_points(cloud(points, kind), 0.5), read / 2)


@pytest.mark.parametrize("row_step", [0, 2 * 3 * 13, 7])
def test_the_row_step_of_points_without_padding_does_not_matter(row_step: int) -> None:
    points = np.arange(18.0).reshape(2, 3, 3)
    np.testing.assert_array_equal(cloud_points(cloud(points, row_step=row_step)), points)


@pytest.mark.parametrize("change", [{"row_step": 200, "padding": 1}, {"step": 8}, {"names": "xyq"}])
def test_a_cloud_that_contradicts_itself_is_refused(change: dict) -> None:
    points = np.ones((2, 3, 3))
    message = cloud(points, **{name: value for name, value in change.items() if name != "step"})
    if "step" in change:
        message.point_step = change["step"]
    with pytest.raises(InputError):
        cloud_points(message)


def test_what_is_not_finite_is_no_return_and_an_empty_cloud_has_no_points() -> None:
    points = np.ones((2, 3, 3))
    points[0, 0, 1], points[1, 2, 0] = np.inf, np.nan
    read = cloud_points(cloud(points))
    assert np.isnan(read[0, 0]).all()
    assert np.isnan(read[1, 2]).all()
    assert np.isfinite(read).sum() == 12
    assert cloud_points(cloud(np.ones((1, 0, 3)))).shape == (0, 3)


def camera(width=4, height=3, K=(2.0, 0, 1.5, 0, 4, 1, 0, 0, 1), roi=(0, 0, 0, 0), binning=0):  # type: ignore[no-untyped-def]
    part = MAKE.make("sensor_msgs/msg/RegionOfInterest", *roi, False)
    arrays = np.zeros(5), np.array(K), np.eye(3).ravel(), np.zeros(12)
    header = MAKE.header(0, "c")
    return MAKE.make("sensor_msgs/msg/CameraInfo", header, height, width, "", *arrays, binning, binning, part)


def image(pixels, encoding, order="<", step=0):  # type: ignore[no-untyped-def]
    raw = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder(order))
    data = np.pad(raw.view(np.uint8).reshape(len(raw), -1), ((0, 0), (0, step)))
    size = (*raw.shape, encoding, int(order == ">"), data.shape[1], data.reshape(-1))
    return MAKE.make("sensor_msgs/msg/Image", MAKE.header(0, "c"), *size)


@pytest.mark.parametrize(
    ("encoding", "kind", "unit_m"), [("16UC1", "u2", 1e-3), ("mono16", "u2", 1e-3), ("32FC1", "f4", 1)]
)
@pytest.mark.parametrize("order", ["<", ">"])
def test_depth_projects_onto_its_pixels(encoding: str, kind: str, unit_m: float, order: str) -> None:
    depth = np.arange(1, 13).reshape(3, 4).astype(kind)
    points = depth_points(image(depth, encoding, order, step=3), camera())
    np.testing.assert_allclose(points[..., 2], depth * unit_m)
    u, v = points[..., 0] / points[..., 2] * 2 + 1.5, points[..., 1] / points[..., 2] * 4 + 1
    np.testing.assert_allclose(u, np.tile(np.arange(4), (3, 1)), atol=1e-12)
    np.testing.assert_allclose(v, np.tile(np.arange(3)[:, None], (1, 4)), atol=1e-12)
    np.testing.assert_allclose(depth_points(image(depth, encoding, order), camera(), 0.5)[..., 2], depth * 0.5)


def test_no_depth_is_zero_the_largest_integer_and_what_is_not_finite() -> None:
    whole = depth_points(image(np.array([[0, 65535, 7, 9]] * 3, np.uint16), "16UC1"), camera())
    real = depth_points(image(np.array([[np.nan, np.inf, -1, 2]] * 3, np.float32), "32FC1"), camera())
    np.testing.assert_array_equal(np.isnan(whole[0]).any(axis=1), [True, True, False, False])
    np.testing.assert_array_equal(np.isnan(real[0]).any(axis=1), [True, True, True, False])


def test_region_and_binning_change_the_camera_as_their_definition_says() -> None:
    K = camera_matrix(camera(8, 6, roi=(2, 1, 4, 6), binning=2), 2, 3)
    np.testing.assert_allclose(K, [[1, 0, -0.25], [0, 2, 0], [0, 0, 1]])
    np.testing.assert_allclose(camera_matrix(camera(), 3, 4), np.array(camera().k).reshape(3, 3))


@pytest.mark.parametrize("change", [{"width": 8}, {"K": (0.0,) * 9}, {"K": (np.nan,) * 9}])
def test_a_camera_of_another_image_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match="CameraInfo"):
        depth_points(image(np.ones((3, 4), np.uint16), "16UC1"), camera(**change))


@pytest.mark.parametrize("change", [{"encoding": "rgb8"}, {"step": 3}, {"height": 90}])
def test_an_image_that_contradicts_itself_is_refused(change: dict) -> None:
    message = image(np.ones((3, 4), np.uint16), "16UC1")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match="Image"):
        depth_points(message, camera())


def test_both_dialects_of_ros_have_the_messages_of_tf() -> None:
    assert all("tf2_msgs/msg/TFMessage" in typestore(ros).types for ros in (1, 2))
