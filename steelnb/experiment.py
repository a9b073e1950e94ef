"""The whole method on one page: world → flight → drift → odometry → numbers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, Flight, Segments, Trajectory
from steelnb.metrics import score_gaps, score_segments, score_trajectory
from steelnb.noise import drifting
from steelnb.odometry import make_odometry
from steelnb.simulation import Truth, build_tower, fly, scan_flight

Progress = Callable[[float], None]
T_DRONE_SENSOR = np.array([[1, 0, 0, 0.06], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
"""The sensor looks forward from the front of the body."""


@dataclass(frozen=True)
class Result:
    """One run: settings, truth, the drifting prior and the corrected trajectory at the scan stamps, the map as bars
    and as points, how many pairs each scan was corrected by, how long each stage took on each scan, and the numbers."""

    settings: ExperimentSettings
    truth: Truth
    prior: Trajectory
    corrected: Trajectory
    segments: Segments
    points: Array
    matches: Array
    seconds: dict[str, Array]
    metrics: dict[str, float]


def run(settings: ExperimentSettings, on_progress: Progress | None = None) -> Result:
    """Simulate a flight, let its pose drift, correct it scan by scan, and compare with the truth."""
    flight, truth = simulate(settings)
    return estimate(settings, flight, truth, on_progress)


def simulate(settings: ExperimentSettings) -> tuple[Flight, Truth]:
    """The flight as an estimator sees it, and the truth apart. Raises `CollisionError`."""
    tower = build_tower(settings.tower)
    trajectory, imu = fly(tower, settings.flight, settings.seed)
    scans, hits = scan_flight(tower, trajectory, T_DRONE_SENSOR, settings.tof, settings.seed)
    prior = drifting(trajectory, settings.noise, settings.seed).at(scans.stamp_s)
    return Flight(scans, prior, imu, T_DRONE_SENSOR), Truth(trajectory, tower, hits)


def redrift(settings: ExperimentSettings, flight: Flight, truth: Truth) -> Flight:
    """The same flight and scans under the noise of other settings: what a comparison of noises needs."""
    prior = drifting(truth.trajectory, settings.noise, settings.seed).at(flight.prior.stamp_s)
    return Flight(flight.scans, prior, flight.imu, flight.T_drone_sensor)


def estimate(settings: ExperimentSettings, flight: Flight, truth: Truth, on_progress: Progress | None = None) -> Result:
    """Run the odometry over a flight, then judge it. The odometry gets the flight only."""
    odometry = make_odometry(settings, flight.T_drone_sensor)
    steps = []
    for k, (scan, T_world_drone_prior) in enumerate(zip(flight.scans, flight.prior.T_world_drone, strict=True)):
        steps.append(odometry.update(scan, T_world_drone_prior))
        if on_progress:
            on_progress((k + 1) / len(flight.scans))
    corrected = Trajectory(flight.prior.stamp_s, np.array([step.T_world_drone for step in steps]))
    segments = odometry.map_segments()
    return Result(
        settings=settings,
        truth=truth,
        prior=flight.prior,
        corrected=corrected,
        segments=segments,
        points=odometry.map_points(),
        matches=np.array([step.matches for step in steps]),
        seconds={stage: np.array([step.seconds[stage] for step in steps]) for stage in steps[0].seconds},
        metrics=measure(settings, flight.prior, corrected, segments, truth),
    )


def measure(
    settings: ExperimentSettings, prior: Trajectory, corrected: Trajectory, segments: Segments, truth: Truth
) -> dict[str, float]:
    """The numbers of a run; lengths in metres, angles in degrees."""
    raw = score_trajectory(prior, truth.trajectory)
    numbers = {
        "raw_ate_rmse_m": raw["ate_rmse_m"],
        "raw_error_final_m": raw["error_final_m"],
        **score_trajectory(corrected, truth.trajectory),
    }
    if settings.tof.blind_s:
        numbers |= score_gaps(corrected, truth.trajectory, settings.tof.blind_s)
    if len(segments):
        score = score_segments(segments, truth.tower.axes, observed=truth.member_hits >= 100)
        numbers |= {
            "segments": float(len(segments)),
            "segment_recall": score.recall,
            "segment_precision": score.precision,
            "segment_angle_median_deg": float(np.degrees(score.angle_median_rad)),
            "segment_offset_median_m": score.offset_median_m,
        }
    return numbers
