"""The whole method on one page: world → flight → drift → odometry → numbers."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import cast

from steelnb.core.cache import cached
from steelnb.core.estimates import Estimate
from steelnb.core.types import Flight, Imu, RangeScans, Trajectory
from steelnb.metrics import score_estimate
from steelnb.odometry import correct
from steelnb.planning import OnboardPilot
from steelnb.points.ranges import calibrated
from steelnb.settings import ExperimentSettings, OrbSettings, ReportCloudSettings
from steelnb.settings.report_plots import STEP_S
from steelnb.simulation import (
    FORWARD,
    OnboardSensors,
    Truth,
    Visibility,
    build_tower,
    filtered_attitude,
    fly,
    measured_imu,
    photograph,
    scan_flight,
)
from steelnb.simulation.drift import drifting
from steelnb.simulation.tof import add_noise, noise_free

OnProgress = Callable[[float], None]
BROKEN_OFF_DRAW = 1_000_000
"""Added to the draw of the sensor's noise for a flight that was broken off."""


@dataclass(frozen=True, kw_only=True)
class Result(Estimate):
    """The estimate of one run, with its settings, the truth and the numbers that compare both."""

    settings: ExperimentSettings
    truth: Truth
    metrics: dict[str, float]

    def __repr__(self) -> str:
        numbers = f"{self.metrics['ate_rmse_m']:.4f} m of {self.metrics['raw_ate_rmse_m']:.4f} m left"
        return f"Result({self.settings.odometry.method!r}: {self._summary()}; error {numbers})"


def run(settings: ExperimentSettings, on_progress: OnProgress | None = None) -> Result:
    """Simulate a flight, let its pose drift, correct it scan by scan, and compare with the truth.

    Raises `InputError`."""
    flight, truth = simulate(settings)
    return estimate(settings, flight, truth, on_progress)


def simulate(settings: ExperimentSettings, on_progress: OnProgress | None = None) -> tuple[Flight, Truth]:
    """Simulate a flight as an estimator sees it, and return the truth separately. Raises `CollisionError`.

    The pilot of a planned flight sees no more than that: drifting poses, scans, and the estimate of the settings'
    odometry. Such a simulation takes as long as the odometry, and reports its progress.
    """
    tower, tof = build_tower(settings.tower), settings.tof
    planned = settings.flight.trajectory == "planned"

    def flown() -> tuple[Trajectory, Imu, RangeScans, Visibility]:
        pilot = None
        if planned:
            sensors = OnboardSensors(settings, tower)
            pilot = sensors.steered_by(OnboardPilot(settings, sensors.imu, on_progress))
        trajectory, imu = fly(tower, settings.flight, settings.seed, pilot)
        return trajectory, imu, *scan_flight(tower, trajectory, tof, settings.seed)

    # Only a pilot sees the IMU's readings and the noise; without one, other draws of them need no other flight. The
    # noise of a faulty sensor depends on more than its ranges.
    shares_rays = not planned and not tof.faults
    if shares_rays:
        tof = noise_free(tof)
    key = world(settings if planned else settings.replace(imu=None, tof=tof.uncalibrated()))
    trajectory, exact, scans, visibility = cached(flown, "flight", *key)
    if shares_rays:
        scans = add_noise(scans, settings.tof, settings.seed)
    imu = measured_imu(exact, settings.imu, settings.seed) if settings.imu else exact
    truth = Truth(trajectory, tower, visibility)
    unmoved = Flight(scans, trajectory.at(scans.stamp_s), tof.T_drone_sensor, imu)
    return redrift(settings, unmoved, truth), truth


def world(settings: ExperimentSettings) -> tuple[str, bytes]:
    """All that a simulated flight depends on, as JSON, and the files of its tower. Equal values share one flight."""
    parts = {"tower", "flight", "tof", "imu", "seed"} if settings.flight.trajectory != "planned" else None
    return settings.model_dump_json(include=parts), settings.tower.file_bytes()


def redrift(settings: ExperimentSettings, flight: Flight, truth: Truth) -> Flight:
    """The same flight and scans with the drift of other settings, and with the images that their method needs.

    With an IMU in the settings, roll and pitch come from a filter on its readings. Images are rendered on
    access.
    """
    seen, seed = truth.trajectory, settings.seed
    if settings.imu and flight.imu:
        seen = filtered_attitude(seen, flight.imu)
    path = drifting(seen, settings.noise, seed)
    by_images = isinstance(settings.odometry, OrbSettings)
    images = photograph(truth.tower, truth.trajectory, FORWARD, seed) if by_images else None
    return replace(flight, prior=path.at(flight.prior.stamp_s), path=path, images=images)


def estimate(
    settings: ExperimentSettings, flight: Flight, truth: Truth, on_progress: OnProgress | None = None
) -> Result:
    """Run the odometry on a flight, then score the estimate. The odometry does not see the truth."""
    flight = calibrated(flight, settings.tof)
    on_step = (lambda k, scan, step: on_progress((k + 1) / len(flight))) if on_progress else None
    before = broken_off(settings)
    if isinstance(flight.scans, RangeScans) and flight.images is None:
        path = flight.path if settings.odometry.mount.time_sigma_s else None  # what nobody reads is no key
        given = flight.scans, flight.prior, flight.T_drone_sensor, flight.imu, before and before.scans, path
        key = "estimate", settings.odometry.model_dump_json(), *given, flight.range_sigmas
        found = cached(lambda: correct(flight, settings.odometry, on_step, before=before), *key)
    else:  # images and recorded scans have no fast cache key
        found = correct(flight, settings.odometry, on_step, before=before)
    if on_progress:
        on_progress(1.0)  # a cached estimate reports no steps
    return Result(
        **vars(found), settings=settings, truth=truth, metrics=score_estimate(found, truth, settings.tof.blind_s)
    )


def broken_off(settings: ExperimentSettings) -> Flight | None:
    """The run that was broken off before that of the settings (`ReportCloudSettings`): the drone at rest, every scan
    of the sensor, other noise of the sensor; None if there was none."""
    odometry = settings.odometry
    if not isinstance(odometry, ReportCloudSettings) or not odometry.broken_off_s:
        return None
    first_s, last_s = odometry.broken_off_s
    still = {"tof.samples": (), "tof.start_s": first_s, "flight.duration_s": last_s + STEP_S, "flight.still_s": last_s}
    return simulate(settings.override({**still, "tof.draw": settings.tof.draw + BROKEN_OFF_DRAW}))[0]


def draws(settings: ExperimentSettings, count: int) -> Iterator[tuple[ExperimentSettings, Flight, Truth]]:
    """``count`` draws of the sensor's noise on one flight, with the same drift: settings, flight and truth of each.

    Draw 0 is that of the settings themselves. Rays are cast once. Raises `InputError` for a sensor with faults and for
    a planned flight, whose scans depend on the noise in other ways."""
    settings.check_draws()
    exact, truth = simulate(settings.replace(tof=noise_free(settings.tof)))
    for draw in range(settings.tof.draw, settings.tof.draw + count):
        drawn = settings.override({"tof.draw": draw})
        scans = add_noise(cast("RangeScans", exact.scans), drawn.tof, settings.seed)
        yield drawn, replace(exact, scans=scans), truth
