"""Structures reconstructed from flights over named towers, with drifting, corrected or true poses, from all scans at
once or scan by scan; their scores, and the near-side bias."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from steelnb import experiment
from steelnb.core.types import Array, Flight, IntArray, Segments
from steelnb.fusion.bars import Ridges, find_bars
from steelnb.fusion.mapped_scans import MappedScans
from steelnb.fusion.reconstruct import reconstruct
from steelnb.fusion.segment_map import FORGET_FRAMES, SIGHTINGS_MIN, structure_of
from steelnb.fusion.structure import Structure
from steelnb.metrics.segments import match_members
from steelnb.metrics.structure import Reference, StructureScore, reference, score_structure, toward_sensor_m
from steelnb.notebook.cases import case_of
from steelnb.odometry import SegmentOdometry
from steelnb.settings import ExperimentSettings, OdometrySettings, StructureSettings

POSES = ("raw", "corrected", "true")
RECONSTRUCTIONS = ("final", "incremental")
"""From all scans at once, or scan by scan as in the report."""
STRUCTURE_COLUMNS = ("trajectory", "noise", "tower", "seed", "poses", "method", "odometry", "sensor")
NUMBERS = (
    "recall", "precision", "duplicates", "angle_median_deg", "offset_median_m", "offset_p90_m", "end_median_m",
    "joint_recall", "joint_error_median_m", "edge_recall", "edge_precision", "bars", "observed", "joints",
    "joints_observed", "joint_precision", "edges", "angle_p90_deg", "end_p90_m", "joint_error_p90_m",
    "toward_sensor_median_m", "ate_rmse_m",
)  # fmt: skip


@dataclass(frozen=True)
class TowerFlight:
    """A flight over a named tower, the result of its odometry, the true structure, and ``T_world_drone (K, 4, 4)`` at
    the scans for each of `POSES`."""

    tower: str
    flight: Flight
    result: experiment.Result
    reference: Reference
    poses: dict[str, Array]

    def toward_sensor_m(self, bars: Segments, member: IntArray) -> Array:
        """`metrics.structure.toward_sensor_m` of bars from this flight."""
        T_world_sensor = self.poses["true"] @ self.flight.T_drone_sensor
        return toward_sensor_m(bars, member, self.reference.axes, T_world_sensor, self.result.settings.tof)


@dataclass(frozen=True)
class Rebuilt:
    """One reconstructed structure, which of `POSES` and `RECONSTRUCTIONS` it is from, its score, and its seconds."""

    source: TowerFlight
    poses: str
    method: str
    structure: Structure
    score: StructureScore
    seconds: float


def fly_tower(
    tower: str, settings: ExperimentSettings, on_progress: experiment.OnProgress | None = None
) -> TowerFlight:
    """Simulate a drifting flight over a tower, which tables call ``tower``, and correct it. Raises `CollisionError`."""
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth, on_progress)
    at_scans = (result.prior, result.corrected, truth.trajectory.at(flight.prior.stamp_s))
    poses = {name: path.T_world_drone for name, path in zip(POSES, at_scans, strict=True)}
    return TowerFlight(tower, flight, result, reference(truth.tower, truth.visibility), poses)


def rebuild(source: TowerFlight, poses: Sequence[str] = POSES) -> dict[tuple[str, str], Rebuilt]:
    """Reconstruct the structure with each of some `POSES` by each of `RECONSTRUCTIONS`. The keys are (poses, method).

    The final reconstruction adjusts corrected and true poses, unless the odometry smooths. Drifting poses are kept.
    """
    flight, runs = source.flight, {}
    for each, method in itertools.product(poses, RECONSTRUCTIONS):
        began = time.perf_counter()
        if method == "final":
            smoothed = source.result.settings.odometry.smooth
            thickness = source.result.thickness if each == "corrected" else None
            chosen = StructureSettings(adjust=each != "raw" and not smoothed, thickness=thickness)
            structure = reconstruct(flight.scans, source.poses[each], flight.T_drone_sensor, chosen)
        else:
            structure = _scan_by_scan(source, each)
        seconds, score = time.perf_counter() - began, score_structure(structure, source.reference)
        runs[each, method] = Rebuilt(source, each, method, structure, score, seconds)
    return runs


def _scan_by_scan(source: TowerFlight, poses: str) -> Structure:
    """The structure in the map of a `SegmentOdometry` that uses the given poses and corrects nothing."""
    s = source.result.settings
    still = OdometrySettings.preset("none", s.sensor).replace(preprocess=s.odometry.preprocess)
    odometry = SegmentOdometry(still, source.flight.T_drone_sensor)
    for k, (scan, T_world_drone) in enumerate(zip(source.flight.scans, source.poses[poses], strict=True)):
        odometry.update(scan, T_world_drone)
        if k % FORGET_FRAMES == 0:
            odometry.map.prune(SIGHTINGS_MIN, FORGET_FRAMES)
    return structure_of(odometry.map)


def structure_row(run: Rebuilt) -> dict[str, Any]:
    """One row of a table: the columns `STRUCTURE_COLUMNS` and `NUMBERS`, and the ``seconds`` of the reconstruction.

    ``odometry`` names the method that corrected the poses. ``toward_sensor_median_m`` is the median distance by which
    bars are nearer to the sensor than the true axes, NaN if no bar is on a member.
    """
    result = run.source.result
    case = case_of(result.settings)
    toward = pd.Series(run.source.toward_sensor_m(run.structure.segments, run.score.member))
    ate_m = {"raw": result.metrics["raw_ate_rmse_m"], "corrected": result.metrics["ate_rmse_m"], "true": 0.0}
    values = {
        **case, "tower": run.source.tower, "poses": run.poses, "method": run.method, "odometry": case["method"],
        **run.score.metrics, "toward_sensor_median_m": toward.median(), "ate_rmse_m": ate_m[run.poses],
    }  # fmt: skip
    return {name: values[name] for name in (*STRUCTURE_COLUMNS, *NUMBERS)} | {"seconds": run.seconds}


def near_side(run: Rebuilt) -> pd.DataFrame:
    """Near-side bias: how much nearer to the sensor bars are than the true axes, both through the middle of their
    points and as reconstructed.

    One row per bar on a member: ``axis`` (``middle of points`` or ``section fitted``), the ``kind`` and the
    ``section_m`` (width of the flange) of its member, and ``toward_sensor_m``. The points are at the poses of the run.
    """
    source, s = run.source, StructureSettings()
    T_world_sensor = source.poses[run.poses] @ source.flight.T_drone_sensor
    middles = find_bars(Ridges.of(MappedScans.mapped(source.flight.scans, T_world_sensor, s).voxels))[0]
    members = pd.DataFrame((each.kind, each.section_m[0]) for each in source.result.truth.tower.members)
    tables = []
    for axis, bars, on in (
        ("middle of points", middles, match_members(middles, source.reference.axes).member),
        ("section fitted", run.structure.segments, run.score.member),
    ):
        toward = source.toward_sensor_m(bars, on)[on >= 0]
        own = members.loc[on[on >= 0]].set_axis(["kind", "section_m"], axis=1)
        tables.append(own.assign(axis=axis, toward_sensor_m=toward))
    return pd.concat(tables, ignore_index=True)
