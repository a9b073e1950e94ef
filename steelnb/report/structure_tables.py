"""Notebooks 07 and 07: structures from flights at true, drifting and corrected poses, at once and frame by frame; their
tables, the goals set for them, and the near-side bias."""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.batch import Progress, case_of, share_of
from steelnb.fusion import SegmentMap
from steelnb.fusion.joints import find_joints
from steelnb.fusion.proposals import find_bars
from steelnb.fusion.reconstruct import map_scans, reconstruct
from steelnb.fusion.structure import Structure
from steelnb.io.structures import write_structure
from steelnb.metrics.reconstruction import Reference, StructureScore, reference, score_structure
from steelnb.odometry import SegmentOdometry
from steelnb.parameters import check_names
from steelnb.settings import ExperimentSettings, OdometrySettings, StructureSettings, TowerSettings, TrajectoryName
from steelnb.types import Array, Flight, IntArray, Segments

POSES = ("raw", "corrected", "true")
BUILDS = ("final", "incremental")
SIGHTINGS_MIN = 5
"""A bar counts from the fifth sighting on: a second of flight. Chosen on seed 11."""
FORGET_FRAMES = 50
"""Bars with fewer sightings are dropped after ten seconds without one."""
CASE = ("trajectory", "noise", "tower", "seed", "poses", "method", "odometry", "sensor")
NUMBERS = (
    "recall", "precision", "duplicates", "angle_median_deg", "offset_median_m", "offset_p90_m", "end_median_m",
    "joint_recall", "joint_error_median_m", "edge_recall", "edge_precision", "bars", "observed", "joints",
    "joints_observed", "joint_precision", "edges", "angle_p90_deg", "end_p90_m", "joint_error_p90_m",
    "toward_sensor_median_m", "ate_rmse_m",
)  # fmt: skip
STRUCTURE_GOALS: dict[str, tuple[float | dict[str, float], str]] = {
    "recall": ({"loops": 0.92, "zigzag": 0.88}, "at least"),
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
"""Column → its limit, for either flight or for both, and the side of it on which the goal lies."""


@dataclass(frozen=True)
class StructureFlight:
    """A flight over a named tower, its odometry and truth, the members to be found, and ``T_world_drone (K, 4, 4)`` at
    the scans for each of `POSES`."""

    tower: str
    flight: Flight
    result: experiment.Result
    reference: Reference
    poses: dict[str, Array]


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
    tower: str = "tapered",
    overrides: dict[str, Any] | None = None,
    on_progress: Progress | None = None,
) -> StructureFlight:
    """Simulate a flight over a tower of `TowerSettings.preset`, let it drift, correct it. Raises `InputError`."""
    settings = ExperimentSettings.preset(
        trajectory, noise, sensor=sensor, seed=seed, duration_s=duration_s, method=method
    )
    settings = settings.replace(tower=TowerSettings.preset(tower)).override(overrides or {})
    flight, truth = experiment.simulate(settings)
    result = experiment.estimate(settings, flight, truth, on_progress)
    at_scans = (result.prior, result.corrected, truth.trajectory.at(flight.prior.stamp_s))
    poses = {name: path.T_world_drone for name, path in zip(POSES, at_scans, strict=True)}
    return StructureFlight(tower, flight, result, reference(truth.tower, truth.visibility), poses)


def rebuild(
    source: StructureFlight,
    method: Sequence[str] = BUILDS,
    poses: Sequence[str] = POSES,
    on_progress: Progress | None = None,
) -> list[Rebuilt]:
    """The structure from each of some `POSES` by each of some methods of `BUILDS`, scored. Raises `InputError`.

    The final reconstruction adjusts poses which were corrected and not smoothed; drifting ones are taken as they are.
    """
    check_names("poses", poses, POSES)
    check_names("structure_method", method, BUILDS)
    flight, runs = source.flight, []
    for k, (each, name) in enumerate(itertools.product(poses, method), start=1):
        began = time.perf_counter()
        if name == "final":
            chosen = StructureSettings(adjust=each != "raw" and not source.result.settings.odometry.smooth)
            structure = reconstruct(flight.scans, source.poses[each], flight.T_drone_sensor, chosen)
        else:
            structure = _frame_by_frame(source, each)
        seconds = time.perf_counter() - began
        runs.append(Rebuilt(source, each, name, structure, score_structure(structure, source.reference), seconds))
        if on_progress:
            on_progress(k / (len(poses) * len(method)))
    return runs


def _frame_by_frame(source: StructureFlight, poses: str) -> Structure:
    """The map of `SegmentOdometry`, which is given the poses and corrects nothing, as a structure."""
    s = source.result.settings
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
    joint, tie, led = find_joints(segments, 2 * segments.radius)
    return Structure(led, np.full(len(led), np.nan), sightings, segments.radius / np.sqrt(sightings), joint, tie)


