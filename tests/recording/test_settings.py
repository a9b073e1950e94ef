"""`recording_settings`: the preset, then what follows from the first scans, then what is given."""

from dataclasses import replace

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.recording.settings import LENGTHS, Scene, recording_settings
from steelnb.settings import METHODS, ExperimentSettings
from steelnb.settings.stages import NO_FLOOR_M


def made(points, height_m: float = 2.0, scans: int = 3) -> Flight:
    """Scans of the same points ``(N, 3)`` at a height above the world's zero."""
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, 2, 3] = height_m
    stamp_s = 0.2 * np.arange(scans)
    return Flight([Scan(float(s), np.asarray(points)) for s in stamp_s], Trajectory(stamp_s, T), np.eye(4))


def shell(radius_m: float, count: int = 2000) -> np.ndarray:
    """Points all around the sensor, at evenly distributed distances up to a radius."""
    random = np.random.default_rng(1)
    direction = random.standard_normal((count, 3))
    return direction / np.linalg.norm(direction, axis=1)[:, None] * np.linspace(0.01, radius_m, count)[:, None]


@pytest.mark.parametrize(
    ("trajectory", "sensor"), [("zigzag", "starling2"), ("loops", "report-4cm"), ("loops", "starling2-honest")]
)
def test_before_the_tower_all_settings_are_the_presets(trajectory, sensor):
    made = {"sensor": sensor, "seed": 12, "duration_s": 3.2, "overrides": {"tof.columns": 90, "tof.rows": 120}}
    flight, _ = experiment.simulate(ExperimentSettings.preset(trajectory, "random-walk+tilt", **made))
    for method in ("best", "faces", "least_squares"):
        assert recording_settings(method, sensor, scene=Scene.of(flight)) == recording_settings(method, sensor)


@pytest.mark.parametrize("method", METHODS)
def test_in_a_larger_scene_all_lengths_are_in_proportion(method):
    flight = made(shell(40.0), height_m=100.0)
    before, after = (
        recording_settings(method, **given)[0].odometry.model_dump() for given in ({}, {"scene": Scene.of(flight)})
    )
    scale = Scene.of(flight).median_m / 3.0
    assert scale == pytest.approx(6.67, rel=0.01)
    assert after["preprocess"].pop("crop_m") == pytest.approx(39.6, rel=0.01)
    for table, values in before.items():
        for name, value in values.items() if isinstance(values, dict) else [("", values)]:
            if name == "crop_m":
                continue
            found = after[table][name] if name else after[table]
            power = LENGTHS.get(f"{table}.{name}" if name else table, 0)
            assert found == (pytest.approx(value * scale**power, rel=0.01) if power else value), (table, name)


def test_far_points_alone_widen_the_crop_alone():
    near, far = shell(4.0), 10 * shell(4.0, 40)
    changed = Scene.of(made(np.concatenate([near, far]), height_m=100.0)).overrides(ExperimentSettings.preset())
    assert list(changed) == ["preprocess.crop_m"]
    assert 10 < changed["preprocess.crop_m"] < 40


def test_voxels_leave_enough_points():
    bar = np.column_stack([np.full(4000, 12.0), np.zeros(4000), np.linspace(0, 60, 4000)])  # 1200 voxels of 5 cm
    assert list(Scene.of(made(bar, height_m=100.0)).overrides(ExperimentSettings.preset())) == ["preprocess.crop_m"]
    wall = bar[:, None] + np.array([[0.0, 0.1 * k, 0.0] for k in range(20)])
    changed = Scene.of(made(wall, height_m=100.0)).overrides(ExperimentSettings.preset())
    assert changed["preprocess.voxel_leaf_m"] > 0.2


def test_there_is_no_floor_where_points_lie_below_the_worlds_zero():
    ground = np.column_stack([np.linspace(0, 3, 500), np.zeros(500), np.full(500, -2.0)])
    for height_m, expected in ((2.0, 0.3), (1.8, 0.3), (1.6, NO_FLOOR_M), (0.0, NO_FLOOR_M)):
        settings, structure = recording_settings(scene=Scene.of(made(ground, height_m)))
        assert settings.odometry.preprocess.floor_m == expected
        assert structure.floor_m == (expected if expected < 0 else 0.2)
    ground[:4, 2] = -5.0  # false returns
    assert recording_settings(scene=Scene.of(made(ground)))[0].odometry.preprocess.floor_m == 0.3


def test_what_is_given_comes_first():
    flight = made(shell(40.0), height_m=0.0)
    settings, structure = recording_settings(
        scene=Scene.of(flight), range_max_m=20.0, overrides={"preprocess.voxel_leaf_m": 0.1, "preprocess.floor_m": -3.0}
    )
    seen = settings.odometry.preprocess
    assert (seen.crop_m, seen.floor_m, seen.voxel_leaf_m) == (20.0, -3.0, 0.1)
    assert (structure.range_max_m, structure.floor_m) == (20.0, -3.0)
    assert settings.odometry.map_voxel_m == pytest.approx(0.667, rel=0.01)


def test_missing_returns_and_other_mounts_are_understood():
    points = shell(40.0)
    points[::2] = np.nan
    points[1::4] = 0.0
    flight = made(points, height_m=100.0)
    assert Scene.of(flight).range_m == pytest.approx(39.6, rel=0.01)
    turned = np.diag([1.0, -1.0, -1.0, 1.0])  # upside down
    below = np.tile([1.0, 0.0, -3.0], (100, 1))
    assert Scene.of(made(below)).underground == 1.0
    assert Scene.of(replace(made(below), T_drone_sensor=turned)).underground == 0.0


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.full((4, 5, 3), np.nan), np.zeros((7, 3)), shell(0.5), shell(7.0)]
)
def test_without_a_return_and_in_a_scene_no_larger_than_the_presets_the_preset_stays(points):
    assert recording_settings(scene=Scene.of(made(points, height_m=100.0))) == recording_settings()


@pytest.mark.parametrize(
    ("name", "value"),
    [("tof.rate_hz", 3.0), ("flight.gust_sigma_m_s", 0.1), ("seed", 3), ("tower", "heavy"), ("imu", None)],
)
def test_settings_of_the_simulation_are_refused_since_they_would_change_nothing(name, value):
    with pytest.raises(InputError, match=f"^{name}"):
        recording_settings("faces", overrides={name: value})


def test_a_calibration_is_taken():
    settings, _ = recording_settings("faces", overrides={"tof.range_scale": 1.003, "tof.range_offset_m": 0.004})
    assert (settings.tof.range_scale, settings.tof.range_offset_m) == (1.003, 0.004)
