import copy
import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.settings import (
    METHODS,
    TRAJECTORIES,
    ExperimentSettings,
    FlightSettings,
    Noise,
    OdometrySettings,
    RecordingOptions,
    TofFault,
    TofSettings,
    TowerSettings,
    read_options,
    read_report_plots,
)
from steelnb.settings.odometry import FAMILIES
from steelnb.settings.presets import PRESETS
from steelnb.settings.report_plots import STEP_S
from steelnb.settings.world import REST_S, without
from steelnb.simulation.drift import drift_errors
from steelnb.simulation.tof import scan_steps


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ({"trajectory": "spiral"}, "trajectory = 'spiral'"),
        ({"sensor": "lidar"}, "sensor = 'lidar'"),
        ({"noise": "random-wlak"}, "did you mean 'random-walk'"),
        ({"noise": "random-walk:-0.002"}, "random_walk_m = -0.002"),
        ({"noise": "random-walk:fast"}, "'fast'"),
        ({"noise": "random-walk+random-walk"}, "twice"),
        ({"noise": 0.002}, "noise_name = 0.002"),
        ({"noise": "tilt:100"}, "tilt_rad = 100"),
        ({"seed": "1"}, "seed = '1'.*or 'report'"),
        ({"seed": True}, "seed = True"),
        ({"seed": 2**63}, "seed = 9223372036854775808"),
        ({"duration_s": 0.0}, "duration_s = 0.0"),
        ({"duration_s": float("nan")}, "duration_s = nan"),
        ({"duration_s": 9.0, "overrides": {"tof.start_s": 9.0}}, "start_s = 9"),
        ({"trajectory": "orbit-3.3", "duration_s": 211.0}, "waypoints end after 208.5 s"),
        ({"trajectory": "planned", "method": "orb"}, "'orb'"),
        ({"trajectory": "planned", "overrides": {"flight.still_s": 2.0}}, "still_s = 2"),
        ({"tower": "hevy"}, "tower = 'hevy', did you mean 'heavy'"),
        ({"method": "gicp", "overrides": {"error": "plane"}}, "error = 'plane'"),
        ({"overrides": {"tower": "hevy"}}, "tower = 'hevy', did you mean 'heavy'"),
        ({"overrides": {"tof.rate": 5}}, "rate = 5: unknown setting, did you mean 'rate_hz'"),
        ({"overrides": {"radar.rate_hz": 5}}, "radar.rate_hz"),
        ({"overrides": {"tower.profile_m": ((0.0, 4.0), (20.0, 1.7), (16.0, 1.0))}}, "profile_m"),
        ({"overrides": {"tower.profile_m": ((0.0, 1.0), (9.0, 0.1), (16.0, 1.0))}}, "profile_m"),
        ({"overrides": {"tower.arms_m": ((10.0, 3.0), (10.3, 3.0))}}, "arms_m"),
        ({"overrides": {"tower.arms_m": ((15.8, 3.0),)}}, "arms_m"),
        ({"overrides": {"tower.sections_m": {"leg": (0.1, 0.2)}}}, "sections_m.leg"),
        ({"overrides": {"tof.columns": True}}, "columns = True"),
        ({"overrides": {"tof.faults": ["blur"]}}, "faults.0 = 'blur'"),
        ({"overrides": {"tof.blind_s": ((5.0, 3.0),)}}, "blind_s"),
        ({"overrides": {"tof.mount_m": (0.0, 0.0)}}, "mount_m"),
        ({"overrides": {"tof.samples": (5, 5)}}, "scan 1 at step 5"),
        ({"overrides": {"tof.samples": (-1, 5)}}, "scan 0 at step -1"),
        ({"overrides": {"tof.samples": (1, 2.5)}}, "samples"),
        ({"duration_s": 5.0, "overrides": {"tof.samples": [0, 625]}}, "tof.samples"),
        ({"duration_s": 5.0, "overrides": {"tof.samples": [0, 626]}}, "tof.samples"),
        ({"sensor": "report", "duration_s": 1.0, "overrides": {"tof.rate_hz": 1.0}}, "duration_s = 1"),
        ({"sensor": "report", "overrides": {"tof.columns": 1}}, "pixel_origin = 'corner'"),
        ({"overrides": {"imu": 3}}, "imu = 3: expected a table"),
        ({"overrides": {"imu.gyro_noise": 1e-3}}, r"imu.gyro_noise = 0.001: imu is None"),
        ({"sensor": "starling2-honest", "overrides": {"imu.gyro": 0}}, "mean 'gyro_(noise|walk|bias)'"),
        ({"overrides": {"flight.height_min_m": 8.0, "flight.height_max_m": 2.0}}, "height_min_m = 8"),
        ({"method": "report-icp", "overrides": {"broken_off_s": None}}, "broken_off_s = None"),
        ({"overrides": {"preprocess.crop_m": 3.0, "odometry.preprocess.crop_m": 4.0}}, "preprocess.crop_m is given tw"),
        ({"overrides": {"sensor": "report"}}, "sensor = 'report': this is 'starling2'"),
        ({"overrides": {5: 1}}, "a name in overrides = 5"),
        ({"noise": "tilt", "overrides": {"noise_name": "none"}}, "noise = 'tilt'"),
        ({"duration_s": 9.0, "overrides": {"flight.duration_s": 8.0}}, "duration_s = 9.0"),
        ({"seed": 3, "overrides": {"seed": 7}}, "seed = 3"),
        ({"duration_s": 5.0, "overrides": {"flight": {"trajectory": "loops"}}}, "duration_s = 5.0"),
        ({"tower": "heavy", "overrides": {"tower": "light"}}, "tower = 'heavy'"),
    ],
)
def test_a_bad_setting_is_named_in_one_line(arguments, names):
    with pytest.raises(InputError, match=names) as caught:
        ExperimentSettings.preset(**arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("noise", "left"),
    [
        ("random-walk:0.001+yaw-random-walk", "random-walk:0.001"),
        ("yaw-random-walk + random-walk", "random-walk"),
        ("random-walk+yaw-random-walk:0.001+tilt", "random-walk+tilt"),
        ("yaw-random-walk", "none"),
        ("random-walk", "random-walk"),
    ],
)
def test_a_noise_without_one_of_its_parts_keeps_the_others(noise, left):
    assert without(noise, "yaw-random-walk") == left
    assert Noise.parse(left) == replace(Noise.parse(noise), yaw_random_walk_rad=0.0)


