"""What enters is checked once: arrays of a wrong shape or with NaN, numbers out of range, and what a user's class gives
are refused in one line that names the argument; lists, data frames and NumPy's numbers are taken."""

import numpy as np
import pandas as pd
import pytest

from steelnb import fusion, hough, io, metrics, odometry, planning, points, registration, settings
from steelnb.core import rng
from steelnb.core.errors import InputError
from steelnb.core.estimates import OdometryStep
from steelnb.core.kernels import compiling
from steelnb.core.types import Flight, Scan, Segments, Trajectory
from steelnb.hough.alternatives import find_bars_by
from tests.refusals import refused_by_name

CLOUD = np.random.default_rng(0).uniform(-1, 1, (60, 3))
POSES = np.tile(np.eye(4), (3, 1, 1))
SCANS = [Scan(float(k), CLOUD) for k in range(3)]
FLIGHT = Flight(SCANS, Trajectory(np.arange(3.0), POSES), np.eye(4))
PLANNED = settings.FlightSettings.preset("planned")
NAN = float("nan")
AXES = np.array([[[0.0, 0, 0], [0, 0, 1]]])
CROP = settings.PreprocessSettings()
ICP = settings.OdometrySettings.preset("icp")

TAKE_A_CLOUD = {
    "insert": lambda cloud: points.VoxelMap(0.1).insert(cloud),
    "voxel_grid": lambda cloud: points.voxel_grid(cloud, 0.1),
    "see": lambda cloud: planning.Planner(PLANNED, 1.0, 4.0).see(cloud, np.eye(4), Segments.empty()),
    "register": lambda cloud: registration.register(cloud, CLOUD),
    "detect_lines": hough.detect_lines,
    "detect_segments": hough.detect_segments,
    "find_bars_by": lambda cloud: find_bars_by("hough", cloud),
    "bend": lambda cloud: metrics.bend(cloud, cloud),
}


@pytest.mark.parametrize("order", ["xyz", "zyx", "izxy"])
def test_a_data_frame_is_read_by_the_names_of_its_columns(order):
    table = pd.DataFrame({name: CLOUD[:, "xyz".index(name.lower())] if name != "i" else 7.0 for name in order})
    for frame in (table, table.astype("Float64")):
        found = points.voxel_grid(frame, 0.1)
        np.testing.assert_array_equal(found, points.voxel_grid(CLOUD, 0.1))
        np.testing.assert_array_equal(Scan(0.0, frame).points, CLOUD)


@pytest.mark.parametrize("take", ["register", "detect_lines", "voxel_grid"])
def test_coordinates_that_nothing_on_earth_has_are_refused(take):
    with pytest.raises(InputError, match=r"a coordinate of 1e\+300; expected metres, at most 1e\+08"):
        TAKE_A_CLOUD[take](np.vstack([CLOUD, [[1e300, 0, 0]]]))


@pytest.mark.parametrize("take", TAKE_A_CLOUD)
@pytest.mark.parametrize(
    "cloud",
    [np.ones((60, 4)), CLOUD.T, CLOUD.ravel(), CLOUD.astype(str), None,
     np.ma.masked_array(CLOUD, np.ones((60, 3), bool))],
    ids=["(N, 4)", "(3, N)", "flat", "text", "None", "masked"],
)  # fmt: skip
def test_clouds_of_another_shape_or_kind(take, cloud):
    with pytest.raises(InputError) as refusal:
        TAKE_A_CLOUD[take](cloud)
    assert "\n" not in str(refusal.value)


