"""Matches of ORB features between two images of a flight, and which of them are right: the report's Figure 2.1."""

from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, CameraImages, Flight, GreyImage, project, unproject
from steelnb.odometry.orb.features import features_with_depth, match
from steelnb.simulation import Truth

FEATURES, HAMMING_MAX, RATIO = 400, 60, 0.8
"""Features of an image, and the limits of a match (`match`)."""


class ImageMatches(NamedTuple):
    """N matches: the two images ``(H, W)``, the number of features in each, the pixels of the matched ones ``(N, 2)``
    in the first and in the second image, and their distances ``apart_px (N,)`` from where the true motion takes the
    features of the first image; NaN where its scan has no depth."""

    images: tuple[GreyImage, GreyImage]
    features: tuple[int, int]
    first: Array
    second: Array
    apart_px: Array


def _image_at(camera: CameraImages, stamp_s: float) -> GreyImage:
    number = camera.at(stamp_s)
    image = None if number is None else camera.images[number]
    if image is None:
        raise InputError(f"no image at {stamp_s:.2f} s; expected one at each of the two scans")
    return image


def match_images(flight: Flight, truth: Truth, first: int, second: int) -> ImageMatches:
    """Match the features of the images at two scans by their descriptors alone (Lowe's ratio test, IJCV 2004); each
    feature is matched once. Raises `InputError` for scans without an image."""
    camera, stamp_s = flight.images, flight.prior.stamp_s[[first, second]]
    if camera is None:
        raise InputError("the flight has no images; expected one with a camera, such as that of a preset for orb")
    one, other = (_image_at(camera, at_s) for at_s in stamp_s)
    T_camera_sensor = np.linalg.inv(camera.T_drone_camera) @ flight.T_drone_sensor
    a, b = (
        features_with_depth(image, flight.scans[scan].points, T_camera_sensor, camera.K, FEATURES)
        for image, scan in ((one, first), (other, second))
    )
    anywhere, unknown = np.inf, np.full(len(a.pixel), np.nan)
    features = (b.pixel, b.octave, b.descriptor, b.depth)
    found = match(*features, a.pixel, a.octave, unknown, a.descriptor, anywhere, HAMMING_MAX, RATIO)
    T_world_camera = truth.trajectory.at(stamp_s).T_world_drone @ camera.T_drone_camera
    T_b_a = np.linalg.inv(T_world_camera[1]) @ T_world_camera[0]
    points = (a.depth[:, None] * unproject(a.pixel, camera.K)) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    matched = np.flatnonzero(found >= 0)
    pixel, expected = b.pixel[found[matched]], project(points[matched], camera.K)
    apart_px = np.linalg.norm(pixel - expected, axis=1)
    return ImageMatches((one, other), (len(a.pixel), len(b.pixel)), a.pixel[matched], pixel, apart_px)