def test_the_first_two_scans_are_counted_after_the_overrides():
    settings = ExperimentSettings.preset(duration_s=0.1, overrides={"tof.rate_hz": 30.0})
    assert len(scan_steps(settings.tof, 0.096, STEP_S)) == 3


@pytest.mark.parametrize("method", METHODS)
def test_settings_are_made_again_from_json_and_from_arrays(method):
    settings = ExperimentSettings.preset(
        method=method, sensor="starling2-honest", overrides={"tof.mount_m": np.ones(3)}
    )
    assert settings.tof.mount_m == (1.0, 1.0, 1.0)
    assert ExperimentSettings(**json.loads(settings.model_dump_json())) == settings
    assert ExperimentSettings(**settings.model_dump()) == settings


def test_settings_can_be_keys_and_their_tables_do_not_change():
    settings = ExperimentSettings.preset()
    assert {settings: 1, settings.replace(seed=2): 2}[copy.deepcopy(settings)] == 1
    for change in (lambda t: t.update(leg=(9.0, 1.0)), lambda t: t.pop("leg"), lambda t: t.__setitem__("leg", (9, 1))):
        with pytest.raises(InputError, match="settings do not change"):
            change(settings.tower.sections_m)


def test_settings_are_frozen():
    with pytest.raises(InputError, match=r"TofSettings.rate_hz: settings do not change; replace\(rate_hz="):
        TofSettings().rate_hz = 10.0


