"""Public functions refuse wrong arguments in one line that names the argument, its value and what is expected."""

import inspect
from pathlib import Path
from typing import Literal, get_type_hints

import numpy as np
import pandas as pd
import pytest

from steelnb import (
    experiment,
    fusion,
    hough,
    io,
    metrics,
    odometry,
    planning,
    plots,
    points,
    registration,
    settings,
    simulation,
)
from steelnb.core import rng
from steelnb.core.arguments import _demand_of, checks_arguments
from steelnb.core.errors import InputError
from steelnb.core.estimates import OdometryStep
from steelnb.core.kernels import compiling
from steelnb.core.types import Flight, Lines, Scan, Segments, Trajectory
from steelnb.hough.alternatives.methods import find_bars_by

CLOUD = np.random.default_rng(0).uniform(-1, 1, (60, 3))
POSES = np.tile(np.eye(4), (3, 1, 1))
SCANS = [Scan(float(k), CLOUD) for k in range(3)]
FLIGHT = Flight(SCANS, Trajectory(np.arange(3.0), POSES), np.eye(4))
PLANNED = settings.FlightSettings.preset("planned")
NAN = float("nan")
POINTS = registration.make_target(CLOUD, "point")
AXES = np.array([[[0.0, 0, 0], [0, 0, 1]]])
CROP, FUSION = settings.PreprocessSettings(), settings.FusionSettings()
ICP = settings.OdometrySettings.preset("icp")


def bars(**change):
    parts = {"start": [[0.0, 0, 0]], "end": [[0.0, 0, 1]], "count": [9], "radius": [0.01]}
    return Segments(**{name: np.array(value) + change.get(name, 0) for name, value in parts.items()})


def cut_with_label(label):
    lines = Lines(np.zeros((1, 3)), AXES[0, 1:], np.array([60]), [label] * 60)
    return hough.cut_and_sort(CLOUD, lines, 0.4, 2, 0.0, 1.0, 0.0, 0.0)


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


