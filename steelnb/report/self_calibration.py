"""Notebook 15: a sensor that is not what it is taken for, fault by fault, and the errors that smoothing finds."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.fusion.sensor_errors import unknown_errors
from steelnb.metrics import score_trajectory
from steelnb.noise import drifting
from steelnb.odometry import make_odometry, run_kept
from steelnb.odometry.run import smoothed
from steelnb.report.calibration import SHOWN
from steelnb.report.honest import HONEST
from steelnb.report.style import BLACK, COLOURS, GREY, LABELS, VERMILION, Figure, gather_legend, style
from steelnb.rng import Seed, stream
from steelnb.settings import CalibrationSettings, ExperimentSettings, ImuSettings, OdometrySettings, TrajectoryName
from steelnb.simulation import Truth, measured_imu
from steelnb.types import Array, Estimate, Flight, RangeScans, SensorErrors

WITH_IMU = "calibrated, IMU"
METHODS = ("combined", "smoothed", "calibrated", WITH_IMU)
"""The last one has the readings of an IMU, too: that beside `HONEST`."""
DRAWN = "all nine at once, drawn"
TILT = "roll and pitch wander by 1°"
DEGREE = float(np.radians(1))
FAULTS: dict[str, dict[str, float]] = {
    "none": {}, "range × 1.02": {"range scale": 0.02}, "range + 2 cm": {"range offset": 0.02},
    "mount off by 1 cm and 1°": {
        "mount x": 0.01, "mount y": 0.01, "mount z": 0.01, "mount pitch": DEGREE, "mount yaw": DEGREE,
    },
    "stamps late by 48 ms": {"time offset": -0.048}, TILT: {}, DRAWN: {},
}  # fmt: skip
"""Fault → errors of the sensor, in the units of `SensorErrors`, of which no method is told; the mount is off by 1 cm
along each axis and by 1° of pitch and of yaw."""


def errors_of(fault: str, seed: Seed) -> Array:
    """The errors ``(9,)`` of a fault; those of `DRAWN` have the standard deviations that a calibration starts from."""
    if fault == DRAWN:
        sigma = unknown_errors(CalibrationSettings()).prior_sigma
        return sigma * stream(seed, "errors").standard_normal(len(sigma))
    return np.array([FAULTS[fault].get(name, 0.0) for name in SensorErrors.NAMES])


def wrongly_told(settings: ExperimentSettings, flight: Flight, truth: Truth, errors: Array) -> Flight:
    """The flight of a sensor with these errors, ``(9,)``, as an estimator sees it that knows of none; and its IMU's
    readings with the errors of the data sheet."""
    sensor, scans = SensorErrors(errors, np.diag(errors**2), np.abs(errors)), flight.scans
    assert isinstance(scans, RangeScans)
    ranges = (scans.range_m * (1 + errors[1]) + errors[0]).astype(np.float32)
    drifted = drifting(truth.trajectory, settings.noise, settings.seed)
    stamp_s = flight.prior.stamp_s
    prior = drifted.at(stamp_s)
    if errors[8]:
        prior = replace(prior, T_world_drone=drifted.between(stamp_s - errors[8]))
    mount = flight.T_drone_sensor @ np.linalg.inv(sensor.T_assumed_true)
    scans, imu = RangeScans(scans.stamp_s, ranges, scans.ray), flight.imu
    if imu is not None:  # poses and readings have one clock
        read = measured_imu(imu, data_sheet(), settings.seed)
        imu = replace(read, stamp_s=read.stamp_s + errors[8])
    return replace(flight, scans=scans, prior=prior, T_drone_sensor=mount, imu=imu)


def data_sheet() -> ImuSettings:
    """The errors of the IMU beside the honest sensor."""
    sheet = ImuSettings.preset(HONEST)
    assert sheet is not None
    return sheet


def estimates(
    settings: ExperimentSettings, flight: Flight, truth: Truth, errors: Array, tilt_sigma_rad: float = 0.0
) -> dict[str, Estimate]:
    """What `METHODS` make of a flight whose sensor has errors; those that calibrate know how far roll and pitch may be
    off."""
    told, tilted = wrongly_told(settings, flight, truth, errors), {"tilt_sigma_rad": tilt_sigma_rad}
    changed: dict[str, dict[str, Any]] = {
        "calibrated": tilted,
        WITH_IMU: {**tilted, "inertial": data_sheet().model_dump()},
    }
    made = {}
    for method in METHODS:
        preset = "calibrated" if method == WITH_IMU else method
        odometry = OdometrySettings.preset(preset, settings.sensor, changed.get(method))
        made[method] = make_odometry(odometry, told.T_drone_sensor, told.imu)
    online = run_kept(told, made["combined"])
    return {method: smoothed(told, online, odometry) for method, odometry in made.items()}


def fault_runs(
    trajectory: TrajectoryName, seed: int, duration_s: float, on_fault: Callable[[], None] = lambda: None
) -> tuple[pd.DataFrame, dict[str, SensorErrors]]:
    """A row a fault: ATE of each of `METHODS` and of the drift, metres; and by method the errors found where all were
    drawn."""
    rows = []
    usual: dict[str, Any] = {"seed": seed, "duration_s": duration_s, "method": "combined"}
    flight, truth = experiment.simulate(ExperimentSettings.preset(trajectory, "random-walk", **usual))
    for fault in FAULTS:
        noise, tilt_rad = ("random-walk+tilt", DEGREE) if fault == TILT else ("random-walk", 0.0)
        settings = ExperimentSettings.preset(trajectory, noise, **usual)
        found = estimates(settings, flight, truth, errors_of(fault, seed), tilt_rad)
        trajectories = {method: each.corrected for method, each in found.items()} | {"drift": found["combined"].prior}
        ate = {name: score_trajectory(each, truth.trajectory)["ate_rmse_m"] for name, each in trajectories.items()}
        rows.append({"fault": fault, **ate})
        on_fault()
    for method in ("calibrated", WITH_IMU):
        if found[method].sensor_errors is None:
            raise ValueError(f"seed {seed}, {duration_s:g} s: not calibrated: {found[method].unsmoothed}")
    return pd.DataFrame(rows), {method: each.sensor_errors for method, each in found.items() if each.sensor_errors}


def error_table(of: dict[str, SensorErrors], seed: int) -> pd.DataFrame:
    """A row an error that was drawn: the true one, its standard deviation before the flight, and the one found and its
    standard deviation, without an IMU and with it, in the column's ``unit``."""
    found, imu = of["calibrated"], of[WITH_IMU]
    factor = np.array([SHOWN[unit][0] for unit in found.UNITS])
    columns = {
        "true": errors_of(DRAWN, seed), "before": found.prior_sigma, "found": found.value, "sigma": found.sigma,
        "found_imu": imu.value, "sigma_imu": imu.sigma,
    }  # fmt: skip
    table = pd.DataFrame({name: column * factor for name, column in columns.items()})
    table.insert(0, "error", found.NAMES)
    return table.assign(unit=[SHOWN[unit][1] for unit in found.UNITS])