REFUSED = {
    "T_world_drone": [
        lambda: fusion.reconstruct(SCANS, POSES[:2]), lambda: fusion.reconstruct(SCANS, 2 * POSES),
        lambda: points.preprocess_scan(SCANS[0], np.ones((9, 4)), np.eye(4), CROP),
        lambda: points.preprocess_scan(SCANS[0], 2 * np.eye(4), np.eye(4), CROP),
    ],
    "T_drone_sensor": [
        lambda: points.preprocess_scan(SCANS[0], np.eye(4), NAN * np.eye(4), CROP),
    ],
    "axes": [lambda axes=axes: metrics.score_segments(Segments.empty(), axes) for axes in (CLOUD, 0 * AXES)],
    "observed": [lambda: metrics.score_segments(Segments.empty(), AXES, np.ones(3, bool))],
    "member": [lambda: metrics.seen_members(AXES, CLOUD, np.full(60, 1))],
    "blind_s": [lambda: metrics.score_gaps(FLIGHT.prior, FLIGHT.prior, (1.0, 2.0))],
    "stamp_s": [lambda: metrics.largest_slip(np.zeros(9), np.zeros(9))],
    "axis": [lambda axis=axis: metrics.bend(CLOUD, CLOUD, axis) for axis in ((0.0, 0.0, 0.0), (0.0, NAN))],
    "sigma_m": [lambda: io.write_segments(Segments.empty(), "bars.csv", np.ones((3, 2)))],
    "max_correspondence_m": [lambda: registration.register(CLOUD, CLOUD, max_correspondence_m=0.0)],
    "method": [lambda: find_bars_by("houg", CLOUD), lambda: registration.register(CLOUD, CLOUD, "ipc")],
    "error": [lambda: registration.make_target(CLOUD, "icp")],
    "granularity": [lambda: hough.directions(40)],
    "seed": [lambda: rng.stream(None, "tof"), lambda: find_bars_by("hough", CLOUD, seed=-1)],
    "components": [lambda numbers=numbers: find_bars_by("gmm", CLOUD, components=numbers) for numbers in ([], [0])],
    "trials": [lambda: find_bars_by("ransac-lines", CLOUD, trials=NAN)],
    "centre": [lambda: points.VoxelMap(0.1).near([NAN] * 3, 1.0)],
    "radius_m": [lambda: points.VoxelMap(0.1).near([0.0] * 3, NAN)],
    **{
        name: [lambda name=name, value=value: hough.detect_segments(CLOUD, 0.1, **{name: value}) for value in values]
        for name, values in {
            "pca_ratio_min": (2, NAN), "gap_max": (-1, NAN), "radius_max": (0, NAN), "density_min": (-1,),
            "length_min": (NAN,), "max_lines": (0,),
        }.items()
    },
}  # fmt: skip


test_values_that_are_out_of_range_or_of_another_shape_are_refused_by_name = refused_by_name(REFUSED)


def test_an_own_class_needs_a_known_constructor():
    with pytest.raises(InputError, match="Own: its constructor needs give; expected T_drone_sensor"):
        odometry.correct(FLIGHT, ICP, own=Own)


def test_integers_compile_nothing_that_floats_have_not():
    counts = []
    for kind in (float, int, np.float32, np.int64):
        one = kind(1)
        registration.register(CLOUD, CLOUD, max_correspondence_m=one, robust_scale=one, translation_epsilon_m=one)
        hough.detect_segments(CLOUD, one, gap_max=one, radius_max=one, density_min=one, length_min=one)
        points.VoxelMap(one).insert(CLOUD)
        points.voxel_grid(CLOUD, one)
        counts.append(compiling.count)
    assert counts == counts[:1] * 4


def test_numbers_of_numpy_are_numbers():
    made = settings.ExperimentSettings.preset(
        seed=np.int64(3), duration_s=np.float32(9), overrides={"tof.rate_hz": np.int32(4), "tof.columns": np.uint8(8)}
    )
    assert made == settings.ExperimentSettings.preset(
        seed=3, duration_s=9.0, overrides={"tof.rate_hz": 4, "tof.columns": 8}
    )
    line = np.linspace([0, 0, 0], [0, 0, 2], 80)
    assert len(hough.detect_segments(line, np.float32(0.1), np.int64(20), np.int32(5), np.uint8(3))) == 1


class Own:
    def __init__(self, give):
        self.give = give

    def update(self, scan, T_world_drone_prior):
        return self.give(scan) if scan.stamp_s == 1 else OdometryStep(scan.stamp_s, T_world_drone_prior)


def later_changed(scan):
    step = OdometryStep(scan.stamp_s, np.eye(4))
    step.T_world_drone[0, 0] = np.nan
    return step


@pytest.mark.parametrize(
    "give",
    [lambda scan: OdometryStep(scan.stamp_s, np.full((4, 4), NAN)), lambda scan: OdometryStep(1.0, np.eye(4)[:3]),
     lambda scan: np.eye(4), lambda scan: None, later_changed, lambda scan: OdometryStep(0.0, np.eye(4))],
)  # fmt: skip
def test_a_bad_step_names_the_class_of_the_odometry_and_the_scan(give):
    with pytest.raises(InputError, match=r"^Own\.update, scan 1: "):
        odometry.run(FLIGHT, Own(give))