@pytest.mark.parametrize("order", ["xyz", "zyx", "iZXY"])
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
    [np.ones((60, 4)), CLOUD.T, CLOUD.ravel(), CLOUD.astype(object), CLOUD.astype(str), None, "cloud", 3.0,
     np.ma.masked_array(CLOUD, np.ones((60, 3), bool))],
    ids=["(N, 4)", "(3, N)", "flat", "object", "text", "None", "name", "number", "masked"],
)  # fmt: skip
def test_clouds_of_another_kind(take, cloud):
    with pytest.raises(InputError) as refusal:
        TAKE_A_CLOUD[take](cloud)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        *[(lambda name=name, value=value: hough.detect_segments(CLOUD, 0.1, **{name: value}), f"{name} = {value}")
          for name, value in (("pca_ratio_min", 2), ("pca_ratio_min", NAN), ("gap_max", -1), ("gap_max", NAN),
                              ("radius_max", 0), ("radius_max", NAN), ("density_min", -1), ("length_min", NAN),
                              ("max_lines", 0), ("granularity", 7))],
        (lambda: OdometryStep(0.0, np.eye(4), covariance=-np.eye(6)), "covariance: expected a symmetric matrix"),
        (lambda: OdometryStep(0.0, np.eye(4), covariance=np.tri(6)), "covariance: expected a symmetric matrix"),
        (lambda: settings.FusionSettings(angle_max_rad=8.0), "angle_max_rad = 8.0"),
        (lambda: settings.ExperimentSettings.preset(duration_s=pd.Series([5.0])), "duration_s = "),
        (lambda: settings.ExperimentSettings.preset(overrides={"tof.samples": [5, 2**70]}), "step 11805.*expected"),
        (lambda: settings.ExperimentSettings.preset(overrides={"tof.blind_s": [[2, np.inf]]}), "blind_s.* = inf"),
        (lambda: settings.ExperimentSettings.report("3.5", "vertical", "gicp", noise=""), "noise = ''"),
        (lambda: settings.ExperimentSettings.report("3.5", "vertical", "gicp", ""), "method = ''"),
        (lambda: find_bars_by("houg", CLOUD), "method = 'houg': expected one of .*did you mean 'hough'"),
        (lambda: find_bars_by("hough", CLOUD, seed=-1), "seed = -1: expected an integer of at least 0"),
        (lambda: find_bars_by("gmm", CLOUD, components=[]), "components = .*at least one"),
        (lambda: find_bars_by("gmm", CLOUD, components=[0]), r"components\[0\] = 0"),
        (lambda: find_bars_by("gmm", CLOUD, component=[3]), "option of gmm = 'component'.*did you mean"),
        (lambda: find_bars_by("ransac-lines", CLOUD, trials=NAN), "trials = nan"),
        (lambda: registration.register(CLOUD, CLOUD, None), "method = None: expected one of 'icp'"),
        (lambda: registration.register(CLOUD, "icp"), "target: str"),
        (lambda: registration.register(CLOUD, CLOUD, iterations_max=2.0), "iterations_max = 2.0"),
        (lambda: registration.register(CLOUD, CLOUD, max_correspondence_m="1"), "max_correspondence_m = '1'"),
        (lambda: points.smooth_ranges(CLOUD, -1), "radius_px = -1"),
        (lambda: odometry.run(FLIGHT, "best"), "odometry = 'best': expected an object with a method update"),
        (lambda: fusion.reconstruct(SCANS, POSES[:2]), r"T_world_drone: .*expected \(3, 4, 4\)"),
        (lambda: fusion.reconstruct(SCANS, 2 * POSES), r"T_world_drone\[0\]: last row"),
        (lambda: fusion.reconstruct(iter(SCANS), POSES), "scans: list_iterator"),
        (lambda: metrics.largest_slip(np.zeros(1), np.zeros(1)), "1 scans with 1 stamps; expected at least two"),
        (lambda: settings.ExperimentSettings.preset(duration_s=1e-9), "duration_s = 1e-09: expected two scans"),
        (lambda: metrics.score_segments(Segments.empty(), CLOUD), r"axes: .*\(M, 2, 3\)"),
        (lambda: registration.make_target(CLOUD, "icp"), "error = 'icp': expected one of 'point'"),
        (lambda: settings.OdometrySettings.preset(["best"]), r"method = \['best'\]"),
        (lambda: settings.OdometrySettings.preset("best", np.zeros(2)), "sensor = "),
        (lambda: settings.OdometrySettings.preset("best", overrides="smooth"), "overrides = 'smooth'"),
        (lambda: settings.ExperimentSettings.preset(overrides="smooth"), "overrides = 'smooth'"),
        (lambda: settings.ExperimentSettings.preset(seed=-1), "seed = -1"),
        (lambda: settings.ExperimentSettings.report(3.5, "vertical", "gicp"), "figure = 3.5: expected str"),
        (lambda: settings.OdometrySettings.preset("ICP"), "method = 'ICP', did you mean 'icp'"),
        (lambda: settings.ExperimentSettings.preset(seed=np.ones((2, 2))), r"seed = \[\["),
        (lambda: settings.ExperimentSettings.preset(trajectory=np.ones((2, 2))), "trajectory = ndarray"),
        (lambda: settings.Noise(random_walk_m=NAN), "Noise.random_walk_m = nan: expected a number from 0"),
        (lambda: rng.stream(None, "tof"), "seed = None: expected an integer of at least 0"),
        (lambda: hough.directions(40), "granularity = 40: expected an integer from 0 to 6"),
        (lambda: points.preprocess_scan(SCANS[0], np.ones((9, 4)), np.eye(4), CROP), r"T_world_drone: .*\(9, 4\)"),
        (lambda: points.preprocess_scan(SCANS[0], 2 * np.eye(4), np.eye(4), CROP), "T_world_drone: last row"),
        (lambda: points.preprocess_scan(SCANS[0], np.eye(4), NAN * np.eye(4), CROP), "_sensor: an entry is not finite"),
        (lambda: odometry.run(FLIGHT, odometry.CloudOdometry), "odometry = the class CloudOdometry: "),
        (lambda: metrics.score_gaps(FLIGHT.prior, FLIGHT.prior, (1.0, 2.0)), r"blind_s: .*expected \(N, 2\)"),
        (lambda: metrics.score_segments(Segments.empty(), AXES, angle_max_rad=NAN), "angle_max_rad = nan"),
        (lambda: metrics.score_segments(Segments.empty(), AXES, np.ones(3, bool)), "observed: .*bool"),
        (lambda: metrics.largest_slip(np.zeros(9), np.zeros(9)), r"stamp_s\[1\] = .* strictly increasing stamps"),
        (lambda: io.write_flight("flight.mcap", None), "flight = None: expected Flight, as from read_flight"),
        (lambda: io.read_flight("flight.bag", T_drone_sensor=np.eye(3)), r"T_drone_sensor: .*\(3, 3\)"),
        (lambda: io.read_flight("flight.bag", T_drone_sensor=2 * np.eye(4)), "T_drone_sensor: last row"),
        (lambda: io.write_segments(Segments.empty(), "bars.csv", np.ones((3, 2))), r"sigma_m: .*expected \(0, 2\)"),
        (lambda: io.write_segments(Segments.empty(), "bars.csv", more={"width": [1.0]}), "width: 1; expected 0"),
        (lambda: registration.icp_as_pcl(CLOUD, CLOUD, 1.0, 5, 1e-3), "target = ndarray: expected Target"),
        (lambda: registration.icp_as_pcl(CLOUD, POINTS, 0.0, 5, 1e-3), "max_correspondence_m = 0.0"),
        (lambda: registration.gicp_as_pcl(CLOUD, np.ones((60, 6)), POINTS, 1.0, 5, 1e-3), "without covariances"),
        (lambda: registration.gicp_as_pcl(CLOUD, CLOUD, POINTS, 1.0, 5, 1e-3), r"covariance: .*expected \(60, 6\)"),
        (lambda: FLIGHT.first(-1), "count = -1"),
        (lambda: FLIGHT.prior.moved("far"), "by: str"),
        (lambda: FLIGHT.prior.between([NAN]), r"stamp_s\[0\] = nan"),
        (lambda: fusion.SegmentMap().insert(bars(radius=-1.0)), "Segments.radius: -0.99"),
        (lambda: fusion.associate(bars(), bars(end=NAN), FUSION), r"Segments.end\[0, 0\] = nan"),
        (lambda: cut_with_label(3), "lines.label: 3; expected less than the number of lines, 1"),
        (lambda: points.VoxelMap(0.1).shapes(np.zeros((1, 2), int)), r"slots: int64 of shape \(1, 2\)"),
        (lambda: points.VoxelMap(0.1).means([True]), r"slots: bool of shape \(1,\)"),
        (lambda: points.VoxelMap(0.1).means([4]), "slots: 4; expected whole numbers"),
        (lambda: points.VoxelMap(0.1).near("abc", 1.0), "centre: str"),
        (lambda: points.VoxelMap(0.1).near([NAN] * 3, 1.0), r"centre\[0\] = nan"),
        (lambda: points.VoxelMap(0.1).near([0.0] * 3, NAN), "radius_m = nan"),
        (lambda: points.VoxelMap(0.1).correspond(CLOUD, np.eye(4), 1.0, np.zeros(60, int), None), "state = None"),
        (lambda: registration.icp_as_pcl(CLOUD, POINTS, 1.0, 5, NAN), "epsilon = nan"),
        (lambda: metrics.bend(CLOUD, CLOUD, (0.0, 0.0, 0.0)), r"axis: an array of shape \(3,\)"),
        (lambda: metrics.bend(CLOUD, CLOUD, (0.0, NAN)), r"axis\[1\] = nan"),
        (lambda: metrics.seen_members(AXES, CLOUD, np.full(60, 1)), "member: 1; expected less than .* axes, 1"),
        (lambda: metrics.seen_members(0 * AXES, CLOUD, np.zeros(60, int)), r"axes\[0\]: both ends at"),
        (lambda: metrics.score_segments(Segments.empty(), 0 * AXES), r"axes\[0\]: both ends at"),
        (lambda: odometry.correct(FLIGHT, ICP, own=Own), "Own: its constructor needs give; expected T_drone_sensor"),
        (lambda: settings.ExperimentSettings.preset(seed=np.float64(1.5)), "seed = 1.5"),
    ],
)  # fmt: skip
def test_values_that_are_out_of_range_or_of_another_kind(call, says):
    with pytest.raises(InputError, match=says) as refusal:
        call()
    assert "\n" not in str(refusal.value)


