"""Notebook 15: the faults of a real Time-of-Flight camera and of an IMU, each alone."""

from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.report.study_runs import OURS, whole_flights
from steelnb.report.style import BLACK, GREY, ORANGE, Figure, gather_legend, style
from steelnb.settings import ExperimentSettings, ImuSettings, TofFault, TrajectoryName
from steelnb.simulation import measured_imu
from steelnb.types import Array, Imu, RangeScans

WHITE = {"tof.sigma_floor_m": 0.0, "tof.sigma_relative": 0.0}
"""Overrides that take the range noise away."""
IDEAL, HONEST = "starling2", "starling2-honest"
BEFORE = "clouds.sigma_filter_px=0, inertial=False"
"""Variant of a study's run with the honest sensor and the settings that methods have for the ideal one."""
CASES = {(IDEAL, ""): "ideal", (HONEST, BEFORE): "honest, ideal's settings", (HONEST, ""): "honest"}
"""Sensor and variant of the runs compared, and what to call them."""
FAULTS: dict[str, TofFault] = {
    "footprint: mixed pixels": "footprint",
    "exposure during motion": "exposure",
    "multipath": "multipath",
    "wiggling": "wiggle",
    "offset and scale of a camera": "calibration",
}
"""Faults that bias a range; range noise is left out beside one of them."""
NOISE, AMPLITUDE, ALL = "range noise of the data sheet", "noise by amplitude, dropout", "all together"
FAR_M = 0.05
GROUND_M = 0.1
ERROR_MAX_MM = 60.0
IMU_S, IMU_HZ = 3600.0, 125.0


def range_errors(trajectory: TrajectoryName, seed: int, duration_s: float) -> dict[str, Array]:
    """Name of a fault → range errors ``(K, H, W)`` of a flight's scans on steel, metres: NaN where there is none,
    infinite where a return was lost. `NOISE` alone is what the ideal sensor has, `ALL` what the honest one has."""
    exact, height_m = _ranges(trajectory, IDEAL, seed, duration_s, WHITE)
    exact = np.where(height_m > GROUND_M, exact, np.nan)
    flown: dict[str, tuple[str, dict[str, Any]]] = {NOISE: (IDEAL, {})}
    flown[AMPLITUDE] = HONEST, {"tof.faults": ["amplitude"]}
    for name, fault in FAULTS.items():
        flown[name] = HONEST, {"tof.faults": [fault], **WHITE}
    flown[ALL] = HONEST, {}
    found = {}
    for name, (sensor, overrides) in flown.items():
        error_m = _ranges(trajectory, sensor, seed, duration_s, overrides)[0] - exact
        found[name] = np.where(np.isfinite(exact) & ~np.isfinite(error_m), np.inf, error_m)
    return found


def _ranges(
    trajectory: TrajectoryName, sensor: str, seed: int, duration_s: float, overrides: dict[str, Any]
) -> tuple[Array, Array]:
    """The range images of a flight and the heights of their points above the ground, ``(K, H, W)`` both, metres."""
    settings = ExperimentSettings.preset(
        trajectory, "none", sensor=sensor, seed=seed, duration_s=duration_s, overrides=overrides
    )
    flight, truth = experiment.simulate(settings)
    scans = flight.scans
    assert isinstance(scans, RangeScans)
    up = (truth.trajectory.at(scans.stamp_s).T_world_drone @ flight.T_drone_sensor)[:, 2]
    range_m = scans.range_m.astype(float)
    return range_m, range_m * np.einsum("kc,hwc->khw", up[:, :3], scans.ray) + up[:, 3, None, None]


