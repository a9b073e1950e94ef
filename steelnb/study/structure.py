"""Structures rebuilt from flights: from true, drifting and corrected poses, at once and frame by frame, with scores."""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.config import (
    ExperimentSettings,
    MethodName,
    OdometrySettings,
    SensorName,
    StructureSettings,
    TowerSettings,
    TrajectoryName,
)
from steelnb.datatypes import Array, Flight, IntArray, RangeScans, Segments
from steelnb.errors import SettingsError
from steelnb.fusion.incremental import FORGET_FRAMES, SIGHTINGS_MIN, structure_of
from steelnb.fusion.reconstruct import find_bars, map_scans, reconstruct
from steelnb.fusion.structure import Structure
from steelnb.metrics import score_trajectory
from steelnb.metrics.structure import Reference, StructureScore, reference, score_structure
from steelnb.odometry import SegmentOdometry
from steelnb.simulation import Truth
from steelnb.simulation.visibility import Visibility, see
from steelnb.study.runs import case_of, share

POSES = ("raw", "corrected", "true")
BUILDS = ("final", "incremental")
TOWERS = {
    "report": TowerSettings(),
    "heavy": TowerSettings(
        height_m=18.0,
        base_width_m=4.6,
        waist_height_m=10.5,
        waist_width_m=2.0,
        top_width_m=1.2,
        arm_height_m=(12.0, 14.4, 16.8),
        leg_section_m=(0.160, 0.014),
        ring_section_m=(0.090, 0.008),
        bracing_section_m=(0.090, 0.008),
        arm_section_m=(0.075, 0.007),
    ),
    "light": TowerSettings(
        height_m=16.0,
        base_width_m=3.4,
        waist_width_m=1.5,
        top_width_m=0.9,
        arm_height_m=(10.5, 13.5),
        arm_reach_m=(3.0, 2.6),
        leg_section_m=(0.100, 0.008),
        ring_section_m=(0.060, 0.005),
        bracing_section_m=(0.050, 0.005),
        arm_section_m=(0.050, 0.005),
    ),
}
"""By name. No setting was chosen on ``heavy`` or ``light``, whose shapes and sections differ from the report's."""
COLUMNS = (
    "recall", "precision", "duplicates", "angle_median_deg", "offset_median_m", "offset_p90_m", "end_median_m",
    "joint_recall", "joint_error_median_m", "edge_recall", "edge_precision",
)  # fmt: skip
MORE = (
    "bars", "observed", "joints", "joints_observed", "joint_precision", "edges", "angle_p90_deg", "end_p90_m",
    "joint_error_p90_m",
)  # fmt: skip
STRUCTURE_GOALS: dict[str, tuple[float | dict[str, float], str]] = {
    "recall": ({"orbit": 0.92, "vertical": 0.88}, "at least"),
    "precision": (0.98, "at least"),
    "duplicates": (2.0, "at most"),
    "offset_median_m": (0.012, "at most"),
    "offset_p90_m": (0.025, "at most"),
    "angle_median_deg": (0.35, "at most"),
    "end_median_m": (0.03, "at most"),
    "joint_recall": (0.92, "at least"),
    "joint_error_median_m": (0.02, "at most"),
    "edge_recall": (0.95, "at least"),
    "edge_precision": (0.95, "at least"),
    "ate_rmse_m": (0.025, "at most"),
}
"""Of each column the limit, for either flight or for both, and on which side of it the goal lies."""