@style()
def figure_calibration(runs: pd.DataFrame, errors: pd.DataFrame) -> Figure:
    """ATE by fault and method; and the nine errors drawn at once, true and found, over their σ before the flight."""
    figure = Figure(figsize=(11.0, 4.6))
    left, right = figure.subplots(1, 2, width_ratios=[1.2, 1.0])
    at = np.arange(len(runs))[::-1]
    for k, method in enumerate(METHODS):
        preset, _, imu = method.partition(",")
        look = {
            "color": COLOURS[preset],
            "label": LABELS[preset] + (", IMU" if imu else ""),
            "hatch": "////" if imu else "",
        }
        left.barh(at + 0.2 * (1.5 - k), 1e3 * runs[method], 0.18, ec="white", **look)
    left.plot(1e3 * runs["drift"], at, "|", color=VERMILION, ms=22, mew=1.5, label=LABELS["none"])
    left.set_yticks(at, runs["fault"])
    left.set(xlabel="ATE, root mean square (mm)", xlim=(0, None))
    left.grid(axis="y", visible=False)
    at, before = np.arange(len(errors))[::-1], errors["before"]
    right.axvspan(-1, 1, color="#eeeeee", lw=0, label="one σ before the flight")
    for shift, column, face, label in ((0.15, "", "white", "found, ± 2 σ"), (-0.15, "_imu", None, "with the IMU")):
        found, sigma = errors[f"found{column}"] / before, errors[f"sigma{column}"] / before
        right.errorbar(found, at + shift, xerr=2 * sigma, fmt="o", ms=5, mfc=face, capsize=3,
                       color=COLOURS["calibrated"], label=label)  # fmt: skip
    right.plot(errors["true"] / before, at, "x", color=BLACK, ms=7, mew=1.5, label="true")
    right.axvline(0, color=GREY, lw=0.8)
    named = zip(errors["error"], before.round(1), errors["unit"], strict=True)
    right.set_yticks(at, [f"{name} (σ {sigma:g} {unit})" for name, sigma, unit in named])
    right.set(xlabel="error of the sensor (σ before the flight)")
    right.grid(axis="y", visible=False)
    gather_legend(figure, ncols=4)
    return figure
