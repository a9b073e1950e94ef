"""Images of bags: written and read back, from any encoding that is known; of others it is told why there are none."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from steelnb.io.bag_topics import COMPRESSED, IMAGE
from steelnb.io.images import read_grey

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.images import CameraImages
from steelnb.io import read_flight, write_flight
from steelnb.odometry import make_odometry, run
from steelnb.report.recording import run_recording
from steelnb.report.recording_settings import recording_settings
from steelnb.settings import ExperimentSettings
from steelnb.types import Scan
from tests.io.samples import KINDS, Bagged, T_of, made_up, ns

COLOURS = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[10, 20, 30], [255, 255, 255], [0, 0, 0]]], np.uint8)
LUMA = np.rint(COLOURS @ [0.299, 0.587, 0.114])
"""ITU-R BT.601."""
GREY = np.array([[0, 90, 255], [7, 128, 33]], np.uint8)


def photographed(count: int = 9):
    """The flight of `made_up` with images at other times than its scans."""
    random, flight = np.random.default_rng(2), made_up()
    images = [random.integers(0, 256, (6, 8), dtype=np.uint8) for _ in range(count)]
    K = np.array([[411.123456789, 0, 3.6], [0, 411.9, 2.4], [0, 0, 1]])
    mount = T_of((0.06, 0.0, -0.02), (0.1, 0.7, -0.3))
    return replace(flight, images=CameraImages(np.round(0.13 * np.arange(count), 9), images, K, mount))


@pytest.mark.parametrize("name", [*KINDS, "folder"])
def test_images_read_back_the_same(tmp_path, name):
    flight = photographed()
    write_flight(tmp_path / name, flight)
    read = read_flight(tmp_path / name)
    np.testing.assert_array_equal(read.images.stamp_s, flight.images.stamp_s)
    np.testing.assert_array_equal(read.images.K, flight.images.K)
    np.testing.assert_allclose(read.images.T_drone_camera, flight.images.T_drone_camera, atol=1e-15)
    np.testing.assert_allclose(read.T_drone_sensor, flight.T_drone_sensor, atol=1e-15)
    for k in (0, 1, 4, 8, 2, 2, -1):  # forwards, and back
        np.testing.assert_array_equal(read.images.images[k], flight.images.images[k])
    np.testing.assert_array_equal(read.images.images[3:5], flight.images.images[3:5])
    with pytest.raises(IndexError):
        read.images.images[9]
    for scan, written in zip(read.scans, flight.scans, strict=True):
        np.testing.assert_array_equal(scan.points, written.points)
    assert read.facts["images"].startswith("9 at 7.692 Hz, 8 x 6 (/camera/image_raw, intrinsics /camera/camera_info")


def seen(bag: Bagged, **named):
    """A flight of scans and poses beside the images of a bag in the making."""
    return read_flight(bag.clouds().odometry().write(), **named)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    ("pixels", "encoding", "grey"),
    [(GREY, "mono8", GREY), (COLOURS, "rgb8", LUMA), (COLOURS[..., ::-1], "bgr8", LUMA)],
)
def test_images_and_colours_become_grey_levels(tmp_path, name, pixels, encoding, grey):
    bag = Bagged(tmp_path / name).images("/eye/image_raw", pixels, encoding).camera("/eye/camera_info")
    images = seen(bag).images
    assert len(images) == 5
    assert images.images[4].dtype == np.uint8
    np.testing.assert_array_equal(images.images[4], grey)
    np.testing.assert_array_equal(images.K, [[2, 0, 1], [0, 4, 0.5], [0, 0, 1]])
    np.testing.assert_array_equal(images.T_drone_camera, np.eye(4))  # no tf: as the drone


def compressed(bag: Bagged, topic: str, form: str, stamps=(0.0, 0.2)) -> Bagged:
    data = io.BytesIO()
    Image.fromarray(COLOURS).save(data, form)
    raw = np.frombuffer(data.getvalue(), np.uint8)
    for stamp in stamps:
        bag.rows.append(
            (topic, COMPRESSED, stamp, bag.make.make(COMPRESSED, bag.make.header(ns(stamp), "c"), form, raw))
        )
    return bag


def test_compressed_images_serve_where_there_are_no_others(tmp_path):
    bag = compressed(Bagged(tmp_path / "a.mcap"), "/eye/image_raw/compressed", "PNG").camera("/eye/camera_info")
    np.testing.assert_array_equal(seen(bag).images.images[1], LUMA)
    both = compressed(Bagged(tmp_path / "b.bag"), "/eye/image_raw/compressed", "PNG").camera("/eye/camera_info")
    flight = seen(both.images("/eye/image_raw", GREY, "mono8"))
    np.testing.assert_array_equal(flight.images.images[0], GREY)
    named = read_flight(tmp_path / "b.bag", images="/eye/image_raw/compressed")
    np.testing.assert_array_equal(named.images.images[0], LUMA)


def test_a_file_of_an_image_is_of_a_known_kind_and_size(tmp_path):
    Image.fromarray(COLOURS).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_grey(tmp_path / "a.png"), LUMA)
    Image.fromarray(np.zeros((2, 3), np.uint16)).save(tmp_path / "depth.png")
    (tmp_path / "text.png").write_text("no image")
    Image.fromarray(np.zeros((4000, 3000), np.uint8)).save(tmp_path / "large.png")
    for name, says in (("depth.png", "mode I;16"), ("text.png", "not a JPEG or PNG"), ("large.png", "3000 × 4000 pix")):
        with pytest.raises(InputError, match=says):
            read_grey(tmp_path / name)


REFUSED = [
    ({"encoding": "bayer_rggb8"}, {}, "/eye/image_raw: encoding 'bayer_rggb8'; expected one of mono8, rgb8, bgr8"),
    ({"encoding": "rgb8"}, {}, "/eye/image_raw: 6 bytes in rows of 3; expected 2 rows of at least 9"),
    ({"pixels": GREY[:, :2]}, {}, "/eye/image_raw: 2 × 2 pixels; expected 3 × 2"),
    ({}, None, "/eye/image_raw: no intrinsics: no topic of type CameraInfo beside it; expected a CameraInfo whose K"),
    ({}, {"fx": 0.0}, "/eye/image_raw: no intrinsics: no focal lengths in /eye/camera_info; expected"),
]


@pytest.mark.parametrize(("image", "camera", "says"), REFUSED)
def test_images_of_no_use_are_told_and_refused_where_they_are_needed(tmp_path, image, camera, says):
    path = tmp_path / "a.bag"
    bag = Bagged(path).images("/eye/image_raw", **({"pixels": GREY, "encoding": "mono8"} | image))
    flight = seen(bag if camera is None else bag.camera("/eye/camera_info", **camera))
    assert flight.images is None
    assert flight.facts["images"].startswith(f"none: {says}")
    assert len(list(flight.scans)) == 5
    with pytest.raises(InputError, match=says) as caught:
        read_flight(path, images="/eye/image_raw")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=f"a.bag: no images for method 'orb': none: {says}"):
        run_recording(flight, tmp_path / "out", recording_settings("orb")[0])
    assert not (tmp_path / "out").exists()


def test_one_of_several_cameras_is_named(tmp_path):
    bag = Bagged(tmp_path / "a.bag").images("/left/image", GREY, "mono8").images("/right/image", GREY[::-1], "mono8")
    flight = seen(bag.camera("/left/camera_info").camera("/right/camera_info"))
    assert flight.facts["images"] == "none: 2 topics fit: /left/image, /right/image; expected one to be named"
    right = read_flight(tmp_path / "a.bag", images="/right/image").images
    np.testing.assert_array_equal(right.images[0], GREY[::-1])
    with pytest.raises(InputError, match=r"/points is of type .*, not for the images; expected one of /left/image"):
        read_flight(tmp_path / "a.bag", images="/points")
    (tmp_path / "clouds").mkdir()
    np.save(tmp_path / "clouds" / "0.npy", np.ones((3, 3)))
    with pytest.raises(InputError, match="images '/right/image': expected a bag"):
        read_flight(tmp_path / "clouds", images="/right/image")


def test_the_camera_info_of_depth_images_is_not_that_of_others(tmp_path):
    depth = np.ones((2, 3), "<u2")
    bag = Bagged(tmp_path / "a.bag").images("/depth/image_raw", depth, "16UC1").camera().odometry()
    flight = read_flight(bag.images("/eye/image", GREY, "mono8").write())
    assert flight.facts["scans"] == "/depth/image_raw"
    assert flight.facts["images"].startswith("none: /eye/image: no intrinsics: no topic")


def test_an_image_that_cannot_be_read_is_none_and_stamps_rise(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").images("/image", GREY, "mono8").camera("/camera_info")
    bag.images("/image", GREY[:1], "mono8", stamps=[0.5]).images("/image", GREY, "mono8", stamps=[0.4])
    bag.rows.append(("/image", IMAGE, 0.9, b"\0\1\0\0\0"))
    flight = seen(bag)
    np.testing.assert_array_equal(flight.images.stamp_s, [0.0, 0.2, 0.4, 0.5, 0.6, 0.8])
    assert [image is None for image in flight.images.images] == [False, False, False, True, False, False]
    assert flight.skipped == {"image: duplicate stamp": 1, "image: stamp not finite": 1, "malformed Image": 1}


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_odometry_by_features_of_a_recording_is_that_of_the_experiment(tmp_path, name):
    """The same to the last digits where the experiment's scans are of single precision, as they are stored."""
    overrides = {"camera.samples": 1, "camera.rate_hz": 5.0}
    settings = ExperimentSettings.preset("loops", "random-walk:0.004", "orb", seed=12, duration_s=2.0)
    flight, truth = experiment.simulate(settings.override(overrides))
    single = [Scan(scan.stamp_s, scan.points.astype(np.float32).astype(float)) for scan in flight.scans]
    kept = replace(flight.images, images=list(flight.images.images))
    flight = replace(flight, scans=single, images=kept)
    estimate = run(flight, make_odometry(settings.odometry, flight.T_drone_sensor, images=flight.images))
    assert estimate.matches[1:].min() > 40
    write_flight(tmp_path / name, flight, truth.trajectory)
    report = run_recording(tmp_path / name, tmp_path / "out", settings, rrd=False)
    np.testing.assert_allclose(report.estimate.corrected.T_world_drone, estimate.corrected.T_world_drone, atol=1e-9)
    np.testing.assert_array_equal(report.estimate.matches, estimate.matches)
    assert np.abs(report.estimate.corrected.position - report.estimate.prior.position).max() > 0.02