def test_the_report_preset_holds_the_published_settings():
    report = ExperimentSettings.preset(sensor="report", noise="random-walk", method="average")
    assert (report.tof.columns, report.tof.rows, report.tof.fov_horizontal_rad) == (64, 64, 2.04)
    assert (report.tof.range_max_m, report.tof.sigma_floor_m, report.tof.noise_on) == (4.0, 0.01, "depth")
    before = ExperimentSettings.preset(sensor="report-4cm", noise="random-walk", method="average")
    assert (before.tof.sigma_floor_m, before.tof.noise_on, before.tof.rate_hz) == (0.04, "range", 5.0)
    assert (before.tof.pixel_origin, report.tof.pixel_origin) == ("centre", "corner")
    method = report.odometry
    crop = method.preprocess
    assert (crop.crop_m, crop.floor_m, crop.voxel_leaf_m) == (1.5, 0.3, pytest.approx(0.05 / 1.5))
    assert (method.hough.min_votes, method.hough.max_lines, method.hough.granularity) == (12, 10, 6)
    assert method.hough.dx_m == pytest.approx(0.05 / 1.5 * 3**0.5)
    assert method.fusion.distance_max_m == pytest.approx(0.2286, abs=1e-4)
    assert report.noise.random_walk_m == 0.002


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"duration_s": 20.1}, r"flight of 20.1 s: its waypoints end after 20 s"),
        ({"waypoints": ()}, "'vertical' with 0 waypoints"),
        ({"trajectory": "zigzag"}, "'zigzag' with 2 waypoints"),
        ({"waypoints": ((0.0, 2.5, 1.0, 0.0, 0.0),)}, "at least two"),
        ({"waypoints": ((0.0, 2.5, 1.0, 0.0, 5.0), (0.0, 2.5, 2.0, 0.0, 20.0))}, "0 seconds to the first"),
        ({"waypoints": ((0.0, 2.5, 1.0, 0.0, 0.0), (0.0, 2.5, 2.0, 0.0, 0.0))}, "more to all others"),
        ({"waypoints": ((0.0, 2.5, 1.0, 0.0, 0.0), (0.0, 2.5, -2.0, 0.0, 20.0))}, r"waypoints.1.2 = -2.0"),
        ({"waypoints": ((0.0, 2.5, 1.0, 0.0, 0.0), (0.0, 2.5, 2.0, 20.0))}, "waypoints.1"),
    ],
)
def test_a_flight_that_contradicts_its_waypoints_is_refused(changes, says):
    path = ((0.0, 2.5, 1.0, 0.0, 0.0), (0.0, 2.5, 2.0, 90.0, 20.0))
    good = {"trajectory": "vertical", "duration_s": 20.0, "waypoints": path}
    assert FlightSettings(**good).waypoints == path
    with pytest.raises(InputError, match=says) as caught:
        FlightSettings(**{**good, **changes})
    assert "\n" not in str(caught.value)


def test_a_duration_may_end_with_waypoints_of_ones_own():
    path = ((0.5, 2.5, 0.1, -90.0, 0.0), (0.5, 2.5, 2.0, -90.0, 900.0))
    own = ExperimentSettings.preset("vertical", duration_s=900.0, overrides={"flight.waypoints": path})
    assert (own.flight.duration_s, own.flight.waypoints) == (900.0, path)


@pytest.mark.parametrize(
    ("noise", "says"),
    [
        ("random-walk:0.001", r"random_walk_m = 0.001: the report has 0.002 or none"),
        ("constant-drift:0.0002", "constant_drift_m = 0.0002: the report has 0.0001 or none"),
        ("random-walk+yaw-random-walk:0.001", "yaw_random_walk_rad = 0.001: the report has 0.0005"),
        ("random-walk+tilt", "tilt_rad = 0.0174533: the report has none"),
        ("random-walk+constant-drift", "the report has one or the other"),
    ],
)
def test_the_seed_report_has_only_the_report_s_levels(noise, says):
    refused = (
        lambda: ExperimentSettings.preset(noise=noise, seed="report"),
        lambda: drift_errors(np.arange(3) / 125, Noise.parse(noise), "report"),
    )
    for call in refused:
        with pytest.raises(InputError, match=says) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_flight_determines_its_tower_and_duration():
    for name in TRAJECTORIES:
        own = name in ("vertical", "orbit", "orbit-3.3")
        settings = ExperimentSettings.preset(name)
        assert settings.tower == TowerSettings.preset("report" if own else "tapered")
        assert settings.flight.duration_s == {"vertical": 408, "orbit": 549.5, "orbit-3.3": 208.5}.get(name, 200)
        assert ExperimentSettings.preset(name, duration_s=30.0).flight.duration_s == 30


