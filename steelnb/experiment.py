"""The whole method on one page: world → flight → drift → odometry → numbers."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from steelnb.closed_loop import OnboardPilot
from steelnb.images import CameraImages
from steelnb.metrics import score_gaps, score_segments, score_trajectory
from steelnb.noise import drifting
from steelnb.odometry import make_odometry, run_kept
from steelnb.settings import ExperimentSettings, OrbSettings
from steelnb.simulation import (
    FORWARD,
    CastScans,
    Tower,
    Truth,
    build_tower,
    filtered_attitude,
    fly,
    fly_and_scan,
    measured_imu,
    photograph,
)
from steelnb.types import Array, Estimate, Flight, Imu, Trajectory

Progress = Callable[[float], None]


@dataclass(frozen=True, kw_only=True)
class Result(Estimate):
    """The estimate of one run, with its settings, the truth and the numbers that compare both."""

    settings: ExperimentSettings
    truth: Truth
    metrics: dict[str, float]


def run(settings: ExperimentSettings, on_progress: Progress | None = None) -> Result:
    """Simulate a flight, let its pose drift, correct it scan by scan, and compare with the truth."""
    flight, truth = simulate(settings)
    return estimate(settings, flight, truth, on_progress)


def simulate(settings: ExperimentSettings, on_progress: Progress | None = None) -> tuple[Flight, Truth]:
    """The flight as an estimator sees it, and the truth apart. Raises `CollisionError`.

    Who steers a planned flight sees no more: drifting poses and scans, and what the settings' odometry makes of them;
    it takes as long as the odometry, and tells how far it has come.
    """
    tower, given = build_tower(settings.tower), (settings.flight, settings.tof, settings.seed)
    steering = pilot(settings, tower, on_progress)
    depends_on = (settings.model_dump(mode="json"), OnboardPilot.__module__) if steering else None
    trajectory, exact, scans, visibility = fly_and_scan(tower, *given, steering, depends_on)
    imu, images = read_imu(settings, exact), take_images(settings, tower, trajectory)
    prior = drift(settings, trajectory, imu, scans.stamp_s)
    flight = Flight(scans, prior, settings.tof.T_drone_sensor, imu, images=images)
    return flight, Truth(trajectory, tower, visibility)


def simulate_anew(
    settings: ExperimentSettings, on_progress: Progress | None = None, steering: OnboardPilot | None = None
) -> tuple[Flight, Trajectory]:
    """The flight of `simulate`, whose scans are cast whenever they are iterated over, and the true trajectory: a flight
    of any length takes no more memory than its poses.

    ``steering`` is the pilot of a planned flight, for who wants to hear of its decisions afterwards; default a new one.
    """
    tower, mount = build_tower(settings.tower), settings.tof.T_drone_sensor
    make = pilot(settings, tower, on_progress)
    trajectory, exact = fly(tower, settings.flight, settings.seed, steering or (make() if make else None))
    scans, imu = CastScans(tower, trajectory, mount, settings.tof, settings.seed), read_imu(settings, exact)
    images = take_images(settings, tower, trajectory)
    return Flight(scans, drift(settings, trajectory, imu, scans.stamp_s), mount, imu, images=images), trajectory


def pilot(
    settings: ExperimentSettings, tower: Tower, on_progress: Progress | None = None
) -> Callable[[], OnboardPilot] | None:
    """Makes the pilot of a planned flight; None for others."""
    return partial(OnboardPilot, settings, tower, on_progress) if settings.flight.trajectory == "planned" else None


def read_imu(settings: ExperimentSettings, exact: Imu) -> Imu:
    """What the IMU reads: the exact values, or with the errors of the settings."""
    return measured_imu(exact, settings.imu, settings.seed) if settings.imu else exact


def take_images(settings: ExperimentSettings, tower: Tower, trajectory: Trajectory) -> CameraImages | None:
    """The images of the forward camera for a method by images, none of which is rendered before it is asked for; None
    for the others."""
    return photograph(tower, trajectory, FORWARD, settings.seed) if isinstance(settings.odometry, OrbSettings) else None


def drift(settings: ExperimentSettings, truth: Trajectory, imu: Imu | None, stamp_s: Array) -> Trajectory:
    """The drifting poses at the scans; with an IMU in the settings, roll and pitch are those of a filter on it."""
    if settings.imu and imu:
        truth = filtered_attitude(truth, imu)
    return drifting(truth, settings.noise, settings.seed).at(stamp_s)


def redrift(settings: ExperimentSettings, flight: Flight, truth: Truth) -> Flight:
    """The same flight and scans under the noise of other settings, and with the images that their method needs: for
    comparisons of noises or methods."""
    prior = drift(settings, truth.trajectory, flight.imu, flight.prior.stamp_s)
    return replace(flight, prior=prior, images=take_images(settings, truth.tower, truth.trajectory))


def estimate(settings: ExperimentSettings, flight: Flight, truth: Truth, on_progress: Progress | None = None) -> Result:
    """Run the odometry over a flight, then judge it. The odometry gets the flight only."""
    on_step = (lambda k, scan, step: on_progress((k + 1) / len(flight))) if on_progress else None
    odometry = make_odometry(settings.odometry, flight.T_drone_sensor, flight.imu, flight.images)
    found = run_kept(flight, odometry, on_step)
    if on_progress:
        on_progress(1.0)  # an estimate that was kept makes no steps
    return Result(**vars(found), settings=settings, truth=truth, metrics=measure(settings, found, truth))


def measure(settings: ExperimentSettings, estimate: Estimate, truth: Truth) -> dict[str, float]:
    """The numbers of a run; lengths in metres, angles in degrees."""
    corrected, segments = estimate.corrected, estimate.segments
    raw = score_trajectory(estimate.prior, truth.trajectory)
    numbers = {
        "raw_ate_rmse_m": raw["ate_rmse_m"],
        "raw_error_final_m": raw["error_final_m"],
        **score_trajectory(corrected, truth.trajectory),
    }
    if settings.tof.blind_s:
        numbers |= score_gaps(corrected, truth.trajectory, settings.tof.blind_s)
    if len(segments):
        score = score_segments(segments, truth.tower.axes, observed=truth.visibility.observed())
        numbers |= {
            "segments": float(len(segments)),
            "segment_recall": score.recall,
            "segment_precision": score.precision,
            "segment_angle_median_deg": float(np.degrees(score.angle_median_rad)),
            "segment_offset_median_m": score.offset_median_m,
        }
    return numbers
