"""Points of PointCloud2 and depth images whose sizes, byte order, types or camera contradict the data."""

import copy
import warnings
from functools import partial

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io import read_flight
from steelnb.io.bag_writer import Messages
from steelnb.io.layouts import DEPTHS, cloud_layout, depth_layout
from steelnb.io.messages import IMAGE, CameraInfo, camera_matrix, cloud_points, depth_points
from steelnb.io.recordings import FAR_M, Scans
from tests.io.samples import POINTS, TRIALS, Bagged

MAKE = Messages(2)
K = np.array([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]])
CAMERA = CameraInfo(K, 80, 60, (1, 1), (0, 0, 0, 0))


def cloud(points=POINTS, kind="<f4", pad=0, fill=0, **changed):
    """A PointCloud2 of any type of numbers, with ``pad`` bytes after each row, and ``fill`` after each point."""
    message = MAKE.cloud(0, points)
    each = np.ascontiguousarray(points.reshape(-1, 3), dtype=kind).view(np.uint8)
    rows = np.pad(each, ((0, 0), (0, fill)), constant_values=66).reshape(message.height, -1)
    data = np.pad(rows, ((0, 0), (0, pad)))
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    size = np.dtype(kind).itemsize
    for k, field in enumerate(message.fields):
        field.offset, field.datatype = k * size, codes[kind[1:]]
    message.point_step, message.row_step, message.data = 3 * size, data.shape[1], data.reshape(-1)
    for name, value in changed.items():
        setattr(message, name, value)
    return message


def depth(kind="<u2", encoding="16UC1", /, **changed):
    """A depth image of a wall around 2.5 m, and its depth in metres."""
    depth_m = 2.5 + 0.05 * np.random.default_rng(0).random((60, 80))
    pixels = (depth_m * (1 if "f" in kind else 1000)).astype(kind)
    message = Bagged.image(type("", (), {"make": MAKE}), pixels, encoding)
    for name, value in changed.items():
        setattr(message, name, value)
    return message, pixels.astype(float) / (1 if "f" in kind else 1000)


@pytest.mark.parametrize(
    ("changed", "note"),
    [
        *(({"row_step": step}, f"row_step {step} is read as 60") for step in (0, 5, 240, 2**32 - 1)),
        *(({"point_step": step}, f"point_step {step} is read as 12") for step in (0, 4)),
        ({"is_bigendian": True}, "is_bigendian is True, but only as little-endian"),
        ({"kind": ">f4"}, "is_bigendian is False, but only as big-endian"),
        ({"kind": ">f4", "is_bigendian": True}, ""),
        ({"kind": "<f8"}, ""),
        ({"pad": 4}, ""),
        ({"fill": 4}, "point_step 12 is read as 16, as row_step and the data say"),
    ],
)
def test_a_cloud_with_one_sensible_reading_is_read_so_and_it_is_noted(changed, note):
    message = cloud(**changed)
    np.testing.assert_array_equal(cloud_points(message), POINTS)
    notes = cloud_layout(message).notes
    assert notes[0].startswith(note) if note else not notes


@pytest.mark.parametrize(
    "changed",
    [
        {"width": 6}, {"height": 8}, {"point_step": 16}, {"width": 2**32 - 1, "height": 2**32 - 1},
        {"height": 0, "width": 0}, {"row_step": 0, "pad": 4}, {"row_step": 60, "pad": 4}, {"row_step": 60, "pad": 60},
        {"row_step": 60, "pad": 20}, {"height": 1, "width": 20, "row_step": 240, "pad": 20},
    ],
)  # fmt: skip
def test_a_cloud_with_no_sensible_reading_is_a_fault(changed):
    with pytest.raises(InputError):
        cloud_points(cloud(**changed))


@pytest.mark.parametrize(
    ("image", "camera", "words"),
    [
        (depth(step=120, width=60)[0], CAMERA, "step 120 and 9600 bytes of data; expected 60 rows"),
        (depth("<f4", "16UC1", step=160, width=80)[0], CAMERA, "expected 2, as stated"),
        (depth("<f4", "32FC1", encoding="16UC1")[0], CAMERA, "step 320 is 4 bytes a pixel, and 16UC1 has 2"),
        (depth()[0], CAMERA._replace(K=8 * K), r"principal point \(320, 240\); expected one in its 80 × 60 pixels"),
        (depth()[0], CAMERA._replace(K=0 * K), r"CameraInfo with K \[0.0, .*; expected that of a calibrated camera"),
    ],
)
def test_an_image_that_contradicts_itself_or_its_camera_is_a_fault(image, camera, words):
    with pytest.raises(InputError, match=words):
        depth_points(image, camera)


