"""ORB features of an image, and their depths from the Time-of-Flight scan taken at the same time."""

import functools
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steelnb.core.types import Array, GreyImage, IntArray, project
from steelnb.points.ranges import range_sigma_m

SCALE, LEVELS = 1.2, 3
"""Scale factor and number of levels of the image pyramid."""
FAST_THRESHOLD = 12
WINDOW = 1.8
"""Radius, in pixels of the sensor, of a feature's neighbourhood, in which the surface must be smooth."""
SAMPLE_STEP = 7
"""One in seven returns is used to estimate the pixel spacing of neighbours."""
POINTS_MIN = 6
SMOOTH, FLAT = 3.0, 0.25
"""Maximum deviation of a depth from a smooth surface, in standard deviations; and maximum relative change of the depth
from the centre of the neighbourhood to its border: steeper surfaces count as edges."""


class Features(NamedTuple):
    """N features: ``pixel (N, 2)``; ``octave (N,)``, the pyramid level; ``descriptor (N, 4)``, 256 bits; and ``depth
    (N,)`` along the optical axis, metres, NaN without a smooth surface."""

    pixel: Array
    octave: IntArray
    descriptor: NDArray[np.uint64]
    depth: Array

    def take(self, index: IntArray) -> "Features":
        """The features selected by an index."""
        return Features(self.pixel[index], self.octave[index], self.descriptor[index], self.depth[index])


@functools.cache
def import_opencv() -> ModuleType:
    """OpenCV, on one thread and without processor-specific code."""
    import cv2

    cv2.setNumThreads(1)
    cv2.setUseOptimized(False)
    return cv2


def find_features(image: GreyImage, count: int, mask: GreyImage | None = None) -> Features:
    """At most ``count`` ORB features, without depths, of an image ``(H, W)`` where the ``mask`` is not zero (Rublee,
    Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011)."""
    keypoints, descriptors = _detector(count).detectAndCompute(image, mask)
    if descriptors is None:
        descriptors = np.zeros((0, 32), np.uint8)
    octave = np.array([keypoint.octave for keypoint in keypoints], dtype=np.int64)
    # OpenCV returns pixels of a level times the nominal scale. The true scale follows from the rounded sizes, and
    # resizing aligns the images' corners, not the centres of their first pixels.
    size, nominal = np.array(image.shape[::-1], dtype=np.float64), SCALE ** octave[:, None].astype(np.float64)
    level_pixel = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2) / nominal
    return Features(
        (level_pixel + 0.5) * size / np.rint(size / nominal) - 0.5,
        octave,
        np.ascontiguousarray(descriptors).view(np.uint64),
        np.full(len(keypoints), np.nan),
    )


@functools.cache
def _detector(count: int):  # type: ignore[no-untyped-def]
    return import_opencv().ORB_create(
        nfeatures=count, scaleFactor=SCALE, nlevels=LEVELS, edgeThreshold=16, fastThreshold=FAST_THRESHOLD
    )


def features_with_depth(image: GreyImage, points: Array, T_camera_sensor: Array, K: Array, count: int) -> Features:
    """At most ``count`` features of an image ``(H, W)``, with depths, where the scan of the same time has returns.

    For ``points`` and ``T_camera_sensor`` see `DepthImage`.
    """
    depth = DepthImage(points, T_camera_sensor, K, image.shape)
    features = find_features(image, count, depth.mask())
    return features._replace(depth=depth.depth_at(features.pixel))


