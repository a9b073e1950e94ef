"""`steelnb calibrate`: errors of a sensor from a recorded flight, as a table and as a settings file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from steelnb import odometry
from steelnb.errors import OutputError, RecordingError
from steelnb.io.calibration import SensorCorrection, read_correction, read_settings, write_settings
from steelnb.settings import ExperimentSettings
from steelnb.types import Array, Estimate, Flight, SensorErrors

SHOWN = {"m": (1e3, "mm"), "": (1e2, "%"), "rad": (180 / np.pi, "°"), "s": (1e3, "ms")}
"""Unit → factor and unit in which it is printed."""
TOLD_SHARE = 0.5
"""A flight tells an error if it has left less than this share of its standard deviation before."""


def calibrate(
    flight: Flight,
    output: Path,
    settings: ExperimentSettings,
    *,
    already: Path | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float], None] | None = None,
    on_stage: Callable[[str], None] = lambda _: None,
) -> tuple[str, ...]:
    """Find the errors of the sensor of a flight, write them as a settings file, and return a table of them in words.

    ``settings`` are those of a method with a table ``calibration``; ``already`` is the settings file with which the
    flight was read: the new one replaces it. Raises `OutputError` for a file that exists, and `RecordingError` for a
    flight that cannot be smoothed.
    """
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists already; expected a new name, or --force to overwrite")

    def on_step(k: int, *_: object) -> None:
        if on_progress is not None:
            on_progress((k + 1) / len(flight))
        if k + 1 == len(flight):
            on_stage("adjusting poses, bars and the sensor's errors together")

    on_stage("correcting the poses")
    estimate = odometry.run(
        flight, odometry.make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu), on_step
    )
    errors = found_errors(estimate, flight.name)
    lines = error_lines(errors)
    mount, correction = flight.T_drone_sensor @ errors.T_assumed_true, composed(read_correction(already), errors.value)
    write_settings(
        output, mount, correction, read_settings(already)[1],
        f"Sensor of {flight.name}, calibrated in flight.\n" + "\n".join(lines),
    )  # fmt: skip
    return (*lines, f"written   {output}: steelnb run RECORDING --settings {output}")


def found_errors(estimate: Estimate, name: str) -> SensorErrors:
    """The errors of an estimate. Raises `RecordingError` where there are none, with the reason."""
    if estimate.sensor_errors is None or estimate.unsure:
        reason = estimate.unsmoothed or estimate.unsure or "a method without a table calibration"
        raise RecordingError(f"{name}: not calibrated: {reason}; expected a flight along bars with known sections")
    return estimate.sensor_errors


def composed(before: SensorCorrection, value: Array) -> SensorCorrection:
    """The errors ``before``, without which scans were read, and those found then, together."""
    return SensorCorrection(
        range_offset_m=before.range_offset_m + (1 + before.range_scale) * float(value[0]),
        range_scale=(1 + before.range_scale) * (1 + float(value[1])) - 1,
        time_offset_s=before.time_offset_s + float(value[8]),
    )


def error_lines(errors: SensorErrors) -> tuple[str, ...]:
    """Each error with its standard deviation after the flight and before, and whether the flight tells it."""
    lines = []
    for name, value, sigma, before, unit in zip(
        errors.NAMES, errors.value, errors.sigma, errors.prior_sigma, errors.UNITS, strict=True
    ):
        factor, shown = SHOWN[unit]
        told = "known" if not before else "" if sigma < TOLD_SHARE * before else "not told by this flight"
        number = f"{factor * value:+8.2f} ± {factor * sigma:.2f} {shown} (before: ± {factor * before:.2f})"
        lines.append(f"{name:<13} {number} {told}".rstrip())
    return tuple(lines)
