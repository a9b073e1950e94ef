"""The types refuse what their docstrings exclude, and say in a line what they hold."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from steelnb.core.errors import InputError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.types import Flight, Imu, Lines, RangeScans, Scan, Segments, Trajectory
from steelnb.fusion import SegmentMap
from steelnb.fusion.structure import Structure
from steelnb.odometry import SegmentOdometry
from steelnb.points import VoxelMap, voxel_grid
from steelnb.simulation import build_tower

K = 5
STAMP_S, POSES, CLOUD = np.arange(K) + 1.7e9, np.tile(np.eye(4), (K, 1, 1)), np.ones((7, 3))
PATH = Trajectory(STAMP_S, POSES)
SEGMENTS = Segments(np.zeros((2, 3)), np.eye(3)[:2], np.ones(2), np.ones(2))
SCANS = [Scan(s, CLOUD) for s in STAMP_S]
FLIGHT = Flight(SCANS, PATH, np.eye(4))


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


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Trajectory(STAMP_S * 0, POSES), r"Trajectory.stamp_s\[1\] = 0.0 after 0.0"),
        (lambda: Trajectory(changed(STAMP_S, 2, np.nan), POSES), r"Trajectory.stamp_s\[2\] = nan"),
        (lambda: Trajectory(STAMP_S[:, None], POSES), r"Trajectory.stamp_s: .*\(5, 1\); expected \(N,\)"),
        (lambda: Trajectory(STAMP_S.astype(str), POSES), "Trajectory.stamp_s: .*real numbers"),
        (lambda: Trajectory(STAMP_S, POSES[1:]), r"T_world_drone: .*\(4, 4, 4\); expected \(5, 4, 4\)"),
        (lambda: Trajectory(STAMP_S, changed(POSES, (3, 0, 3), np.inf)), r"T_world_drone\[3\]: an entry is not finite"),
        (lambda: Trajectory(STAMP_S, changed(POSES, (3, 0, 1), 0.01)), r"T_world_drone\[3\]: axes .*not orthonormal"),
        (lambda: Trajectory(STAMP_S, changed(POSES, (3, 0, 0), -1)), r"T_world_drone\[3\]: a reflection"),
        (lambda: Trajectory(STAMP_S, changed(POSES, (3, 3, 0), 1)), r"T_world_drone\[3\]: last row"),
        (lambda: Trajectory(STAMP_S, changed(POSES, (3, 0, 3), -1e30)), r"T_world_drone\[3\]: a coordinate of 1e\+30"),
        (lambda: PATH.moved([1e300, 0, 0]), r"T_world_drone\[0\]: a coordinate of 1e\+300; expected metres"),
        (lambda: OdometryStep(0.0, changed(np.eye(4), (1, 3), 1e9)), "T_world_drone: a coordinate of 1e.09; expected"),
        (lambda: PATH.between([[1.0], [2.0, 3.0]]), "stamp_s: lists of several lengths"),
        (lambda: Trajectory((STAMP_S * 1000).astype(int), POSES), r"stamp_s\[0\] = 17000.*: expected seconds"),
        (lambda: Imu(STAMP_S * 1e9, np.ones((K, 3)), np.ones((K, 3))), r"Imu.stamp_s\[0\] = 1.7e\+18: expected s"),
        (lambda: Scan(1_700_000_000_000_000_000, CLOUD), "Scan.stamp_s = 17000.*: expected seconds, at most 1e.11"),
        (lambda: Scan(0.0, np.ones((7, 2))), r"Scan.points: .*\(7, 2\)"),
        (lambda: Scan(0.0, CLOUD.astype(object)), "Scan.points: object"),
        (lambda: Scan(np.nan, CLOUD), "Scan.stamp_s = nan"),
        (lambda: Scan("1.0", CLOUD), "Scan.stamp_s = '1.0'"),
        (lambda: Imu(STAMP_S, np.ones((K, 3)), np.ones((K, 2))), r"Imu.angular_rate: .*expected \(5, 3\)"),
        (lambda: Imu(STAMP_S, changed(np.ones((K, 3)), 2, np.nan), np.ones((K, 3))), r"specific_force\[2, 0\] = nan"),
        (lambda: Flight(SCANS, PATH, np.eye(3)), "Flight.T_drone_sensor: .*expected a rigid transform"),
        (lambda: Flight(SCANS[:4], PATH, np.eye(4)), "Flight.scans: 4; expected 5"),
        (lambda: Flight([Scan(s + 2e-6, CLOUD) for s in STAMP_S], PATH, np.eye(4)), "Flight.scans: number 0"),
        (lambda: Flight(iter(SCANS), PATH, np.eye(4)), "Flight.scans: list_iterator; expected a sequence"),
        (lambda: Flight([CLOUD] * K, PATH, np.eye(4)), r"Flight.scans\[0\] = ndarray: expected Scan"),
        (lambda: Flight(RangeScans(STAMP_S + 100, np.ones((K, 1, 1)), np.ones((1, 1, 3))), PATH, np.eye(4)), "100 s"),
        (lambda: Flight(SCANS, POSES, np.eye(4)), "Flight.prior = ndarray: expected Trajectory"),
        (lambda: OdometryStep(0.0, np.eye(4)[:3]), r"OdometryStep.T_world_drone: .*\(3, 4\)"),
        (lambda: OdometryStep(0.0, np.eye(4), seconds=[1]), "OdometryStep.seconds = .*: expected dict"),
        (lambda: OdometryStep(0.0, np.eye(4), seconds={"map": None}), "OdometryStep.seconds\\['map'\\] = None"),
        (lambda: OdometryStep(0.0, np.eye(4), reason=7), "OdometryStep.reason = 7: expected str"),
        (lambda: OdometryStep(0.0, np.eye(4), covariance=np.eye(3)), r"OdometryStep.covariance: .*expected \(6, 6\)"),
        (lambda: Scan(0.0, np.zeros((3, 3)), None), "Scan.fault = None: expected str"),
        (lambda: Segments.empty().transformed(np.eye(3)), "T_target_source: .*\\(3, 3\\)"),
        (lambda: Segments.empty().moved([1, 2]), "by: .*\\(2,\\)"),
        (lambda: OdometryStep(0.0, np.eye(4), unobserved=4), "OdometryStep.unobserved = 4: .*from 0 to 3"),
        (lambda: estimate(points=CLOUD[:, :2]), r"Estimate.points: .*expected \(N, 3\)"),
        (lambda: estimate(corrected=Trajectory(STAMP_S + 1, POSES)), "Estimate.corrected: number 0 .* 1 s after"),
        (lambda: estimate(update_s=np.zeros(4)), r"Estimate.update_s: .*expected \(5,\)"),
        (lambda: estimate(seconds={"a": np.zeros(4)}), r"Estimate.seconds\['a'\]"),
        (lambda: estimate(reason=("",)), "Estimate.reason: 1; expected 5"),
        (lambda: Segments(CLOUD, CLOUD[:6], np.ones(7), np.ones(7)), r"Segments.end: .*\(6, 3\); expected .*\(7, 3\)"),
        (lambda: Segments(CLOUD, CLOUD, np.ones(7), None), "Segments.radius: None"),
        (lambda: replace(FLIGHT, range_sigmas=(0.001,)), "Flight.range_sigmas: .*shape .1,.; expected .2,."),
        (lambda: replace(FLIGHT, range_sigmas=(0.001, np.nan)), "Flight.range_sigmas.1. = nan"),
        (lambda: replace(FLIGHT, facts=None), "Flight.facts = None: expected Mapping"),
        (lambda: replace(FLIGHT, name=5), "Flight.name = 5: expected str"),
        (lambda: OdometryStep(0.0, np.eye(4), used=1), "OdometryStep.used = 1: expected bool$"),
        (lambda: Segments.joined(SEGMENTS), "parts = Segments: expected a sequence"),
        (lambda: Segments.joined(np.ones((2, 3))), "a part = ndarray: expected Segments"),
        (lambda: changed_segments(start=np.nan).checked(), r"Segments.start\[1, 0\] = nan"),
        (lambda: changed_segments(count=-2.0).checked(), "Segments.count: -2.0; expected finite numbers of at least 0"),
        (lambda: changed_segments(radius=np.inf).checked(), "Segments.radius: inf"),
        (lambda: Lines(CLOUD, CLOUD, np.ones(7), [-2]).checked(), "Lines.label: -2"),
        (lambda: Lines(CLOUD, CLOUD, np.ones((7, 1)), np.zeros(9, int)), r"Lines.count: .*expected an array \(7,\)"),
        (lambda: Structure.of(None), "bars = None: expected Segments"),
        (lambda: replace(Structure.of(SEGMENTS), width_m=np.ones(3)), "Structure.width_m: 3; expected 2, one a bar"),
    ],
)  # fmt: skip
def test_values_that_the_docstrings_exclude_are_refused_in_one_line(make, says):
    with pytest.raises(InputError, match=says) as refusal:
        make()
    assert "\n" not in str(refusal.value)


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
def test_the_fields_x_y_and_z_of_a_structured_array_are_points_and_an_object_with_points_is_told_so(shape):
    read = np.zeros(shape, [("intensity", "f4"), ("z", "f4"), ("Y", "f8"), ("x", "f4")])
    read["x"], read["Y"], read["z"] = 1, 2, 3
    np.testing.assert_array_equal(Scan(0.0, read).points, np.tile([1.0, 2.0, 3.0], (*shape, 1)))
    masked = np.ma.array(read, mask=np.zeros(shape, [(name, bool) for name in read.dtype.names]))
    masked.mask["z"] = True
    assert np.isnan(Scan(0.0, masked).points[..., 2]).all()
    assert voxel_grid(read.ravel(), 0.1).tolist() == [[1, 2, 3]]
    for call in (lambda: Scan(0.0, SimpleNamespace(points=CLOUD)), lambda: voxel_grid(Scan(0.0, CLOUD), 0.1)):
        with pytest.raises(InputError, match=r"an array.*, such as its \.points$"):
            call()
    with pytest.raises(InputError, match="expected real numbers in an array"):
        Scan(0.0, read[["x", "z"]])


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


def test_slices_of_ends_are_copied_so_that_kernels_are_not_compiled_for_them():
    ends = np.random.default_rng(0).normal(size=(3, 2, 3))
    bars = Segments(ends[:, 0], ends[:, 1], np.ones(3), np.ones(3))
    assert bars.start.flags.c_contiguous
    assert bars.end.flags.c_contiguous
    np.testing.assert_array_equal(np.stack([bars.start, bars.end], axis=1), ends)


def test_bars_from_tables_and_with_unknown_radii_are_taken():
    table = pd.DataFrame({"count": [3, 4], "radius": [0.01, np.nan]})
    ends = np.arange(6.0).reshape(2, 3)
    bars = Segments(ends, ends + 1.0, table["count"], table["radius"]).checked()
    assert type(bars.count) is type(bars.radius) is np.ndarray
    masked = np.ma.masked_array([0.01, 0.02], [False, True])
    np.testing.assert_array_equal(Segments(ends, ends + 1.0, np.ones(2), masked).checked().radius, [0.01, np.nan])


def test_sigmas_may_be_an_array_and_a_name_a_path():
    flight = replace(FLIGHT, range_sigmas=np.array([0.01, 0.02]), name=Path("flights/a.bag"))
    assert (flight.range_sigmas, flight.name) == ((0.01, 0.02), "flights/a.bag")
