"""ORB features of an image, and their depths from the Time-of-Flight scan of the same moment."""

import functools
import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steelnb.images import GreyImage
from steelnb.points.ranges import SIGMA_M, SIGMA_SHARE
from steelnb.types import Array, IntArray

SCALE, LEVELS = 1.2, 3
"""Scale factor and number of levels of the image pyramid."""
FAST_THRESHOLD = 12
WINDOW = 1.8
"""Radius, in pixels of the sensor, of a feature's neighbourhood, in which the surface must be smooth."""
SAMPLE_STEP = 7
"""Every seventh return is used to estimate the pixel spacing of neighbours."""
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
    """Points of a scan, projected into a camera's image.

    Parameters
    ----------
    points: ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return.
    T_camera_sensor: ``(4, 4)``.
    K, shape: intrinsics ``(3, 3)`` of the camera, and rows and columns of its image.
    """

    def __init__(self, points: Array, T_camera_sensor: Array, K: Array, shape: tuple[int, int]) -> None:
        self._shape = shape
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        self._pixel, self._depth = np.empty((len(flat), 2)), np.empty(len(flat))
        count = _project(flat, T_camera_sensor, K, *shape, self._pixel, self._depth)
        self._pixel, self._depth = self._pixel[:count], self._depth[:count]
        self.spacing_px = 1.0
        if count > 1:  # scans are in row order, so consecutive points are neighbours
            spacing = np.abs(self._pixel[1::SAMPLE_STEP] - self._pixel[:-1:SAMPLE_STEP]).sum(axis=1)
            self.spacing_px = max(float(np.median(spacing)), 0.5)
        self._radius_px = WINDOW * self.spacing_px
        rows, self._columns = (int(side / self._radius_px) + 1 for side in shape)
        self._first = np.zeros(rows * self._columns + 1, dtype=np.int64)
        self._order = np.empty(count, dtype=np.int64)
        _bin_pixels(self._pixel, self._radius_px, self._columns, self._first, self._order)

    def __len__(self) -> int:
        return len(self._depth)

    def mask(self) -> GreyImage:
        """Mask ``(H, W)``: 255 near a return, else 0."""
        result, pixel = np.zeros(self._shape, np.uint8), np.rint(self._pixel).astype(np.int64)
        result[pixel[:, 1], pixel[:, 0]] = 255
        size = 2 * int(np.ceil(0.7 * self.spacing_px)) + 1
        return np.asarray(import_opencv().dilate(result, np.ones((size, size), np.uint8)))

    def depth_at(self, pixel: Array) -> Array:
        """Depths ``(N,)``, metres, of the smooth surface around each of the pixels ``(N, 2)``; NaN without one.

        A surface is smooth if a plane fits, whose inverse depth is linear in the pixel. There must be returns in all
        four quadrants around the pixel, which excludes the edges of surfaces.
        """
        result = np.full(len(pixel), np.nan)
        _fit_planes(self._pixel, self._depth, self._order, self._first, self._columns, self._radius_px, pixel, result)
        return result


@njit(cache=True)
def _project(points, T, K, rows, columns, pixel, depth):
    """Fill in the pixels and depths of the points inside the image; returns their number."""
    count = 0
    for n in range(len(points)):
        x = T[0, 0] * points[n, 0] + T[0, 1] * points[n, 1] + T[0, 2] * points[n, 2] + T[0, 3]
        if not x > 0.0:  # also true for NaN
            continue
        y = T[1, 0] * points[n, 0] + T[1, 1] * points[n, 1] + T[1, 2] * points[n, 2] + T[1, 3]
        z = T[2, 0] * points[n, 0] + T[2, 1] * points[n, 1] + T[2, 2] * points[n, 2] + T[2, 3]
        u, v = K[0, 2] - K[0, 0] * y / x, K[1, 2] - K[1, 1] * z / x
        if 0.0 <= u <= columns - 1 and 0.0 <= v <= rows - 1:
            pixel[count, 0], pixel[count, 1], depth[count] = u, v, x
            count += 1
    return count


@njit(cache=True)
def _bin_pixels(pixel, side, columns, first, order):
    """Sort the pixels into the cells of a grid: those of cell c are ``order[first[c]:first[c + 1]]``."""
    cell = np.empty(len(pixel), dtype=np.int64)
    for n in range(len(pixel)):
        cell[n] = int(pixel[n, 1] / side) * columns + int(pixel[n, 0] / side)
        first[cell[n] + 1] += 1
    for c in range(len(first) - 1):
        first[c + 1] += first[c]
    next_free = first[:-1].copy()
    for n in range(len(pixel)):
        order[next_free[cell[n]]] = n
        next_free[cell[n]] += 1