UNCHECKED = (
    "draw_tower", "gather_bar", "gather_legend", "use", "smooth_ranges", "align", "make_target", "prior_term",
    "register", "read_tables", "parse_parameter", "read_report_plots",
)  # fmt: skip
"""Public functions that look at their arguments themselves, or that only figures of ours call."""
CHECKED = [
    experiment.run, experiment.simulate, experiment.redrift, experiment.estimate, experiment.draws,
    fusion.SegmentMap, fusion.SegmentMap.insert, fusion.Structure.of,
    odometry.CloudOdometry, odometry.FaceOdometry, odometry.OrbOdometry, planning.OnboardPilot, points.VoxelMap,
    points.VoxelMap.insert, simulation.OnboardSensors,
    *(getattr(room, name)
      for room in (fusion, hough, io, metrics, odometry, planning, plots, points, registration, settings, simulation)
      for name in room.__all__ if inspect.isfunction(getattr(room, name)) and name not in UNCHECKED),
]  # fmt: skip
ARGUMENTS = [
    (function, name)
    for function in CHECKED
    for name, hint in get_type_hints(function.__init__ if inspect.isclass(function) else function).items()
    if name != "return" and _demand_of(hint).words
]


class Strange:
    pass


@pytest.mark.parametrize(("function", "name"), ARGUMENTS)
def test_every_argument_of_a_public_function_is_of_the_kind_of_its_annotation(function, name):
    assert len(ARGUMENTS) > 180
    with pytest.raises(InputError, match=f"^{name} = Strange: expected "):
        function(**{name: Strange()})


