"""The types refuse what their docstrings exclude, and say in a line what they hold."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.types import (
    CameraImages,
    Flight,
    Imu,
    Lines,
    RangeScans,
    Scan,
    Segments,
    Trajectory,
    project,
    unproject,
)
from steelnb.fusion import SegmentMap
from steelnb.fusion.structure import Structure
from steelnb.odometry import SegmentOdometry
from steelnb.points import VoxelMap, voxel_grid
from steelnb.simulation import build_tower
from tests.refusals import refused_by_name

K = 5
STAMP_S, POSES, CLOUD = np.arange(K) + 1.7e9, np.tile(np.eye(4), (K, 1, 1)), np.ones((7, 3))
PATH = Trajectory(STAMP_S, POSES)
SEGMENTS = Segments(np.zeros((2, 3)), np.eye(3)[:2], np.ones(2), np.ones(2))
SCANS = [Scan(s, CLOUD) for s in STAMP_S]
FLIGHT = Flight(SCANS, PATH, np.eye(4))
CAMERA = np.array([[100.0, 0.0, 79.5], [0.0, 110.0, 59.5], [0.0, 0.0, 1.0]])


def changed(array, at, value):
    array = np.array(array, dtype=float)
    array[at] = value
    return array


def changed_segments(**change):
    ((name, value),) = change.items()
    return replace(SEGMENTS, **{name: changed(getattr(SEGMENTS, name), -1, value)})


def estimate(**change):
    parts = {"prior": PATH, "corrected": PATH, "points": CLOUD, "segments": Segments.empty(), "matches": np.ones(K),
             "reason": ("",) * K, "seconds": {"a": np.zeros(K)}, "update_s": np.zeros(K)}  # fmt: skip
    return Estimate(**{**parts, **change})


TRIPLES, NAN = np.ones((K, 3)), np.nan
MILLISECONDS_S = STAMP_S * 1000
"""No seconds: they would be in the year 55,000."""
REFUSED = {
    "Trajectory.stamp_s": [
        lambda: Trajectory(STAMP_S * 0, POSES), lambda: Trajectory(STAMP_S[:, None], POSES),
        lambda: Trajectory(changed(STAMP_S, 2, NAN), POSES), lambda: Trajectory(STAMP_S.astype(str), POSES),
        lambda: Trajectory(STAMP_S[::-1], POSES), lambda: Trajectory(MILLISECONDS_S, POSES),
    ],
    "Trajectory.T_world_drone": [
        lambda: Trajectory(STAMP_S, POSES[1:]), lambda: PATH.moved([1e300, 0, 0]),
        *(lambda at=at, value=value: Trajectory(STAMP_S, changed(POSES, (3, *at), value))
          for at, value in (((0, 3), np.inf), ((0, 1), 0.01), ((0, 0), -1), ((3, 0), 1), ((0, 3), -1e30))),
    ],
    "Imu.stamp_s": [lambda: Imu(STAMP_S * 1e9, TRIPLES, TRIPLES)],
    "Imu.angular_rate": [lambda: Imu(STAMP_S, TRIPLES, TRIPLES[:, :2])],
    "Imu.specific_force": [lambda: Imu(STAMP_S, changed(TRIPLES, 2, NAN), TRIPLES)],
    "Scan.stamp_s": [lambda: Scan(NAN, CLOUD), lambda: Scan("1.0", CLOUD), lambda: Scan(1.7e18, CLOUD)],
    "Scan.points": [
        lambda: Scan(0.0, np.ones((7, 2))), lambda: Scan(0.0, CLOUD.astype(object)),
        lambda: Scan(0.0, SimpleNamespace(points=CLOUD)), lambda: Scan(0.0, np.ones(7, [("x", "f4"), ("z", "f4")])),
    ],
    "CameraImages.K": [lambda: CameraImages(STAMP_S, [None] * K, np.eye(2), np.eye(4))],
    "CameraImages.T_drone_camera": [lambda: CameraImages(STAMP_S, [None] * K, np.eye(3), 2 * np.eye(4))],
    "Flight.T_drone_sensor": [lambda: Flight(SCANS, PATH, np.eye(3)), lambda: Flight(SCANS, PATH, -np.eye(4))],
    "Flight.scans": [
        lambda: Flight(SCANS[:4], PATH, np.eye(4)),
        lambda: Flight([Scan(s + 2e-6, CLOUD) for s in STAMP_S], PATH, np.eye(4)),
        lambda: Flight(RangeScans(STAMP_S + 100, np.ones((K, 1, 1)), np.ones((1, 1, 3))), PATH, np.eye(4)),
    ],
    "Flight.range_sigmas": [
        lambda sigmas=sigmas: replace(FLIGHT, range_sigmas=sigmas) for sigmas in ((0.001,), (0.001, NAN), (0.001, -1.0))
    ],
    "count": [lambda: FLIGHT.first(-1)],
    "OdometryStep.T_world_drone": [
        lambda: OdometryStep(0.0, np.eye(4)[:3]), lambda: OdometryStep(0.0, changed(np.eye(4), (1, 3), 1e9)),
    ],
    "OdometryStep.covariance": [
        lambda C=C: OdometryStep(0.0, np.eye(4), covariance=C) for C in (np.eye(3), -np.eye(6), np.tri(6))
    ],
    "OdometryStep.unobserved": [lambda: OdometryStep(0.0, np.eye(4), unobserved=4)],
    "OdometryStep.matches": [lambda: OdometryStep(0.0, np.eye(4), matches=-1)],
    "Estimate.points": [lambda: estimate(points=CLOUD[:, :2])],
    "Estimate.corrected": [lambda: estimate(corrected=Trajectory(STAMP_S + 1, POSES))],
    "Estimate.update_s": [lambda: estimate(update_s=np.zeros(4))],
    "Estimate.seconds": [lambda: estimate(seconds={"a": np.zeros(4)})],
    "Estimate.reason": [lambda: estimate(reason=("",))],
    "T_target_source": [lambda: SEGMENTS.transformed(np.eye(3))],
    "by": [lambda: SEGMENTS.moved([1, 2]), lambda: PATH.moved([1, 2])],
    "stamp_s": [lambda: PATH.between([NAN]), lambda: PATH.at([NAN])],
    "Segments.start": [lambda: changed_segments(start=NAN)],
    "Segments.end": [lambda: Segments(CLOUD, CLOUD[:6], np.ones(7), np.ones(7))],
    "Segments.count": [lambda value=value: changed_segments(count=value) for value in (-2.0, 0.5, NAN)],
    "Segments.radius": [
        lambda: changed_segments(radius=np.inf), lambda: changed_segments(radius=-1.0),
        lambda: Segments(CLOUD, CLOUD, np.ones(7), None),
    ],
    "Lines.direction": [lambda: Lines(CLOUD, CLOUD[:, :2], np.ones(7), [0])],
    "Lines.label": [lambda label=label: Lines(CLOUD, CLOUD, np.ones(7), [label]) for label in (-2, 7)],
    "Structure.width_m": [lambda: replace(Structure.of(SEGMENTS), width_m=np.ones(3))],
    "Structure.joint": [lambda: replace(Structure.of(SEGMENTS), joint=np.full((1, 3), NAN))],
    "Structure.tie": [lambda: replace(Structure.of(SEGMENTS), joint=np.ones((1, 3)), tie=[[0, 2]])],
}  # fmt: skip


test_shapes_ranges_and_values_that_are_not_finite_are_refused_by_the_name_of_the_field = refused_by_name(REFUSED)


def test_lists_single_precision_and_rounded_rotations_are_accepted_as_float64():
    turned = np.tile(np.eye(4), (2, 1, 1))
    turned[1, :2, :2] = [[0.7071, -0.7071], [0.7071, 0.7071]]
    path = Trajectory([0, 1], turned.astype(np.float32).tolist())
    assert path.stamp_s.dtype == path.T_world_drone.dtype == np.float64
    masked = Scan(np.float32(0.5), np.ma.masked_equal(CLOUD, 1.0))
    assert isinstance(masked.stamp_s, float)
    assert np.isnan(masked.points).all()
    assert Scan(0.0, CLOUD).points is CLOUD


@pytest.mark.parametrize("shape", [(12,), (3, 4)])
def test_points_by_name_are_read_by_their_names_and_masked_ones_are_nan(shape):
    read = np.zeros(shape, [("intensity", "f4"), ("z", "f4"), ("y", "f8"), ("x", "f4")])
    read["x"], read["y"], read["z"] = 1, 2, 3
    np.testing.assert_array_equal(Scan(0.0, read).points, np.tile([1.0, 2.0, 3.0], (*shape, 1)))
    frame = pd.DataFrame(read.ravel())
    np.testing.assert_array_equal(Scan(0.0, frame).points, np.tile([1.0, 2.0, 3.0], (12, 1)))
    masked = np.ma.array(read, mask=np.zeros(shape, [(name, bool) for name in read.dtype.names]))
    masked.mask["z"] = True
    assert np.isnan(Scan(0.0, masked).points).any(axis=-1).all()
    assert voxel_grid(read.ravel(), 0.1).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("shape", [(12, 3), (3, 4, 3)])
def test_points_at_exactly_zero_are_no_returns_and_other_clouds_are_shared(shape):
    points = np.arange(36.0).reshape(shape)  # the first coordinate is zero
    assert Scan(0.0, points).points is points
    with_zeros = points.copy()
    with_zeros[-1:] = 0.0
    scan = Scan(0.0, with_zeros)
    assert np.isfinite(scan.points).all(axis=-1).sum() == (with_zeros != 0).any(axis=-1).sum()
    np.testing.assert_array_equal(scan.points[:-1], points[:-1])
    assert not with_zeros[-1:].any(), "the caller's array is unchanged"


def test_poses_are_interpolated_at_stamps_of_any_kind_and_shape():
    between = PATH.between(STAMP_S[:4].reshape(2, 2) + 0.5)
    assert between.shape == (2, 2, 4, 4)
    np.testing.assert_array_equal(PATH.between(pd.Series(STAMP_S[:4] + 0.5)), between.reshape(4, 4, 4))
    assert PATH.between(STAMP_S[0]).shape == (4, 4)


def test_an_estimate_of_no_scans_has_no_share_on_time():
    none, zero = Trajectory(STAMP_S[:0], POSES[:0]), np.ones(0)
    of_none = estimate(prior=none, corrected=none, matches=zero, reason=(), seconds={}, update_s=zero)
    assert np.isnan(of_none.on_time_share)
    assert estimate().on_time_share == 1.0


class Unread(Sequence):
    stamp_s = STAMP_S

    def __len__(self):
        return K

    def __getitem__(self, index):
        raise AssertionError("read")


@pytest.mark.parametrize(
    "value",
    [PATH, SCANS[0], Flight(Unread(), PATH, np.eye(4)), estimate(), Segments.empty(), Structure.empty("no bar"),
     OdometryStep(0.0, np.eye(4)), Imu(STAMP_S, np.ones((K, 3)), np.ones((K, 3))), build_tower(), SegmentMap(),
     SegmentOdometry(), VoxelMap(0.1)],
)  # fmt: skip
def test_each_says_in_a_line_what_it_holds_and_scans_of_a_file_are_not_read(value):
    assert repr(value).startswith(type(value).__name__)
    assert len(repr(value)) < 160
    assert "array" not in repr(value)


@pytest.mark.parametrize("epoch_s", [0.0, 1.7e9])
def test_stamps_match_to_a_microsecond_at_any_epoch(epoch_s):
    path = Trajectory(STAMP_S - 1.7e9 + epoch_s, POSES)
    assert len(path.at(path.stamp_s + 7e-7)) == len(path.at(path.stamp_s - 7e-7)) == K
    for off_s in (2e-6, 0.05, -0.05, 3600.0):
        with pytest.raises(InputError, match=r"no pose at \d of 5 stamps"):
            path.at(path.stamp_s + off_s)


def test_bars_are_of_the_types_that_kernels_are_compiled_for():
    """From tables, single precision, and slices of larger arrays; radii may be unknown."""
    table = pd.DataFrame({"count": [3, 4, 5], "radius": [0.01, np.nan, 0.03]})
    ends = np.random.default_rng(0).normal(size=(3, 2, 3)).astype(np.float32)
    bars = Segments(ends[:, 0], ends[:, 1], table["count"], table["radius"])
    assert [type(column) for column in vars(bars).values()] == [np.ndarray] * 4
    assert [column.dtype for column in vars(bars).values()] == [float, float, np.int64, float]
    assert all(column.flags.c_contiguous for column in vars(bars).values())
    np.testing.assert_array_equal(np.stack([bars.start, bars.end], axis=1), ends)
    np.testing.assert_array_equal(bars.radius, table["radius"])


@pytest.mark.parametrize("far_m", [[0, 0, 0], [9000, -9000, 9000], [691_000, 5_336_000, 500], [0, -2e4, 0]])
def test_a_flight_far_from_zero_is_near_its_origin_and_heights_stay(far_m):
    flight = FLIGHT.moved(np.array(far_m) + 0.5)
    origin = flight.origin
    assert origin[2] == 0
    assert origin.any() == (np.abs(far_m[:2]) > 1e4).any()
    near = flight.moved(-origin)
    assert np.abs(near.prior.position[:, :2]).max() < 1e4
    assert not near.origin.any()
    np.testing.assert_allclose(near.moved(origin).prior.position, flight.prior.position, atol=1e-6)


@pytest.mark.parametrize(
    ("stamp_s", "number"), [(0.3, 3), (0.34, 3), (0.36, None), (0.3999999, 4), (0.399, None), (-0.01, None), (0.94, 9)]
)
def test_a_stamp_has_the_last_image_up_to_half_a_period_before_it(stamp_s, number):
    images = CameraImages(0.1 * np.arange(10), [], CAMERA, np.eye(4))
    assert images.at(stamp_s) == number
    assert CameraImages(np.zeros(0), [], CAMERA, np.eye(4)).at(0.0) is None


def test_u_points_right_and_v_down():
    points = np.array([[2.0, 0.0, 0.0], [2.0, 0.5, 0.0], [2.0, 0.0, 0.5], [-1.0, 0.0, 0.0]])
    pixel = project(points, CAMERA)
    np.testing.assert_allclose(pixel[:3], [[79.5, 59.5], [54.5, 59.5], [79.5, 32.0]])
    assert np.isnan(pixel[3]).all()
    homogeneous = points[:3] @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]]) @ CAMERA.T  # K (−y, −z, x)
    np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], pixel[:3])
    np.testing.assert_allclose(2.0 * unproject(pixel[:3], CAMERA), points[:3], atol=1e-12)