def test_points_that_a_width_leaves_out_are_noted():
    message = cloud(POINTS.reshape(1, 20, 3))
    message.width = 10
    assert cloud_points(message).shape == (10, 3)
    assert cloud_layout(message).notes == ("data are 120 bytes longer than their points: the rest is left out",)


@pytest.mark.parametrize(
    ("changed", "read"), [({"fill": 4}, "point_step 12 is read as 16"), ({"width": 30}, "width 30 is read as 20")]
)
def test_of_three_sizes_of_a_row_of_points_the_two_that_agree_are_right(changed, read):
    message = cloud(POINTS.reshape(1, 20, 3), **changed)
    np.testing.assert_array_equal(cloud_points(message), POINTS.reshape(-1, 3))
    assert cloud_layout(message).notes == (f"{read}, as row_step and the data say",)


def test_fields_may_have_upper_case_names():
    message = cloud()
    for field in message.fields:
        field.name = field.name.upper()
    np.testing.assert_array_equal(cloud_points(message), POINTS)


def test_fields_are_checked():
    for field, change, value, words in (
        (0, "datatype", 9, "fields x, y, z with datatype 9; expected x, y and z of a numeric type"),
        (0, "offset", 5, "fields x, y, z at bytes 5, 4, 8 overlap"),
        (2, "offset", 9, "point_step 12: expected 13 bytes or more"),
    ):
        message = cloud()
        setattr(message.fields[field], change, value)
        with pytest.raises(InputError, match=words):
            cloud_points(message)


@pytest.mark.parametrize("kind", ["<i2", "<u2", "<i4", ">i4", "<u4"])
def test_integers_are_millimetres_and_their_largest_value_is_no_return(kind):
    points = np.rint(1000 * POINTS / 10)
    points[1, 2] = np.iinfo(kind).max
    message = cloud(points, kind, is_bigendian=kind[0] == ">")
    expected = points / 1000
    expected[1, 2] = np.nan
    np.testing.assert_allclose(cloud_points(message), expected)
    assert "taken as millimetres" in cloud_layout(message).notes[0]


def test_points_at_the_sensor_or_farther_than_any_sees_are_no_returns_or_a_fault():
    few, most = POINTS.copy(), POINTS * 1e6
    few[0, 0, 1], few[1, 2] = np.finfo(np.float32).max, 0.0
    largest = POINTS.copy()
    largest[1:] = np.finfo(np.float32).max
    first, second, third = Scans(
        lambda _: iter([lambda: few, lambda: most, lambda: largest]), np.arange(3), np.arange(3.0)
    )
    assert np.isfinite(third.points).sum() == POINTS[0].size
    assert np.isnan(first.points[[0, 1], [0, 2]]).all()
    assert np.isfinite(first.points).sum() == POINTS.size - 6
    assert second.fault == "unreadable scan: 20 points beyond 1e+06 m"


@pytest.mark.parametrize("encoding", DEPTHS)
def test_depth_has_encodings_sizes_and_byte_orders(encoding):
    kind = DEPTHS[encoding]
    for order, flag in (("<", 0), (">", 1), ("<", 1), (">", 0)):
        message, depth_m = depth(order + kind, encoding, is_bigendian=flag)
        points = depth_points(message, CAMERA)
        np.testing.assert_allclose(points[..., 2], depth_m)
        assert any("is_bigendian" in note for note in depth_layout(message).notes) == ((order == ">") != flag)
    message, depth_m = depth("<" + kind, encoding, step=0)
    np.testing.assert_allclose(depth_points(message, CAMERA)[..., 2], depth_m)
    for changed in ({"height": 61}, {"width": 0}, {"encoding": "rgb8"}, {"data": message.data[:-1]}):
        with pytest.raises(InputError):
            depth_points(depth("<" + kind, encoding, **changed)[0], CAMERA)