@dataclass(frozen=True)
class StructureFlight:
    """A flight over a named tower: what an estimator sees, the truth, what was seen of it, and poses by name.

    ``poses`` maps each of `POSES` asked for to ``T_world_drone (K, 4, 4)`` at the scans.
    """

    settings: ExperimentSettings
    tower: str
    flight: Flight
    truth: Truth
    visibility: Visibility
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
    sensor: SensorName,
    noise: str,
    method: MethodName,
    seed: int,
    duration_s: float,
    tower: str = "report",
    poses: Sequence[str] = POSES,
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> StructureFlight:
    """Simulate a flight over one of `TOWERS`, let it drift, and correct it. Raises `SettingsError`."""
    _known("tower", tower, TOWERS)
    for name in poses:
        _known("poses", name, POSES)
    preset = ExperimentSettings.preset(
        trajectory, noise, sensor=sensor, seed=seed, duration_s=duration_s, method=method
    )
    settings = preset.but(tower=TOWERS[tower]).override(overrides or {})
    flight, truth = experiment.simulate(settings)
    found, ate = {"raw": flight.prior.T_world_drone}, {"raw": score_trajectory(flight.prior, truth.trajectory)}
    found["true"] = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    if "corrected" in poses:
        corrected = experiment.estimate(settings, flight, truth, on_progress).corrected
        found["corrected"], ate["corrected"] = corrected.T_world_drone, score_trajectory(corrected, truth.trajectory)
    visibility = see(truth.tower, truth.trajectory, flight.T_drone_sensor, cast(RangeScans, flight.scans))
    errors = {name: ate[name]["ate_rmse_m"] if name in ate else 0.0 for name in poses}
    return StructureFlight(
        settings, tower, flight, truth, visibility, reference(truth.tower, visibility),
        {name: found[name] for name in poses}, errors,
    )  # fmt: skip