def error_table(errors: dict[str, Array]) -> pd.DataFrame:
    """A row a fault of `range_errors`: median and 95th percentile of the size of the error, its mean, and the shares of
    returns that err by more than `FAR_M` and that are lost."""
    rows = []
    for name, error_m in errors.items():
        seen, lost = error_m[np.isfinite(error_m)], int(np.isinf(error_m).sum())
        median, p95 = np.percentile(np.abs(seen), [50, 95])
        rows.append(
            {
                "fault": name, "median_mm": 1e3 * median, "p95_mm": 1e3 * p95, "mean_mm": 1e3 * seen.mean(),
                "far_share": float((np.abs(seen) > FAR_M).mean()), "lost_share": lost / (lost + seen.size),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def allan_deviation(reading: Array, step_s: float, tau_s: Array) -> Array:
    """Overlapping Allan deviation ``(T,)`` of readings ``(N, C)``, of all columns together, for means over ``tau_s``.

    Source: IEEE Std 952-1997, annex C.
    """
    total = np.vstack([np.zeros((1, reading.shape[1])), np.cumsum(reading, axis=0)]) * step_s
    found = []
    for count in np.maximum(1, np.round(np.asarray(tau_s) / step_s).astype(int)):
        step = total[2 * count :] - 2 * total[count:-count] + total[: -2 * count]
        found.append(np.sqrt(0.5 * (step**2).mean()) / (count * step_s))
    return np.array(found)


def imu_table(settings: ImuSettings, seed: int, duration_s: float = IMU_S) -> pd.DataFrame:
    """Allan deviations of simulated readings at rest, ``gyro`` in rad/s and ``accelerometer`` in m/s², beside those of
    the settings: N/√τ of white noise and K·√(τ/3) of the walk of the bias."""
    stamp_s = np.arange(round(duration_s * IMU_HZ)) / IMU_HZ
    at_rest = Imu(stamp_s, np.zeros((len(stamp_s), 3)), np.zeros((len(stamp_s), 3)))
    read = measured_imu(at_rest, settings, seed)
    tau_s = np.unique(np.round(np.geomspace(1, duration_s * IMU_HZ / 10, 30))) / IMU_HZ
    table = {"tau_s": tau_s}
    for name, reading, noise, walk in (
        ("gyro", read.angular_rate, settings.gyro_noise, settings.gyro_walk),
        ("accelerometer", read.specific_force, settings.accelerometer_noise, settings.accelerometer_walk),
    ):
        table[name] = allan_deviation(reading, 1 / IMU_HZ, tau_s)
        table[f"{name}_settings"] = np.sqrt(noise**2 / tau_s + walk**2 * tau_s / 3)
    return pd.DataFrame(table)


def honest_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs of a study under the random walk that are one of `CASES`, as their column ``case`` says, of our own
    methods that flew with the honest sensor; nothing else differs from a preset."""
    flights = sorted(set(runs["trajectory"]))
    found = whole_flights(runs, noise=["random-walk"], trajectory=flights, method=sorted(OURS), sensor=[IDEAL, HONEST])
    cases = [CASES.get(pair, "") for pair in zip(found["sensor"], found["variant"], strict=True)]
    found = found.assign(case=cases)[[case != "" for case in cases]]
    return found[found["method"].isin(found.loc[found["sensor"] == HONEST, "method"])]


@style()
def figure_frame(errors: dict[str, Array], frame: int = -1) -> Figure:
    """Errors of one scan's ranges with the ideal sensor and with the honest one, and their distribution over all scans,
    each fault alone."""
    figure = Figure(figsize=(11.0, 4.6))
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 1.6])
    for panel, name in ((left, NOISE), (middle, ALL)):
        error_mm = 1e3 * np.where(np.isinf(errors[name][frame]), np.nan, errors[name][frame])
        panel.imshow(np.isinf(errors[name][frame]), cmap="Greys", vmin=0, vmax=1.6)
        image = panel.imshow(error_mm, cmap="RdBu_r", vmin=-ERROR_MAX_MM, vmax=ERROR_MAX_MM)
        panel.set(title={NOISE: "ideal", ALL: "honest"}[name], xticks=[], yticks=[])
        panel.grid(visible=False)
    figure.colorbar(image, ax=[left, middle], location="left", label="range error (mm); grey: lost", shrink=0.8)
    share = np.linspace(0, 100, 401)
    lines = [(NOISE, GREY, "--"), (AMPLITUDE, GREY, "-"), (ALL, BLACK, "-")]
    lines += [(name, f"C{k}", "-") for k, name in enumerate(FAULTS)]
    for name, colour, kind in lines:
        size_mm = 1e3 * np.abs(errors[name][np.isfinite(errors[name])])
        right.plot(np.maximum(np.percentile(size_mm, share), 0.1), share, color=colour, ls=kind, label=name)
    right.set(xscale="log", xlabel="size of the range error (mm)", ylabel="share of the returns below (%)")
    right.set(xlim=(0.1, 1000), ylim=(0, 100.5))
    gather_legend(figure, ncols=4, fontsize=10)
    return figure


@style()
def figure_imu(table: pd.DataFrame) -> Figure:
    """Allan deviations of `imu_table`, simulated as dots, of the settings as lines."""
    figure = Figure(figsize=(9.0, 4.0))
    for panel, (name, unit) in zip(figure.subplots(1, 2), (("gyro", "rad/s"), ("accelerometer", "m/s²")), strict=True):
        panel.loglog(table["tau_s"], table[f"{name}_settings"], color=GREY, label="settings: white noise and walk")
        panel.loglog(table["tau_s"], table[name], "o", color=ORANGE, ms=5, label="simulated, at rest")
        panel.set(title=name, xlabel="averaging time τ (s)", ylabel=f"Allan deviation ({unit})")
    gather_legend(figure, ncols=2)
    return figure