class DepthImage:
    """Points of a scan, projected into a camera's image: ``pixel (N, 2)``, ``depth (N,)`` along the optical axis.

    Parameters
    ----------
    points: ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return.
    T_camera_sensor: ``(4, 4)``.
    K, shape: intrinsics ``(3, 3)`` of the camera, and rows and columns of its image.
    """

    def __init__(self, points: Array, T_camera_sensor: Array, K: Array, shape: tuple[int, int]) -> None:
        points = points.reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])]
        in_camera = (points[:, None] * T_camera_sensor[:3, :3]).sum(axis=2) + T_camera_sensor[:3, 3]
        pixel, self._shape = project(in_camera, K), shape
        inside = ((pixel >= 0) & (pixel <= np.array(shape[::-1]) - 1.0)).all(axis=1)
        self.pixel, self.depth = pixel[inside], in_camera[inside, 0]
        self.spacing_px = 1.0
        if len(self.pixel) > 1:  # scans are in row order, so consecutive points are neighbours
            spacing = np.abs(self.pixel[1::SAMPLE_STEP] - self.pixel[:-1:SAMPLE_STEP]).sum(axis=1)
            self.spacing_px = max(float(np.median(spacing)), 0.5)
        self.radius_px = WINDOW * self.spacing_px

    def mask(self) -> GreyImage:
        """Mask ``(H, W)``: 255 near a return, else 0."""
        result, pixel = np.zeros(self._shape, np.uint8), np.rint(self.pixel).astype(np.int64)
        result[pixel[:, 1], pixel[:, 0]] = 255
        size = 2 * int(np.ceil(0.7 * self.spacing_px)) + 1
        return np.asarray(import_opencv().dilate(result, np.ones((size, size), np.uint8)))

    def depth_at(self, pixel: Array) -> Array:
        """Depths ``(N,)``, metres, of the smooth surface around each of the pixels ``(N, 2)``; NaN without one.

        A surface is smooth if a plane fits it; the inverse depth of a plane is linear in the pixel. Returns must lie in
        all four quadrants around the pixel, which excludes the edges of surfaces.
        """
        at, near = _pairs(pixel, self.pixel, self.radius_px)
        # Floating-point sums depend on their order: sort by grid cell, row by row.
        column, row = (self.pixel / self.radius_px).astype(np.int64).T
        order = np.lexsort((near, column[near], row[near], at))
        at, near = at[order], near[order]
        (du, dv), depth = (self.pixel[near] - pixel[at]).T, self.depth[near]

        def total(values: Array) -> Array:
            return np.asarray(np.bincount(at, values, len(pixel)), dtype=np.float64)

        w = 1.0 / depth
        s, su, sv, suu, suv, svv = map(total, (np.ones(len(at)), du, dv, du * du, du * dv, dv * dv))
        sw, suw, svw = map(total, (w, du * w, dv * w))
        # Cramer's rule for the plane w = value + by_u·du + by_v·dv.
        m0, m1, m2 = suu * svv - suv * suv, su * svv - suv * sv, su * suv - suu * sv
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = s * m0 - su * m1 + sv * m2
            value = (sw * m0 - su * (suw * svv - suv * svw) + sv * (suw * suv - suu * svw)) / determinant
            by_u = (s * (suw * svv - svw * suv) - sw * m1 + sv * (su * svw - suw * sv)) / determinant
            by_v = (s * (suu * svw - suv * suw) - su * (su * svw - suw * sv) + sw * m2) / determinant
            expected = value[at] + by_u[at] * du + by_v[at] * dv
            sigma = range_sigma_m(1.0 / value)[at]
            rough = ~(expected > 0) | (np.abs(depth - 1.0 / expected) > SMOOTH * sigma)
            is_flat = np.hypot(by_u, by_v) * self.radius_px < FLAT * value
            quadrants = np.bincount(4 * at + (du > 0) + 2 * (dv > 0), minlength=4 * len(pixel)).reshape(-1, 4)
            known = (s >= POINTS_MIN) & quadrants.all(axis=1) & (np.abs(determinant) >= 1e-9) & (value > 0)
            return np.where(known & is_flat & (total(rough) == 0), 1.0 / value, np.nan)


def _pairs(one: Array, other: Array, radius: float) -> tuple[IntArray, IntArray]:
    """Indices of all pairs of places ``(M, 2)`` and ``(N, 2)`` at most a radius apart."""
    found = cKDTree(one).sparse_distance_matrix(cKDTree(other), radius, output_type="ndarray")
    return found["i"], found["j"]


def match(
    pixel: Array, octave: IntArray, descriptor: NDArray[np.uint64], depth: Array, expected: Array,
    expected_octave: IntArray, expected_depth: Array, reference: NDArray[np.uint64], search_px: float,
    hamming_max: int, ratio: float,
) -> IntArray:  # fmt: skip
    """Index ``(M,)`` of the feature that matches each expected landmark, −1 for none.

    Candidates are near the pixel ``expected (M, 2)``, of a similar octave and, if both are known, of a similar depth.
    The match has the smallest Hamming distance from the ``reference (M, 4)`` descriptor, and passes the ratio test
    against the second best. Each feature matches at most one landmark.
    """
    m, n = _pairs(expected, pixel, search_px)
    apart = np.abs(depth[n] - expected_depth[m]) > 5 * range_sigma_m(depth[n])  # False if unknown
    similar = (np.abs(octave[n] - expected_octave[m]) <= 1) & ~apart
    m, n = m[similar], n[similar]
    bits = np.bitwise_count(descriptor[n] ^ reference[m]).sum(axis=1, dtype=np.int64)
    order = np.lexsort((n, bits, m))
    m, n, bits = m[order], n[order], bits[order]
    second = np.where(np.diff(m, append=-1) == 0, np.append(bits, np.inf)[1:], np.inf)
    good = (np.diff(m, prepend=-1) != 0) & (bits <= hamming_max) & (bits <= ratio * second)
    m, n, bits = m[good], n[good], bits[good]
    order = np.lexsort((m, bits, n))
    chosen = order[np.diff(n[order], prepend=-1) != 0]
    found = np.full(len(expected), -1)
    found[m[chosen]] = n[chosen]
    return found