def test_the_experiment_behind_each_plot_of_the_report_has_its_scans():
    for plot in read_report_plots():
        settings = ExperimentSettings.report(plot.figure, plot.trajectory, plot.method, run=plot.run)
        steps = scan_steps(settings.tof, settings.flight.duration_s, 0.008)
        flown = steps[steps < round(settings.flight.duration_s / 0.008)]
        np.testing.assert_array_equal(flown[-plot.samples :], plot.steps)
        kept_its_map = plot.method == "average" or len(plot.broken_off_s) > 0
        assert len(flown) == plot.samples + (not kept_its_map), "the first scan is the map"
    other = ExperimentSettings.report("3.5", "vertical", "gicp", "best", {"tof.range_max_m": 3.0})
    assert (other.odometry.method, other.tof.range_max_m, other.tof.sigma_floor_m) == ("best", 3.0, 0.01)
    with pytest.raises(InputError, match=r"plot 3\.4 vertical icp: expected one of 3\.2 vertical average;"):
        ExperimentSettings.report("3.4", "vertical", "icp")


def test_related_settings_are_changed_together_whatever_their_order():
    plain = ExperimentSettings.preset("zigzag", duration_s=5.0)
    for changes in ({"tof.start_s": 8.0, "flight.duration_s": 9.0}, {"flight.duration_s": 9.0, "tof.start_s": 8.0}):
        changed = plain.override(changes)
        assert (changed.tof.start_s, changed.flight.duration_s) == (8.0, 9.0)


def test_a_preset_can_be_copied_changed_and_named_by_its_path(tmp_path):
    own = tmp_path / "mine.toml"
    text = (PRESETS / "sensors" / "starling2.toml").read_text()
    own.write_text(text.replace("range_max_m = 6.0", "range_max_m = 5.0").replace("crop_m = 6.0", "crop_m = 5.0"))
    settings = ExperimentSettings.preset(sensor=str(own), method="least_squares_yaw")
    assert (settings.tof.range_max_m, settings.odometry.preprocess.crop_m) == (5.0, 5.0)
    assert settings.odometry.robust_scale_m == 0.03
    own.write_text('based_on = "starling2-honest"\n[tof]\nfaults = ["exposure"]\n')
    honest = ExperimentSettings.preset(sensor="starling2-honest", overrides={"tof.faults": ["exposure"]})
    assert ExperimentSettings.preset(sensor=str(own)).replace(sensor=honest.sensor) == honest
    own.write_text('based_on = "lidar"\n')
    with pytest.raises(InputError, match="based_on = 'lidar': expected one of 'report', 'report-4cm', 'starling2'"):
        ExperimentSettings.preset(sensor=str(own))
    own.write_text("[hough]\ndxm = 1.0\n")
    with pytest.raises(InputError, match="dxm"):
        ExperimentSettings.preset(sensor=str(own), method="average")


@pytest.mark.parametrize("method", {OdometrySettings.preset(name).family: name for name in METHODS}.values())
def test_a_method_of_another_family_has_no_setting_of_this_one(method):
    experiment = ExperimentSettings.preset(method=method)
    settings = experiment.odometry
    own = set(type(settings).model_fields)
    assert set(experiment.model_dump()["odometry"]) == own
    known = set().union(*(kind.model_fields for kind in FAMILIES.values()))
    assert known - own
    for name in known - own:
        with pytest.raises(InputError, match=f"{name} = 1: unknown.* the family '{settings.family}' has method, pre"):
            experiment.override({name: 1})


def test_overrides_name_a_setting_of_the_world_or_of_the_odometry():
    plain = ExperimentSettings.preset("loops", method="faces", sensor="report-4cm")
    changed = plain.override({"tof.rate_hz": 10, "odometry.sigma_filter_px": 2, "preprocess.crop_m": 3})
    assert (changed.tof.rate_hz, changed.odometry.sigma_filter_px, changed.odometry.preprocess.crop_m) == (10, 2, 3)
    assert changed.override({"tof.rate_hz": 5.0, "sigma_filter_px": 1, "preprocess.crop_m": 4.0}) == plain
    with pytest.raises(InputError, match=r"dofs = 'xyz': unknown setting, did you mean 'dof'.*family 'faces' has meth"):
        plain.override({"dofs": "xyz"})


