import pytest
from pydantic import ValidationError

from steelnb.config import ExperimentSettings, FlightSettings, NoiseSettings, TofSettings, TowerSettings
from steelnb.errors import SettingsError


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"trajectory": "spiral"}, "trajectory = 'spiral'.*'vertical', 'orbit'"),
        ({"sensor": "lidar"}, "sensor = 'lidar'"),
        ({"correction": "mean"}, "correction = 'mean'"),
        ({"noise": "white"}, "unknown noise 'white'"),
        ({"noise": "random-walk:-0.002"}, "random_walk_m = -0.002"),
        ({"noise": "random-walk:fast"}, "'fast' is not a number"),
        ({"noise": "random-walk:nan"}, "random_walk_m"),
        ({"noise": "random-walk+random-walk"}, "twice"),
        ({"noise": 0.002}, "noise = 0.002"),
        ({"seed": -1}, "seed = -1"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"seed": "1"}, "seed = '1'"),
        ({"duration_s": 0.0}, "duration_s = 0.0"),
        ({"duration_s": "200"}, "duration_s = '200'"),
        ({"overrides": {"tof.rate_hz": 0}}, "rate_hz = 0"),
        ({"overrides": {"tof.rate": 5}}, "tof.rate"),
        ({"overrides": {"radar.rate_hz": 5}}, "radar.rate_hz"),
        ({"overrides": {"tof.columns": True}}, "columns = True"),
        ({"overrides": {"tower.arm_reach_m": [3.0]}}, "same length"),
    ],
)
def test_a_bad_setting_is_named_in_one_line(arguments, says):
    with pytest.raises(SettingsError, match=says) as caught:
        ExperimentSettings.preset(**arguments)
    assert "\n" not in str(caught.value)


def test_settings_are_frozen_and_know_no_other_key():
    with pytest.raises(ValidationError):
        TofSettings().rate_hz = 10.0
    with pytest.raises(SettingsError, match="rate = 5"):
        TofSettings(rate=5)
    with pytest.raises(SettingsError, match="columns"):
        TofSettings().but(columns=0)


def test_overrides_change_one_setting_and_keep_the_rest():
    plain = ExperimentSettings.preset("orbit", sensor="report")
    changed = ExperimentSettings.preset("orbit", sensor="report", overrides={"tof.rate_hz": 10})
    assert changed.tof.rate_hz == 10
    assert changed.override({"tof.rate_hz": 5.0}) == plain


def test_the_report_preset_holds_the_published_settings():
    report = ExperimentSettings.preset(sensor="report", noise="random-walk", correction="average")
    assert (report.tof.columns, report.tof.rows, report.tof.fov_horizontal_rad) == (64, 64, 2.04)
    assert (report.tof.range_min_m, report.tof.range_max_m, report.tof.sigma_floor_m) == (0.1, 4.0, 0.04)
    assert (report.preprocess.x_max_m, report.preprocess.floor_m, report.preprocess.voxel_leaf_m) == (1.5, 0.3, 0.033)
    assert (report.hough.min_votes, report.hough.max_lines, report.hough.granularity) == (12, 10, 6)
    assert report.hough.dx_m == pytest.approx(0.0572, abs=1e-4)
    assert report.fusion.distance_max_m == pytest.approx(0.2286, abs=1e-4)
    assert (report.noise.random_walk_m, report.odometry.gain) == (0.002, 0.5)


def test_noise_is_read_as_sums_with_levels():
    noise = NoiseSettings.parse("random-walk:0.004+yaw-random-walk")
    assert (noise.random_walk_m, noise.yaw_random_walk_rad, noise.constant_drift_m) == (0.004, 0.0005, 0.0)
    assert NoiseSettings.parse("none") == NoiseSettings()
    assert NoiseSettings.parse("constant-drift-per-axis").constant_drift_per_axis


def test_a_tower_that_cannot_stand_is_refused():
    with pytest.raises(SettingsError, match="waist_height_m"):
        TowerSettings(waist_height_m=20.0)
    with pytest.raises(SettingsError, match="apart"):
        TowerSettings(arm_height_m=(10.0, 10.3), arm_reach_m=(3.0, 3.0))
    with pytest.raises(SettingsError, match="between"):
        TowerSettings(arm_height_m=(15.8,), arm_reach_m=(3.0,))


def test_presets_of_flights_differ():
    assert FlightSettings.preset("orbit").height_max_m == 7.0
    assert FlightSettings.preset("vertical").height_max_m == 15.0