@njit(cache=True)
def _fit_planes(samples, depth, order, first, columns, radius, pixel, result):
    """Fill in `DepthImage.depth_at`, by a plane through the ``samples (S, 2)`` around each ``pixel (N, 2)``."""
    rows = (len(first) - 1) // columns
    near = np.empty(256, dtype=np.int64)
    for n in range(len(pixel)):
        u, v = pixel[n]
        column, row, count = int(max(u, 0.0) / radius), int(max(v, 0.0) / radius), 0
        quadrant = 0
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for at in range(first[r * columns + c], first[r * columns + c + 1]):
                    k = order[at]
                    du, dv = samples[k, 0] - u, samples[k, 1] - v
                    if du * du + dv * dv <= radius * radius and count < len(near):
                        near[count] = k
                        count += 1
                        quadrant |= 1 << ((1 if du > 0 else 0) + (2 if dv > 0 else 0))
        if count < POINTS_MIN or quadrant != 15:
            continue
        s = su = sv = suu = suv = svv = sw = suw = svw = 0.0
        for at in range(count):
            du, dv, w = samples[near[at], 0] - u, samples[near[at], 1] - v, 1.0 / depth[near[at]]
            s, su, sv, suu, suv, svv = s + 1.0, su + du, sv + dv, suu + du * du, suv + du * dv, svv + dv * dv
            sw, suw, svw = sw + w, suw + du * w, svw + dv * w
        # Cramer's rule for the plane w = value + by_u·du + by_v·dv.
        m0, m1, m2 = suu * svv - suv * suv, su * svv - suv * sv, su * suv - suu * sv
        determinant = s * m0 - su * m1 + sv * m2
        if abs(determinant) < 1e-9:
            continue
        value = (sw * m0 - su * (suw * svv - suv * svw) + sv * (suw * suv - suu * svw)) / determinant
        by_u = (s * (suw * svv - svw * suv) - sw * m1 + sv * (su * svw - suw * sv)) / determinant
        by_v = (s * (suu * svw - suv * suw) - su * (su * svw - suw * sv) + sw * m2) / determinant
        if value <= 0:
            continue
        sigma = max(SIGMA_M, SIGMA_SHARE / value)
        smooth = True
        for at in range(count):
            k = near[at]
            expected = value + by_u * (samples[k, 0] - u) + by_v * (samples[k, 1] - v)
            if expected <= 0 or abs(depth[k] - 1.0 / expected) > SMOOTH * sigma:
                smooth = False
                break
        if smooth and math.hypot(by_u, by_v) * radius < FLAT * value:
            result[n] = 1.0 / value


@njit(cache=True)
def match(pixel, octave, descriptor, depth, expected, expected_octave, expected_depth, reference, search_px,
          hamming_max, ratio):  # fmt: skip
    """Index ``(M,)`` of the feature that matches each expected landmark, −1 for none.

    Candidates are near the pixel ``expected (M, 2)``, of a similar octave and, if both are known, of a similar depth.
    The match has the smallest Hamming distance from the ``reference (M, 4)`` descriptor, and passes the ratio test
    against the second best. Each feature matches at most one landmark.
    """
    found = np.full(len(expected), -1, dtype=np.int64)
    difference = np.full(len(expected), 257, dtype=np.int64)
    owner = np.full(len(pixel), -1, dtype=np.int64)
    for m in range(len(expected)):
        best, second, chosen = 257, 257, -1
        for n in range(len(pixel)):
            du, dv = pixel[n, 0] - expected[m, 0], pixel[n, 1] - expected[m, 1]
            if not du * du + dv * dv <= search_px * search_px or abs(octave[n] - expected_octave[m]) > 1:
                continue
            if abs(depth[n] - expected_depth[m]) > 5 * max(SIGMA_M, SIGMA_SHARE * depth[n]):
                continue  # false for an unknown depth
            bits = 0
            for word in range(4):
                bits += _popcount(descriptor[n, word] ^ reference[m, word])
            if bits < best:
                best, second, chosen = bits, best, n
            elif bits < second:
                second = bits
        if chosen < 0 or best > hamming_max or best > ratio * second:
            continue
        rival = owner[chosen]
        if rival >= 0:
            if difference[rival] <= best:
                continue
            found[rival] = -1
        owner[chosen], found[m], difference[m] = m, chosen, best
    return found


@njit(cache=True)
def _popcount(x):
    """Number of set bits of 64."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