def test_the_mount_of_the_sensor_turns_about_fixed_axes():
    turned = TofSettings(mount_m=(0.1, 0.2, 0.3), mount_rpy_deg=(0.0, 0.0, 90.0)).T_drone_sensor
    np.testing.assert_allclose(turned @ [1, 0, 0, 1], [0.1, 1.2, 0.3, 1], atol=1e-12)


def test_sections_that_are_not_given_are_the_usual_ones():
    sections_m = TowerSettings(sections_m={"leg": (0.2, 0.01)}).sections_m
    assert sections_m == TowerSettings().sections_m | {"leg": (0.2, 0.01)}
    with pytest.raises(InputError, match=r"mast\.\[key\] = 'mast'"):
        TowerSettings(sections_m={"mast": (0.2, 0.01)})


def test_an_honest_sensor_is_the_ideal_one_with_faults_and_an_imu():
    sensors = "starling2", "starling2-honest"
    ideal, honest = (ExperimentSettings.preset(sensor=name, method="best") for name in sensors)
    assert ideal.tof.faults == ()
    assert ideal.imu is None
    sigmas = {"tof.range_scale_sigma": 0.0, "tof.range_offset_sigma_m": 0.0}
    told = {"sigma_filter_px": 0, **sigmas}  # all that an estimator is told: no fault, and what a data sheet allows
    assert (honest.flight.still_s, ideal.flight.still_s) == (REST_S, 0.0)
    honest = honest.override({"flight.still_s": 0.0})
    assert honest.override({"tof.faults": [], "imu": None, **told}).replace(sensor="starling2") == ideal
    assert set(honest.tof.faults) == set(get_args(TofFault)) - {"mount", "latency"}  # only if they are named
    assert all(value > 0 for value in vars(honest.imu).values())


def test_a_method_inherits_the_sensor_s_additions_to_its_base():
    faces, smoothed = (OdometrySettings.preset(method, "report") for method in ("faces", "smoothed"))
    assert smoothed == faces.model_copy(update={"method": "smoothed", "smooth": True})
    assert faces.robust_scale == OdometrySettings.preset("best", "report").robust_scale == 100.0


def test_methods_by_front_faces_use_the_imu_beside_a_sensor():
    assert OdometrySettings.preset("smoothed").inertial is None
    for method, uses in (("faces", True), ("smoothed", True), ("best", False), ("average", False)):
        honest = ExperimentSettings.preset(sensor="starling2-honest", method=method)
        assert getattr(honest.odometry, "inertial", None) == (honest.imu if uses else None)
    off = OdometrySettings.preset("faces", "starling2-honest", {"inertial": False})
    assert off == OdometrySettings.preset("faces", "starling2-honest", {"inertial": None})
    assert off.inertial is None
    noise = {"gyro_noise": 1e-4, "accelerometer_noise": 1e-3}
    for method, inertial, says in (
        ("least_squares_yaw", noise, "inertial = .*unknown setting.*'segments'"),
        ("faces", {"gyro_noise": 1e-4}, "an IMU without noise"),
        ("faces", True, "inertial"),
    ):
        with pytest.raises(InputError, match=says):
            OdometrySettings.preset(method, overrides={"inertial": inertial})


def test_a_tower_is_named_by_an_argument_or_an_override() -> None:
    heavy = TowerSettings.preset("heavy")
    assert ExperimentSettings.preset("loops", tower="heavy").tower == heavy
    both = ExperimentSettings.preset("loops", overrides={"tower.section": "round", "tower": "heavy"})
    assert both.tower == heavy.replace(section="round")