def structure_table(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """One row a structure: `CASE`, what it was built from, then `NUMBERS` and the ``seconds`` that it took.

    ``odometry`` names the method that corrected the poses; ``toward_sensor_median_m`` is how much nearer to the sensor
    the axes lie than the true ones, NaN where no bar is on a member.
    """
    rows = []
    for run in runs:
        result, tower = run.source.result, run.source.tower
        case = case_of(result.settings)
        case |= {"tower": tower, "poses": run.poses, "method": run.method, "odometry": case["method"]}
        toward = pd.Series(toward_sensor_m(run.source, run.structure.segments, run.score.member))
        ate_m = {"raw": result.metrics["raw_ate_rmse_m"], "corrected": result.metrics["ate_rmse_m"], "true": 0.0}
        measured = {"toward_sensor_median_m": toward.median(), "ate_rmse_m": ate_m[run.poses], "seconds": run.seconds}
        rows.append(case | run.score.metrics | measured)
    return pd.DataFrame(rows)[[*CASE, *NUMBERS, "seconds"]]


def tower_tables(
    tower: Sequence[str], seeds: Sequence[int], structure_method: Sequence[str], on_progress: Progress, **flight: Any
) -> pd.DataFrame:
    """`structure_table` of every tower and seed, from corrected poses; ``flight`` are the other arguments of
    `fly_tower`. One flight is in memory at a time."""
    cases, tables = list(itertools.product(tower, seeds)), []
    for k, (name, seed) in enumerate(cases):
        source = fly_tower(tower=name, seed=seed, on_progress=share_of(on_progress, k, len(cases)), **flight)
        tables.append(structure_table(rebuild(source, structure_method, ["corrected"])))
    return pd.concat(tables, ignore_index=True)


def structure_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst of the goals' columns over the seeds, a row for each tower, poses and method."""
    groups = table.groupby(["tower", "poses", "method"], sort=False)
    columns: dict[str, Any] = {"seeds": ("seed", "size")}
    for name, (_, side) in STRUCTURE_GOALS.items():
        columns[f"{name}_mean"] = (name, "mean")
        columns[f"{name}_worst"] = (name, "min" if side == "at least" else "max")
    return groups.agg(**columns).reset_index()


def structure_goals(table: pd.DataFrame, trajectory: TrajectoryName) -> pd.DataFrame:
    """The goals of a flight beside the means of some runs: ``goal``, ``side``, ``limit``, ``mean``, ``reached``."""
    rows = []
    for name, (limit, side) in STRUCTURE_GOALS.items():
        of_flight, mean = limit[trajectory] if isinstance(limit, dict) else limit, table[name].mean()
        reached = mean >= of_flight if side == "at least" else mean <= of_flight
        rows.append({"goal": name, "side": side, "limit": of_flight, "mean": mean, "reached": reached})
    return pd.DataFrame(rows)


def recall_by_points(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """Share of members found, by the points seen of them, two classes to a power of ten from 10 on.

    A row for each poses, method and class ``points_from`` ≤ points < ``points_to``: ``members`` and ``recall``. All
    members with a point count, also those that the measures do not call observed.
    """
    rows = []
    for run in runs:
        hits = run.source.result.truth.visibility.returns
        decades = math.ceil(math.log10(max(int(hits.max()), 11)))
        edges = 10.0 ** (1 + np.arange(2 * decades - 1) / 2)
        k = np.searchsorted(edges, hits, side="right") - 1
        inside = (k >= 0) & (k < len(edges) - 1)
        found = pd.Series(run.score.found[inside]).groupby(k[inside]).agg(members="size", recall="mean")
        at = found.index.to_numpy()
        rows.append(found.assign(poses=run.poses, method=run.method, points_from=edges[at], points_to=edges[at + 1]))
    return pd.concat(rows, ignore_index=True)


def near_side(run: Rebuilt) -> pd.DataFrame:
    """Near-side bias: how much nearer to the sensor bars lie than the true axes, in the middle of their points and as
    rebuilt.

    One row a bar on a member: ``axis`` (``middle of points`` or ``section fitted``), the ``kind`` and the
    ``section_m`` (width of the flange) of its member, and ``toward_sensor_m``. Poses are those of the run.
    """
    source, s = run.source, StructureSettings()
    T_world_sensor = source.poses[run.poses] @ source.flight.T_drone_sensor
    middles = find_bars(map_scans(source.flight.scans, T_world_sensor, s))[0]
    unknown = np.full(len(middles), np.nan)
    blank = Structure(middles, unknown, middles.count, unknown, np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    members = pd.DataFrame((each.kind, each.section_m[0]) for each in source.result.truth.tower.members)
    tables = []
    for axis, bars, on in (
        ("middle of points", middles, score_structure(blank, source.reference).member),
        ("section fitted", run.structure.segments, run.score.member),
    ):
        toward = toward_sensor_m(source, bars, on)[on >= 0]
        own = members.loc[on[on >= 0]].set_axis(["kind", "section_m"], axis=1)
        tables.append(own.assign(axis=axis, toward_sensor_m=toward))
    return pd.concat(tables, ignore_index=True)


def near_side_summary(bias: pd.DataFrame) -> pd.DataFrame:
    """Bars, median and quartiles of ``toward_sensor_m`` for each axis and kind of member, and over all kinds."""
    whole = bias.assign(kind="all", section_m=np.nan)
    groups = pd.concat([bias, whole]).groupby(["axis", "kind"], sort=False)["toward_sensor_m"]
    table = groups.quantile(np.array([0.25, 0.5, 0.75])).unstack().set_axis(["q25_m", "median_m", "q75_m"], axis=1)
    return table.assign(bars=groups.size()).reset_index()


def toward_sensor_m(source: StructureFlight, bars: Segments, member: IntArray) -> Array:
    """Distance ``(B,)`` by which the middle of each bar lies nearer to the sensor than its member's axis, NaN for none.

    Measured across the axis, along the mean direction in which the bar was looked at from the true poses, near looks
    weighing more (1/distance²), as their points do.
    """
    T_world_sensor = source.poses["true"] @ source.flight.T_drone_sensor
    tof = source.result.settings.tof
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


def structure_files(name: str, structure: Structure) -> dict[str, Callable[[Path], object]]:
    """A file for `write_results`: structure_<name>.json."""
    return {f"structure_{name}.json": partial(write_structure, structure)}