@pytest.mark.parametrize(("kind", "encoding"), [("<u2", "16UC1"), ("<f4", "32FC1")])
def test_no_depth_has_many_spellings(kind, encoding):
    message, _ = depth(kind, encoding)
    pixels = message.data.view(kind).reshape(60, 80)
    no_return = [0, 65535] if kind == "<u2" else [0, np.nan, np.inf, -np.inf, -1, np.finfo(np.float32).max]
    pixels[0, : len(no_return)] = no_return
    points = depth_points(message, CAMERA)
    assert np.isnan(points).all(axis=-1).sum() == len(no_return)
    assert np.nanmax(points) < 3


@pytest.mark.parametrize(
    ("sky_m", "share", "left"), [(65.535, 0.1, 0.9), (1000.0, 0.1, 0.9), (65.535, 0.001, 1.0), (12, 0.1, 1.0)]
)
def test_a_depth_far_behind_all_others_that_many_pixels_have_is_none(sky_m, share, left):
    message, _ = depth("<f4", "32FC1")
    pixels = message.data.view("<f4")
    pixels[: int(share * len(pixels))] = sky_m
    points = depth_points(message, CAMERA)
    assert np.isfinite(points).all(axis=-1).mean() == pytest.approx(left, abs=1e-3)


def test_a_place_that_many_points_share_is_no_return():
    points = np.random.default_rng(0).uniform(1, 3, (40, 50, 3))
    points[:10] = 65.535, -1.0, 2.0
    (scan,) = Scans(lambda _: iter([lambda: points]), np.arange(1), np.arange(1.0))
    assert np.isnan(scan.points[:10]).all()
    assert np.isfinite(scan.points[10:]).all()


@pytest.mark.parametrize(
    ("change", "says"), [((2, 2, 0), "that of another size"), ((1, 1, 0), ""), ((0.012, 1, 0), None)]
)
def test_a_camera_of_another_size_or_unit_is_noted_or_refused(change, says):
    camera = CameraInfo(np.array(K) * [[change[0]], [change[1]], [1]], 80, 60, (1, 1), (0, 0, 0, 0))
    if says is None:
        with pytest.raises(InputError, match="expected that of a calibrated camera"):
            camera_matrix(camera, 60, 80)
    else:
        assert says in camera_matrix(camera, 60, 80)[1]


@pytest.mark.parametrize(
    ("width", "height", "binning", "roi", "given"),
    [
        (80, 60, (1, 1), (0, 0, 0, 0), K),
        (0, 0, (1, 1), (0, 0, 0, 0), K),
        (640, 480, (1, 1), (0, 0, 0, 0), K * [[8], [8], [1]]),
        (40, 30, (1, 1), (0, 0, 0, 0), K / [[2], [2], [1]]),
        (160, 120, (2, 2), (0, 0, 0, 0), K * [[2], [2], [1]]),
        (160, 120, (1, 1), (10, 20, 80, 60), K + np.array([[0, 0, 10], [0, 0, 20], [0, 0, 0]])),
        (400, 400, (2, 2), (10, 20, 160, 120), K * [[2], [2], [1]] + np.array([[0, 0, 10], [0, 0, 20], [0, 0, 0]])),
        (640, 480, (1, 1), (0, 0, 0, 0), K),
        (320, 240, (4, 4), (0, 0, 0, 0), K),
        (320, 240, (1, 1), (120, 90, 80, 60), K),
        (640, 400, (1, 1), (0, 0, 0, 0), None),
        (120, 90, (1, 1), (0, 0, 0, 0), None),
    ],
)
def test_the_camera_is_that_of_the_image_or_refused(width, height, binning, roi, given):
    if given is None:
        with pytest.raises(InputError, match="expected the same size or a whole ratio"):
            camera_matrix(CameraInfo(K, width, height, binning, roi), 60, 80)
    else:
        found, said = camera_matrix(CameraInfo(np.array(given), width, height, binning, roi), 60, 80)
        np.testing.assert_allclose(found, K)
        assert ("already" in said) == (given is K and width > 80)