def rebuild(
    source: StructureFlight,
    method: Sequence[str] = BUILDS,
    settings: StructureSettings | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> list[Rebuilt]:
    """The structure from each of the flight's poses by each method of `BUILDS`, scored. Raises `SettingsError`.

    The drifting poses are taken as they are: the final reconstruction does not adjust them.
    """
    given = settings or StructureSettings()
    runs = []
    for name in method:
        _known("structure_method", name, BUILDS)
    cases = [(poses, name) for poses in source.poses for name in method]
    for k, (poses, name) in enumerate(cases):
        began = time.perf_counter()
        if name == "final":
            flight = source.flight
            chosen = given.but(adjust=False) if poses == "raw" else given
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
    still = OdometrySettings(correction="none")
    odometry = SegmentOdometry(s.preprocess, s.hough, s.fusion, still, source.flight.T_drone_sensor)
    for k, (scan, T_world_drone) in enumerate(zip(source.flight.scans, source.poses[poses], strict=True)):
        odometry.update(scan, T_world_drone)
        if k % FORGET_FRAMES == 0:
            odometry.map.prune(SIGHTINGS_MIN, FORGET_FRAMES)
    return structure_of(odometry.map)


def structures_over_seeds(
    trajectory: TrajectoryName,
    sensor: SensorName,
    noise: str,
    method: MethodName,
    seeds: Sequence[int],
    duration_s: float,
    tower: Sequence[str] = tuple(TOWERS),
    poses: Sequence[str] = ("corrected",),
    structure_method: Sequence[str] = BUILDS,
    overrides: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`structure_table` and `structure_timing` of every tower × seed, one flight after the other; no more is kept."""
    tables, times = [], []
    cases = [(name, seed) for name in tower for seed in seeds]
    for k, (name, seed) in enumerate(cases):
        within = None if on_progress is None else share(on_progress, k, len(cases))
        source = fly_tower(trajectory, sensor, noise, method, seed, duration_s, name, poses, overrides, within)
        runs = rebuild(source, structure_method)
        tables.append(structure_table(runs))
        times.append(structure_timing(runs))
    return pd.concat(tables, ignore_index=True), pd.concat(times, ignore_index=True)


def structure_table(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """One row a structure: what it was built from, the numbers of the goals, then more of them.

    ``odometry`` names the method that corrected the poses; ``toward_sensor_median_m`` is how much nearer to the sensor
    the axes lie than the true ones.
    """
    rows = []
    for run in runs:
        toward = toward_sensor_m(run.source, run.structure.segments, run.score.member)
        numbers = run.score.metrics
        rows.append(
            _case(run) | {name: numbers[name] for name in (*COLUMNS, *MORE)}
            | {"toward_sensor_median_m": _median(toward), "ate_rmse_m": run.source.ate_m[run.poses]}
        )  # fmt: skip
    return pd.DataFrame(rows)


def structure_timing(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """Seconds that each structure took."""
    return pd.DataFrame([_case(run) | {"seconds": run.seconds} for run in runs])


def structure_metrics(runs: Sequence[Rebuilt]) -> dict[str, float]:
    """The finite numbers of `structure_table` in one flat map, ``<poses>.<method>.<metric>``."""
    case = set(_case(runs[0]))
    return {
        f"{row['poses']}.{row['method']}.{name}": float(value)
        for row in structure_table(runs).to_dict("records")
        for name, value in row.items()
        if name not in case and np.isfinite(value)
    }


def structure_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst of the goals' columns over the seeds, a row for each tower, poses and method."""
    rows = []
    for (tower, poses, method), runs in table.groupby(["tower", "poses", "method"], sort=False):
        row: dict[str, Any] = {"tower": tower, "poses": poses, "method": method, "seeds": len(runs)}
        for name, (_, side) in STRUCTURE_GOALS.items():
            row[f"{name}_mean"] = runs[name].mean()
            row[f"{name}_worst"] = runs[name].min() if side == "at least" else runs[name].max()
        rows.append(row)
    return pd.DataFrame(rows)


def structure_summary_metrics(summary: pd.DataFrame) -> dict[str, float]:
    """The finite numbers of `structure_summary` in one flat map, ``<tower>.<poses>.<method>.<metric>``."""
    case = ("tower", "poses", "method")
    return {
        ".".join([*(row[name] for name in case), str(name)]): float(value)
        for row in summary.to_dict("records")
        for name, value in row.items()
        if name not in case and np.isfinite(value)
    }


def structure_goals(table: pd.DataFrame, trajectory: TrajectoryName) -> pd.DataFrame:
    """The goals beside the means of some runs: ``goal``, ``limit``, ``side``, ``mean``, ``reached`` (by the mean)."""
    rows = []
    for name, (limits, side) in STRUCTURE_GOALS.items():
        limit = limits[trajectory] if isinstance(limits, dict) else limits
        mean = float(table[name].mean())
        reached = mean >= limit if side == "at least" else mean <= limit
        rows.append({"goal": name, "side": side, "limit": limit, "mean": mean, "reached": bool(reached)})
    return pd.DataFrame(rows)


def recall_by_points(runs: Sequence[Rebuilt], per_decade: int = 2) -> pd.DataFrame:
    """Share of members found, by the points seen of them, ``per_decade`` classes to a power of ten from 10 on.

    A row for each poses, method and class ``points_from`` ≤ points < ``points_to``: ``members`` and ``recall``. All
    members with a point count, also those that the measures do not call observed.
    """
    rows = []
    for run in runs:
        hits = run.source.visibility.hits
        decades = math.ceil(math.log10(max(int(hits.max()), 11)))
        edges = 10.0 ** (1 + np.arange((decades - 1) * per_decade + 1) / per_decade)
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (hits >= low) & (hits < high)
            if inside.any():
                recall = float(run.score.found[inside].mean())
                rows.append((run.poses, run.method, low, high, int(inside.sum()), recall))
    return pd.DataFrame(rows, columns=["poses", "method", "points_from", "points_to", "members", "recall"])


def near_side(run: Rebuilt, settings: StructureSettings | None = None) -> pd.DataFrame:
    """How much nearer to the sensor bars lie than the true axes, as found in the middle of their points and as rebuilt.

    One row a bar on a member: ``axis`` (``middle of points`` or ``section fitted``), the ``kind`` and the
    ``section_m`` (width of the flange) of its member, and ``toward_sensor_m``. Poses are those of the run.
    """
    source, s = run.source, settings or StructureSettings()
    middles = _middles(source.flight, source.poses[run.poses], s)
    unknown = np.full(len(middles), np.nan)
    blank = Structure(middles, unknown, middles.count, unknown, np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    rows = []
    cases = (
        ("middle of points", middles, score_structure(blank, source.reference)),
        ("section fitted", run.structure.segments, run.score),
    )
    for axis, bars, score in cases:
        toward = toward_sensor_m(source, bars, score.member)
        for m, value in zip(score.member.tolist(), toward.tolist(), strict=True):
            if m >= 0:
                member = source.truth.tower.members[m]
                rows.append(
                    {"axis": axis, "kind": member.kind, "section_m": member.section_m[0], "toward_sensor_m": value}
                )
    return pd.DataFrame(rows)


def near_side_summary(bias: pd.DataFrame) -> pd.DataFrame:
    """Bars, median and quartiles of ``toward_sensor_m`` for each axis and kind of member, and over all kinds."""
    whole = bias.assign(kind="all", section_m=np.nan)
    groups = pd.concat([bias, whole]).groupby(["axis", "kind"], sort=False)["toward_sensor_m"]
    table = groups.quantile(np.array([0.25, 0.5, 0.75])).unstack().set_axis(["q25_m", "median_m", "q75_m"], axis=1)
    return table.assign(bars=groups.size()).reset_index()


def near_side_metrics(summary: pd.DataFrame) -> dict[str, float]:
    """The numbers of `near_side_summary` in one flat map, ``near_side.<axis>.<kind>.<metric>``."""
    return {
        f"near_side.{row['axis']}.{row['kind']}.{name}": float(row[name])
        for row in summary.to_dict("records")
        for name in ("q25_m", "median_m", "q75_m", "bars")
    }


def toward_sensor_m(source: StructureFlight, bars: Segments, member: IntArray) -> Array:
    """How much nearer to the sensor the middle of each bar lies than its member's axis ``(B,)``, NaN for none.

    Measured across the axis, along the mean direction in which the bar was looked at from the true poses, near looks
    weighing more (1/distance²), as their points do.
    """
    flight = source.flight
    T_world_sensor = source.truth.trajectory.at(flight.prior.stamp_s).T_world_drone @ flight.T_drone_sensor
    tof = source.settings.tof
    inside = math.cos(0.5 * max(tof.fov_horizontal_rad, tof.fov_vertical_rad))
    toward = np.full(len(bars), np.nan)
    for b in np.flatnonzero(member >= 0):
        begin, end = source.reference.axes[member[b]]
        axis = (end - begin) / np.linalg.norm(end - begin)
        sight = bars.middle[b] - T_world_sensor[:, :3, 3]
        distance = np.linalg.norm(sight, axis=1)
        ahead = (sight * T_world_sensor[:, :3, 0]).sum(axis=1) > inside * distance
        seen = ahead & (distance < tof.range_max_m)
        view = (sight[seen] / distance[seen, None] ** 3).sum(axis=0)
        view -= (view @ axis) * axis
        size = np.linalg.norm(view)
        if size > 0:
            toward[b] = -(bars.middle[b] - begin) @ view / size
    return toward


def _middles(flight: Flight, T_world_drone: Array, settings: StructureSettings) -> Segments:
    """Bars of all scans at some poses, their axes in the middle of their points."""
    return find_bars(map_scans(flight.scans, T_world_drone @ flight.T_drone_sensor, settings), settings)[0]


def structure_provenance(runs: Sequence[Rebuilt]) -> dict[str, Any]:
    """The settings of the flight, its tower and odometry, and those of the reconstruction."""
    source = runs[0].source
    about = {"tower": source.tower, "settings": source.settings.model_dump()}
    return about | {"structure": StructureSettings().model_dump(), "sightings_min": SIGHTINGS_MIN}


def _case(run: Rebuilt) -> dict[str, Any]:
    case = case_of(run.source.settings)
    return {
        "trajectory": case["trajectory"], "noise": case["noise"], "tower": run.source.tower, "seed": case["seed"],
        "poses": run.poses, "method": run.method, "odometry": case["method"], "sensor": case["sensor"],
    }  # fmt: skip


def _known(name: str, value: str, known: Any) -> None:
    if value not in known:
        raise SettingsError(f"{name} = {value!r}: expected one of {', '.join(map(repr, known))}")


def _median(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else math.nan
