"""`steelnb play`: a recording at the speed of its sensor, what came late, what was dropped, and what that cost."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, Flight, Scan, Trajectory
from steelnb.errors import RecordingError, SettingsError
from steelnb.odometry import make_odometry
from steelnb.recordings.recording import Recording
from steelnb.replay.course import Course, course_of
from steelnb.replay.judge import score
from steelnb.replay.live import Arrivals, Clock, LoneClock, Played, Reader, Ready, WallClock, highest_rate, play
from steelnb.replay.offline import periods, replay, uncounted, warm_up
from steelnb.replay.options import Options

MISSED_MAX = 0.01
SCANS_MIN = 100
"""Fewer could not tell one missed in a hundred."""
ALONE = ", by processor time, as if nothing else ran here"
HELD_BYTES = 512_000_000
"""Of scans that are held in memory while the highest rate is looked for."""

OnTrial = Callable[[float, Played], None]
OnScan = Callable[[int, int], None]


@dataclass(frozen=True)
class PlayReport:
    """How a recording went at ``rate`` times its own speed.

    ``ate_m`` is that of the scans worked on, ``ate_undropped_m`` what it is at the same scans when none is dropped;
    both None where there is no truth.
    """

    rate: float
    played: Played
    ate_m: float | None
    ate_undropped_m: float | None
    summary: tuple[str, ...]


def play_recording(
    recording: Recording,
    rate: float = 1.0,
    options: Options | None = None,
    on_scan: OnScan | None = None,
    alone: bool = False,
) -> PlayReport:
    """Play a recording by the clock. ``on_scan`` is told how many of how many scans are through.

    ``alone``: the time that passes is the processor's (`LoneClock`), and reading takes none. Raises `SettingsError`,
    `RecordingError` and what reading the recording raises.
    """
    options = options or Options()
    if not 0 < rate < math.inf:
        raise SettingsError(f"rate = {rate}: expected a positive number, or max")
    settings = options.settings()
    course = course_of(recording, options.drift, options.seed, options.gap_max_s)
    with uncounted(recording.skipped):
        warm_up(course.flight, settings)
    if alone:
        ready = Ready(course.flight.scans)
        played, poses = played_through(course.flight, settings, rate, ready, LoneClock(), on_scan)
    else:
        clock = WallClock()
        with Reader(course.flight.scans, clock) as reader:
            played, poses = played_through(course.flight, settings, rate, reader, clock, on_scan)
    with uncounted(recording.skipped):
        ate, undropped = _accuracy(course, settings, played, poses)
    summary = _summary(recording, course, options, rate, played, ate, undropped, alone)
    return PlayReport(rate, played, ate, undropped, summary)


def played_through(
    flight: Flight,
    settings: ExperimentSettings,
    rate: float,
    arrivals: Arrivals,
    clock: Clock,
    on_scan: OnScan | None = None,
    total: int | None = None,
) -> tuple[Played, Array]:
    """Play a flight, or its first ``total`` scans, through a new odometry; also the poses ``(N, 4, 4)`` it gave."""
    odometry = make_odometry(settings, flight.T_drone_sensor)
    stamp_s, prior, poses = flight.prior.stamp_s[:total], flight.prior.T_world_drone, []

    def update(k: int, scan: Scan) -> None:
        poses.append(odometry.update(scan, prior[k]).T_world_drone)
        if on_scan:
            on_scan(k + 1, len(stamp_s))

    played = play(arrivals, stamp_s, rate, update, clock)
    return played, np.array(poses).reshape(-1, 4, 4)


def fastest_rate(
    recording: Recording, options: Options | None = None, on_trial: OnTrial | None = None, alone: bool = False
) -> tuple[float, tuple[str, ...]]:
    """The highest rate at which less than one scan in a hundred is missed; and what to say of it.

    Every trial plays the same scans, from memory, the first `HELD_BYTES` of them; ``alone`` as in `play_recording`.
    Raises what that does, and `RecordingError` for a recording too short to tell.
    """
    options = options or Options()
    settings = options.settings()
    flight = course_of(recording, options.drift, options.seed, options.gap_max_s).flight
    scans = _first_scans(flight)
    if len(scans) < SCANS_MIN:
        raise RecordingError(
            f"{recording.path}: {len(scans)} scans with a pose; expected at least {SCANS_MIN}, to tell one in a hundred"
        )
    stamp_s = flight.prior.stamp_s[: len(scans)]
    through = replay(_beginning(flight, scans), settings)  # loads what is compiled, and says where to begin
    last = {}

    def missed(rate: float) -> float:
        clock = LoneClock() if alone else WallClock()
        played, _ = played_through(flight, settings, rate, Ready(scans), clock, total=len(scans))
        last[rate] = played
        if on_trial:
            on_trial(rate, played)
        return played.missed

    period_s = float(np.median(periods(stamp_s)))
    guess = period_s / float(through.seconds.mean())
    rate = highest_rate(missed, 2.0 ** math.floor(math.log2(guess / 2)), MISSED_MAX)
    name = recording.path.name
    if not rate:
        return rate, (f"fastest   no rate with less than {MISSED_MAX:.0%} missed, {options.method}, {name}",)
    return rate, (
        f"fastest   {rate:.3g} x, {rate / period_s:.1f} scans a second: {last[rate].missed:.1%} missed of "
        f"{len(scans)} scans, {options.method}{ALONE if alone else ''}, {name}",
        *_latency(last[rate], period_s / rate),
        f"trials    {len(last)}, each of the same {len(scans)} scans from memory, {np.ptp(stamp_s):.0f} s of flight",
    )


def _first_scans(flight: Flight) -> list[Scan]:
    held = 0
    scans: list[Scan] = []
    for scan in flight.scans:
        held += scan.points.nbytes
        if scans and held > HELD_BYTES:
            break
        scans.append(scan)
    return scans


def _beginning(flight: Flight, scans: list[Scan]) -> Flight:
    prior = flight.prior
    some = Trajectory(prior.stamp_s[: len(scans)], prior.T_world_drone[: len(scans)])
    return Flight(scans, some, flight.imu, flight.T_drone_sensor)


def _accuracy(
    course: Course, settings: ExperimentSettings, played: Played, poses: Array
) -> tuple[float | None, float | None]:
    """ATE at the scans worked on that have a true pose; and the same with no scan dropped."""
    if course.truth is None:
        return None, None
    stamp_s = course.flight.prior.stamp_s
    known = np.isin(played.index, np.searchsorted(stamp_s, course.truth.stamp_s - 1e-6))
    if np.count_nonzero(known) < 2:
        return None, None
    index = played.index[known]
    truth = course.truth.at(stamp_s[index])
    ate = score(Trajectory(stamp_s[index], poses[known]), truth)["ate_rmse_m"]
    if not played.dropped:
        return ate, ate
    return ate, score(replay(course.flight, settings).corrected, truth)["ate_rmse_m"]


def _latency(played: Played, period_s: float) -> list[str]:
    ms = 1e3 * played.latency_s
    shares = ", ".join(f"{share} %: {np.percentile(ms, share):.1f}" for share in (50, 95, 99))
    return [f"latency   {shares}, max: {ms.max():.1f} ms; the next scan comes after {1e3 * period_s:.1f} ms"]


def _summary(
    recording: Recording,
    course: Course,
    options: Options,
    rate: float,
    played: Played,
    ate: float | None,
    undropped: float | None,
    alone: bool,
) -> tuple[str, ...]:
    period_s = float(np.median(periods(course.flight.prior.stamp_s))) / rate
    skipped = [f"{count} {reason}" for reason, count in sorted(recording.skipped.items()) if count]
    behind = played.reading_s[played.reading_s > 0]
    read = f"{len(behind)} scans were read late, by up to {1e3 * behind.max(initial=0):.1f} ms; that is not counted"
    lines = [
        f"played    {recording.path.name}: {played.total} scans at {rate:g} x, {1 / period_s:.1f} a second, "
        f"through {options.method}{ALONE if alone else ''}",
        *([f"skipped   {'; '.join(skipped)}"] if skipped else []),
        *(f"note      {note}" for note in course.notes),
        f"missed    {played.missed:.1%}: {int(played.late.sum())} results came after the next scan was due, "
        f"{played.dropped} scans were dropped",
        *_latency(played, period_s),
        *([] if alone else [f"reading   {read}" if len(behind) else "reading   every scan was read before it was due"]),
    ]
    if ate is not None and undropped is not None:
        lost = "no scan was dropped, so nothing is lost"
        if played.dropped:
            lost = f"{undropped:.4f} m at the same scans when none is dropped: {ate - undropped:+.4f} m by drops"
        lines.append(f"accuracy  ATE {ate:.4f} m; {lost}")
    return tuple(lines)