def test_contradictions_are_told_once_and_a_flight_without_a_readable_scan_is_refused(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds().odometry()
    clouds = [message for _, _, _, message in bag.rows if hasattr(message, "row_step")]
    for message in clouds:
        message.row_step = 0
    assert read_flight(bag.write()).facts["notes"] == "row_step 0 is read as 60, which fits the data"
    for message in clouds:
        message.width = 6
    bag.path = tmp_path / "b.mcap"
    with pytest.raises(InputError, match=r"b.mcap: none of 5 scans can be read; the first: .*240 bytes of data"):
        read_flight(bag.write())


def test_depth_images_are_told_from_grey_and_compressed_ones(tmp_path):
    depth_mm = np.full((2, 3), 2000, "<u2")
    one = Bagged(tmp_path / "a.mcap").images("/depth/image", depth_mm, "mono16").images("/thermal", depth_mm, "mono16")
    flight = read_flight(one.camera().odometry().write())
    assert flight.facts["scans"] == "/depth/image (Image)"
    assert flight.facts["notes"] == "encoding mono16 is read as 16UC1, millimetres"
    others = Bagged(tmp_path / "c.mcap").images("/depth/image", depth_mm, "TYPE_16UC1").camera().odometry()
    empty = next(message for _, kind, _, message in others.rows if kind == IMAGE)
    empty.encoding, empty.height, empty.width, empty.step, empty.data = "", 0, 0, 0, np.zeros(0, np.uint8)
    assert np.isfinite(read_flight(others.write()).scans[1].points).all()
    packed = Bagged(tmp_path / "b.mcap").odometry()
    message = MAKE.make(
        "sensor_msgs/msg/CompressedImage", MAKE.header(0, "c"), "16UC1; compressedDepth png", np.zeros(4, np.uint8)
    )
    packed.rows.append(("/depth/compressedDepth", "sensor_msgs/msg/CompressedImage", 0.0, message))
    with pytest.raises(InputError, match=r"/depth/compressedDepth is a compressed depth image; expected a raw one"):
        read_flight(packed.write())


def test_a_map_and_images_of_other_things_are_no_scans(tmp_path):
    depth_mm = np.full((2, 3), 2000, "<u2")
    bag = Bagged(tmp_path / "a.mcap").images("/depth/image", depth_mm, "16UC1").camera().odometry()
    bag.images("/ir/image", depth_mm, "16UC1").images("/depth/confidence_map", depth_mm.astype("<f4"), "32FC1")
    flight = read_flight(bag.clouds("/octomap_point_cloud_centers", stamps=[0.0, 0.8], frame="map").write())
    assert flight.facts["scans"] == "/depth/image (Image)"
    assert len(flight) == 5
    beside = Bagged(tmp_path / "b.mcap").images("/depth/image", depth_mm, "16UC1", stamps=0.02 * np.arange(40)).camera()
    lidar = read_flight(beside.clouds("/lidar").odometry().write())
    assert lidar.facts["scans"] == "/lidar (PointCloud2)"
    assert len(lidar) == 5


def test_mutated_headers_end_in_points_or_in_a_fault():
    rng = np.random.default_rng(0)
    odd = [0, 1, 2, 3, 5, 7, 12, 13, 16, 60, 61, 240, 241, 65535, 2**31, 2**32 - 1]

    def mutated(message):
        message = copy.deepcopy(message)
        for _ in range(rng.integers(1, 4)):
            names = [name for name in vars(message) if isinstance(getattr(message, name), int)] + ["data", "fields"]
            name, value = str(rng.choice(names)), int(rng.choice(odd))
            if name == "data":
                size = len(message.data)
                noise = rng.integers(0, 256, size).astype(np.uint8)
                message.data = noise if rng.random() < 0.3 else message.data[: rng.integers(0, size + 1)]
            elif name != "fields":
                setattr(message, name, value)
            elif hasattr(message, "fields"):
                setattr(message.fields[rng.integers(3)], str(rng.choice(["offset", "datatype"])), value)
        return message

    clouds, images = [cloud(), cloud(POINTS[0]), cloud(kind="<f8")], [depth()[0], depth("<f4", "32FC1")[0]]
    decoders = [partial(cloud_points, mutated(clouds[k % 3])) for k in range(3 * TRIALS)]
    decoders += [partial(depth_points, mutated(images[k % 2]), CAMERA) for k in range(3 * TRIALS)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scans = list(Scans(lambda _: iter(decoders), np.arange(6 * TRIALS), np.arange(6.0 * TRIALS)))
    read = [scan.points for scan in scans if not scan.fault]
    assert 0.1 < len(read) / len(scans) < 0.9
    assert max(np.nanmax(np.abs(points)) for points in read) <= FAR_M
    assert max(points.size for points in read) <= 3 * 4800
