"""Notebooks 10 and 12: tables of structures rebuilt from flights, the goals set for them, and the near-side bias."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.fusion.reconstruct import find_bars, map_scans
from steelnb.fusion.structure import Structure
from steelnb.io.structures import write_structure
from steelnb.metrics.reconstruction import score_structure
from steelnb.report.batch import case_of, flat
from steelnb.report.structure_flights import SIGHTINGS_MIN, Rebuilt, StructureFlight
from steelnb.settings import StructureSettings, TrajectoryName
from steelnb.types import Array, IntArray, Segments

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
"""Column → its limit, for either flight or for both, and the side of it on which the goal lies."""


def structure_table(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """One row a structure: what it was built from, the numbers of the goals, then more of them.

    ``odometry`` names the method that corrected the poses; ``toward_sensor_median_m`` is how much nearer to the sensor
    the axes lie than the true ones.
    """
    rows = []
    for run in runs:
        toward = toward_sensor_m(run.source, run.structure.segments, run.score.member)
        bias = float(np.median(toward[np.isfinite(toward)])) if np.isfinite(toward).any() else math.nan
        numbers = {name: run.score.metrics[name] for name in (*COLUMNS, *MORE)}
        error_m = run.source.ate_m[run.poses]
        rows.append({**_case(run), **numbers, "toward_sensor_median_m": bias, "ate_rmse_m": error_m})
    return pd.DataFrame(rows)


def structure_timing(runs: Sequence[Rebuilt]) -> pd.DataFrame:
    """Seconds that each structure took."""
    return pd.DataFrame([_case(run) | {"seconds": run.seconds} for run in runs])


def structure_metrics(runs: Sequence[Rebuilt]) -> dict[str, float]:
    """The finite numbers of `structure_table` in one flat map, ``<poses>.<method>.<metric>``."""
    table = structure_table(runs)
    return flat(table, ("poses", "method"), [str(name) for name in table if name not in _case(runs[0])])


def structure_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst of the goals' columns over the seeds, a row for each tower, poses and method."""
    groups = table.groupby(["tower", "poses", "method"], sort=False)
    columns: dict[str, Any] = {"seeds": ("seed", "size")}
    for name, (_, side) in STRUCTURE_GOALS.items():
        columns[f"{name}_mean"] = (name, "mean")
        columns[f"{name}_worst"] = (name, "min" if side == "at least" else "max")
    return groups.agg(**columns).reset_index()


def structure_goals(table: pd.DataFrame, trajectory: TrajectoryName) -> pd.DataFrame:
    """The goals beside the means of some runs: ``goal``, ``side``, ``limit``, ``mean``, ``reached`` (by the mean)."""
    rows = []
    for name, (limits, side) in STRUCTURE_GOALS.items():
        limit = limits[trajectory] if isinstance(limits, dict) else limits
        mean = float(table[name].mean())
        rows.append((name, side, limit, mean, bool(mean >= limit if side == "at least" else mean <= limit)))
    return pd.DataFrame(rows, columns=["goal", "side", "limit", "mean", "reached"])


def recall_by_points(runs: Sequence[Rebuilt], per_decade: int = 2) -> pd.DataFrame:
    """Share of members found, by the points seen of them, ``per_decade`` classes to a power of ten from 10 on.

    A row for each poses, method and class ``points_from`` ≤ points < ``points_to``: ``members`` and ``recall``. All
    members with a point count, also those that the measures do not call observed.
    """
    rows = []
    for run in runs:
        hits = run.source.truth.visibility.returns
        decades = math.ceil(math.log10(max(int(hits.max()), 11)))
        edges = 10.0 ** (1 + np.arange((decades - 1) * per_decade + 1) / per_decade)
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (hits >= low) & (hits < high)
            if inside.any():
                recall = float(run.score.found[inside].mean())
                rows.append((run.poses, run.method, low, high, int(inside.sum()), recall))
    return pd.DataFrame(rows, columns=["poses", "method", "points_from", "points_to", "members", "recall"])


def near_side(run: Rebuilt) -> pd.DataFrame:
    """Near-side bias: how much nearer to the sensor bars lie than the true axes, in the middle of their points and as
    rebuilt.

    One row a bar on a member: ``axis`` (``middle of points`` or ``section fitted``), the ``kind`` and the
    ``section_m`` (width of the flange) of its member, and ``toward_sensor_m``. Poses are those of the run.
    """
    source, s = run.source, StructureSettings()
    T_world_sensor = source.poses[run.poses] @ source.flight.T_drone_sensor
    middles = find_bars(map_scans(source.flight.scans, T_world_sensor, s), s)[0]
    unknown = np.full(len(middles), np.nan)
    blank = Structure(middles, unknown, middles.count, unknown, np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    cases = {
        "middle of points": (middles, score_structure(blank, source.reference).member),
        "section fitted": (run.structure.segments, run.score.member),
    }
    rows = []
    for axis, (bars, members) in cases.items():
        toward = toward_sensor_m(source, bars, members)
        for m, value in zip(members[members >= 0].tolist(), toward[members >= 0].tolist(), strict=True):
            member = source.truth.tower.members[m]
            rows.append((axis, member.kind, member.section_m[0], value))
    return pd.DataFrame(rows, columns=["axis", "kind", "section_m", "toward_sensor_m"])


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


def structure_files(structures: Mapping[str, Structure]) -> dict[str, Callable[[Path], object]]:
    """Files for `write_results`: structure_<name>.json and .glb of each (no .glb for one without bars)."""
    return {
        f"structure_{name}.{ending}": partial(write_structure, structure)
        for name, structure in structures.items()
        for ending in (("json", "glb") if len(structure) else ("json",))
    }