@checks_arguments
def takes(
    number: float, kinds: Literal["a", "b"] | None = None, many: dict[str, int] | None = None, path: Path | str = ""
):
    return number


def test_arguments_are_compared_with_annotations_by_place_and_by_name():
    assert takes(np.float32(0.5), "a", {}, Path("x")) == takes(number=0.5, path="x") == 0.5
    for args, named, says in (
        ((True,), {}, "number = True: expected a number"), ((1, "c"), {}, "kinds = 'c': expected 'a', 'b' or None"),
        ((1,), {"many": [1]}, r"many = \[1\]: expected a table or None"),
        ((1,), {"path": 3}, "path = 3: expected a path or a text"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=says):
            takes(*args, **named)
    with pytest.raises(TypeError, match="missing"):
        takes()


def test_numbers_become_those_of_python_so_that_no_kernel_is_compiled_anew():
    @checks_arguments
    def kinds(one: float, two: int = 1, three: float | None = None, four: bool = False):
        return [type(each) for each in (one, two, three, four)]

    assert kinds(1, np.int32(2), np.float32(3), np.True_) == [float, int, float, bool]
    assert kinds(three=2, one=np.float64(1)) == [float, int, float, bool]
    assert kinds(1)[2] is type(None)
    with pytest.raises(TypeError):
        kinds(1, 2, 3, True, 5)


def test_integers_compile_nothing_that_floats_have_not():
    registration.register(CLOUD, CLOUD, max_correspondence_m=0.5, robust_scale=2.0)
    hough.detect_segments(CLOUD, 0.5, gap_max=0.5, radius_max=0.2, density_min=0.5, length_min=0.1)
    before = compiling.count
    for kind in (int, np.float32, np.int64):
        one = kind(1)
        registration.register(CLOUD, CLOUD, max_correspondence_m=one, robust_scale=one, translation_epsilon_m=one)
        hough.detect_segments(CLOUD, one, gap_max=one, radius_max=one, density_min=one, length_min=one)
        points.VoxelMap(one).insert(CLOUD)
        points.voxel_grid(CLOUD, one)
    assert compiling.count == before


def test_bars_of_other_types_compile_nothing_that_usual_ones_have_not():
    known = bars()
    fusion.SegmentMap().insert(known)
    assert fusion.associate(known, known, FUSION).tolist() == [0]
    before = compiling.count
    single = Segments(*(getattr(known, name).astype(np.float32) for name in ("start", "end", "count", "radius")))
    fixed = bars()
    fixed.start.flags.writeable = fixed.count.flags.writeable = False
    for other in (single, fixed):
        fusion.SegmentMap().insert(other)
        assert fusion.associate(other, known, FUSION).tolist() == [0]
    assert compiling.count == before


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
