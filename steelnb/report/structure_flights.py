"""Notebooks 10 and 12: structures from flights at true, drifting and corrected poses, at once and frame by frame."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.errors import SettingsError
from steelnb.fusion import SegmentMap
from steelnb.fusion.joints import find_joints
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.scales import Scales
from steelnb.fusion.structure import Structure
from steelnb.metrics import score_trajectory
from steelnb.metrics.reconstruction import Reference, StructureScore, reference, score_structure
from steelnb.odometry import SegmentOdometry
from steelnb.report.batch import Progress
from steelnb.settings import (
    ExperimentSettings,
    OdometrySettings,
    StructureSettings,
    TowerSettings,
    TrajectoryName,
)
from steelnb.simulation import Truth
from steelnb.types import Array, Flight

POSES = ("raw", "corrected", "true")
BUILDS = ("final", "incremental")
SIGHTINGS_MIN = 5
"""A bar counts from the fifth sighting on: a second of flight. Chosen on seed 11."""
FORGET_FRAMES = 50
"""Bars with fewer sightings are dropped after ten seconds without one."""


@dataclass(frozen=True)
class StructureFlight:
    """A flight over a named tower with its truth, the members to be found, and poses by name.

    ``poses`` maps each of `POSES` asked for to ``T_world_drone (K, 4, 4)`` at the scans.
    """

    settings: ExperimentSettings
    tower: str
    flight: Flight
    truth: Truth
    reference: Reference
    poses: dict[str, Array]
    ate_m: dict[str, float]


@dataclass(frozen=True)
class Rebuilt:
    """One structure: from which poses, by which method, its score and the seconds it took."""

    source: StructureFlight
    poses: str
    method: str
    structure: Structure
    score: StructureScore
    seconds: float


def fly_tower(
    trajectory: TrajectoryName,
    sensor: str,
    noise: str,
    method: str,
    seed: int,
    duration_s: float,
    tower: str = "report",
    poses: Sequence[str] = POSES,
    overrides: dict[str, Any] | None = None,
    on_progress: Progress | None = None,
) -> StructureFlight:
    """Simulate a flight over a tower of `TowerSettings.preset`, let it drift, correct it. Raises `SettingsError`."""
    _require_known("poses", poses, POSES)
    preset = ExperimentSettings.preset(
        trajectory, noise, sensor=sensor, seed=seed, duration_s=duration_s, method=method
    )
    settings = preset.replace(tower=TowerSettings.preset(tower)).override(overrides or {})
    flight, truth = experiment.simulate(settings)
    found, ate = {"raw": flight.prior.T_world_drone}, {"raw": score_trajectory(flight.prior, truth.trajectory)}
    found["true"] = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    if "corrected" in poses:
        corrected = experiment.estimate(settings, flight, truth, on_progress).corrected
        found["corrected"], ate["corrected"] = corrected.T_world_drone, score_trajectory(corrected, truth.trajectory)
    errors = {name: ate[name]["ate_rmse_m"] if name in ate else 0.0 for name in poses}
    return StructureFlight(
        settings, tower, flight, truth, reference(truth.tower, truth.visibility),
        {name: found[name] for name in poses}, errors,
    )  # fmt: skip


def rebuild(
    source: StructureFlight,
    method: Sequence[str] = BUILDS,
    on_progress: Progress | None = None,
) -> list[Rebuilt]:
    """The structure from each of the flight's poses by each method of `BUILDS`, scored. Raises `SettingsError`.

    The drifting poses are taken as they are: the final reconstruction does not adjust them.
    """
    _require_known("structure_method", method, BUILDS)
    given, runs = StructureSettings(), []
    cases = [(poses, name) for poses in source.poses for name in method]
    for k, (poses, name) in enumerate(cases):
        began = time.perf_counter()
        if name == "final":
            flight = source.flight
            chosen = given.replace(adjust=False) if poses == "raw" else given
            structure = reconstruct(flight.scans, source.poses[poses], flight.T_drone_sensor, chosen)
        else:
            structure = _frame_by_frame(source, poses)
        seconds = time.perf_counter() - began
        runs.append(Rebuilt(source, poses, name, structure, score_structure(structure, source.reference), seconds))
        if on_progress:
            on_progress((k + 1) / len(cases))
    return runs


def _frame_by_frame(source: StructureFlight, poses: str) -> Structure:
    """The map of `SegmentOdometry`, which is given the poses and corrects nothing, as a structure."""
    s = source.settings
    still = OdometrySettings.preset("none", s.sensor).replace(preprocess=s.odometry.preprocess)
    odometry = SegmentOdometry(still, source.flight.T_drone_sensor)
    for k, (scan, T_world_drone) in enumerate(zip(source.flight.scans, source.poses[poses], strict=True)):
        odometry.update(scan, T_world_drone)
        if k % FORGET_FRAMES == 0:
            odometry.map.prune(SIGHTINGS_MIN, FORGET_FRAMES)
    return structure_of(odometry.map)


def structure_of(bars: SegmentMap) -> Structure:
    """The report's incremental reconstruction: the bars of a map with at least `SIGHTINGS_MIN` sightings, tied at
    joints where they come close to each other (`fusion.joints.find_joints`).

    World frame, metres. The axis of a bar runs in the middle of its points, so on the near side of its section; its
    width is not known (NaN). ``sigma_m``: the spread of the points over the root of the sightings, since the points of
    one sighting err together. An empty structure says why it is empty.
    """
    seen = bars.sightings >= SIGHTINGS_MIN
    segments, sightings = bars.segments.take(seen), bars.sightings[seen]
    if not len(segments):
        return Structure.empty(f"none of {len(bars)} bars was seen {SIGHTINGS_MIN} times")
    joint, tie, led = find_joints(segments, 2 * segments.radius, Scales())
    return Structure(led, np.full(len(led), np.nan), sightings, segments.radius / np.sqrt(sightings), joint, tie)


def _require_known(name: str, values: Sequence[str], known: Any) -> None:
    for value in values:
        if value not in known:
            raise SettingsError(f"{name} = {value!r}: expected one of {', '.join(map(repr, known))}")