@pytest.mark.parametrize(
    ("name", "usual", "setting", "other"),
    [
        ("seed", 1, "seed", 7),
        ("noise", "random-walk", "noise_name", "tilt"),
        ("trajectory", "zigzag", "flight.trajectory", "loops"),
    ],
)
def test_an_override_wins_unless_the_argument_is_given_even_as_usual(name, usual, setting, other):
    plain, changed = ExperimentSettings.preset(), ExperimentSettings.preset(overrides={setting: other})
    assert plain == ExperimentSettings.preset(**{name: usual}) != changed
    assert changed == plain.override({setting: other})
    with pytest.raises(InputError, match=f"{name} = {usual!r}"):
        ExperimentSettings.preset(**{name: usual}, overrides={setting: other})


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("rate_hz = 9.0", "rate_hz = 9.0: unknown setting, did you mean 'tof.rate_hz'"),
        ("[toff]\ncolumns = 9", "toff = .*: unknown setting"),
        ("[preprocess]\ncrop_m = 3.3", "crop_m = 3.3: unknown setting, did you mean '(clouds|segments).crop_m'"),
        ("[flight]\nstandoff_m = 3.0", "flight = {'standoff_m': 3.0}: unknown setting"),
        ("[methods.bset]\ndof = 'xyz'", "method = 'bset', did you mean 'best'"),
        ("[methods.best]\ndofs = 'xyz'", "dofs = 'xyz'.*mean 'dof'"),
        ("[methods.best]\nbased_on = 'faces'", "methods.best: .*based_on"),
        ("[methods.best]\nfamily = 'faces'", "methods.best: .*family"),
        ("[hough]\ndx = 4", "HoughSettings: dx = 4: unknown setting, did you mean 'dx_m'"),
        ("[preprocess.segments]\ncrop_m = '4'", "PreprocessSettings: crop_m = '4'"),
        ("[[tof]]\nrate_hz = 9.0", "tof = .*: expected a table"),
        ("imu = true", "imu = True: expected a table"),
        ("methods.best = 3", "methods.best = 3: expected a table"),
    ],
)
def test_a_sensors_file_is_checked_whatever_the_method(tmp_path, text, names):
    (tmp_path / "mine.toml").write_text(f'based_on = "report"\n{text}\n')
    with pytest.raises(InputError, match=f"mine.toml: .*{names}") as caught:
        OdometrySettings.preset("loam", sensor=tmp_path / "mine.toml")
    assert "\n" not in str(caught.value)


def test_a_sensors_file_may_have_no_imu_and_own_segments_of_a_method(tmp_path):
    own = tmp_path / "mine.toml"
    own.write_text('based_on = "starling2-honest"\nimu = false\n[methods.average.hough]\ndx_m = 0.5\n')
    settings = ExperimentSettings.preset(sensor=own, method="faces")
    assert settings.imu is settings.odometry.inertial is None
    assert settings == ExperimentSettings.preset(sensor=str(own), method="faces")
    assert [OdometrySettings.preset(method, own).hough.dx_m for method in ("average", "none")] == [0.5, 0.07]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_a_sensors_file_is_in_utf_8_with_or_without_a_byte_order_mark(tmp_path, encoding):
    (tmp_path / "mine.toml").write_text("[tof]  # für drinnen\nrate_hz = 3.0\n", encoding=encoding)
    if encoding == "utf-8-sig":
        assert TofSettings.preset(tmp_path / "mine.toml").rate_hz == 3.0
    else:
        with pytest.raises(InputError, match=r"mine\.toml: text that is not UTF-8; expected .*, saved as UTF-8"):
            TofSettings.preset(tmp_path / "mine.toml")


def test_a_rate_of_scans_that_the_reports_plot_has_is_refused():
    with pytest.raises(InputError, match=r"tof.rate_hz = 10.0: the scans are those of the report's plot; leave it out"):
        ExperimentSettings.report("3.5", "vertical", "gicp", overrides={"tof.rate_hz": 10.0})
    own = ExperimentSettings.report("3.5", "vertical", "gicp", overrides={"tof": {"rate_hz": 10.0, "samples": []}})
    assert own.tof.rate_hz == 10.0


def test_options_of_a_recording_stand_beside_it(tmp_path):
    assert read_options(tmp_path) == read_options(tmp_path, unit=None) == RecordingOptions()
    (tmp_path / "recording.toml").write_text('unit = "mm"\ncolumns = ["t", "x", "y", "z"]\ntime_offset = -18\n')
    beside = read_options(tmp_path)
    assert (beside.unit_m, beside.columns, beside.time_offset) == (1e-3, ("t", "x", "y", "z"), -18.0)
    assert read_options(tmp_path, unit="ft") == beside.replace(unit="ft")


@pytest.mark.parametrize("line", ['units = "mm"', 'unit = "mmm"', "time_offset = true", "mount = [1, 2]", "range = -1"])
def test_wrong_key_of_a_recording_names_its_file(tmp_path, line):
    (tmp_path / "recording.toml").write_text(line)
    with pytest.raises(InputError, match=f"recording.toml.*{line.split()[0]}"):
        read_options(tmp_path)
