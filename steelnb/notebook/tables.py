"""Tables of runs: the columns that name a case, and one row per run."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.notebook.cases import case_of
from steelnb.settings import ExperimentSettings, LoamSettings, RegistrationSettings, ReportCloudSettings, TowerSettings
from steelnb.settings.presets import TOWERS

TITLE = "{trajectory} flight, {noise}, sensor {sensor}, seed {seed}"
CLOUD_CASE = ("trajectory", "noise", "method", "map")
"""Columns that identify a run of a point-cloud odometry."""
UNITS = {name: name for name in ("m", "cm", "mm", "s", "ms", "rad")} | {"deg": "°", "share": "share"}
"""Last word of a column's name → its unit as the head of a table shows it."""
HEADS = {
    "ate_rmse_m": "ATE (m)", "raw_ate_rmse_m": "ATE uncorrected (m)", "raw_error_final_m": "uncorrected at the end (m)",
    "error_mean_m": "mean error (m)", "error_max_m": "largest error (m)", "error_final_m": "error at the end (m)",
    "mean_m": "mean error (m)", "max_m": "largest error (m)", "final_m": "error at the end (m)",
    "report_mean_m": "report's mean (m)", "report_max_m": "report's largest (m)", "report_final_m": "report's end (m)",
    "ate_mean_m": "mean ATE (m)", "ate_worst_m": "largest ATE (m)", "drift_mean_m": "mean drift (m)",
    "share_below": "below the report (share)", "share_above_1": "seeds beyond 1 (share)",
    "expected_rms": "RMS of the model", "rms": "RMS of the seeds",
    "report_seed": "the report's seed", "report_plot": "the report's plot",
    "yaw_max_deg": "largest yaw (°)", "offset_max_m": "largest offset (m)", "blur_mean_m": "mean blur (m)",
    "height_max_m": "largest height (m)", "max_correspondence_m": "pairs within (m)", "median_ms": "time (ms)",
    "few_share": "scans without sight (share)", "no_pair_share": "scans without a pair (share)",
    "seen_share": "steel seen (share)", "q25_m": "25 % (m)", "q75_m": "75 % (m)",
    "joint_recall": "recall of joints", "edge_recall": "recall of edges", "edge_precision": "precision of edges",
    "offset_median_m": "offset, median (m)", "offset_p90_m": "offset, 90 % (m)", "end_median_m": "ends off, median (m)",
    "angle_median_deg": "angle, median (°)", "joint_error_median_m": "joints off, median (m)",
}  # fmt: skip
"""Heads of columns of which `column_head` would make other words."""


def tower_name(settings: ExperimentSettings) -> str:
    """The list of members with the start of its SHA-256, such as ``report-tower 1a2b3c4d``, so that runs on an
    older list, or on another mesh, are told apart. Empty for a tower that is built from its dimensions."""
    if not (members := settings.tower.members):
        return ""
    return f"{Path(members).stem} {hashlib.sha256(settings.tower.file_bytes()).hexdigest()[:8]}"


def title(settings: ExperimentSettings, words: str = TITLE) -> str:
    """A figure's title: ``words`` with the columns of `case_of`, and the tower if it is not the flight's own."""
    own = TowerSettings.of_flight(settings.flight.trajectory)
    names = {TowerSettings.preset(name): f", tower {name}" for name in TOWERS} | {own: ""}
    return words.format_map(case_of(settings)) + names.get(settings.tower, ", a tower of your own")


def map_kind(settings: ExperimentSettings) -> str:
    """The kind of map of an odometry: ``weighted`` (means of all points), ``re-voxelised`` (the report's, which
    forgets), or ``bars``."""
    chosen = settings.odometry
    if isinstance(chosen, RegistrationSettings | LoamSettings):
        return "re-voxelised" if chosen.registration.map == "re-voxelised" else "weighted"
    return "re-voxelised" if isinstance(chosen, ReportCloudSettings) else "bars"


def table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """One row per run: its case, then its metrics."""
    return pd.DataFrame([{**case_of(result.settings), **result.metrics} for result in results])


def cloud_table(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """`table` with each run's kind of map, number of scans, and share of later scans without correspondences."""
    rows = table(results)
    rows.insert(list(rows).index("method") + 1, "map", [map_kind(result.settings) for result in results])
    rows["scans"] = [len(result.corrected) for result in results]
    rows["unused_share"] = [float((result.matches[1:] == 0).mean()) for result in results]
    return rows


def metrics(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, float]:
    """The finite metrics of all runs as a flat dictionary with the keys ``<values of by>.<metric>``."""
    return {f"{_name(r.settings, by)}.{k}": v for r in results for k, v in r.metrics.items() if np.isfinite(v)}


def provenance(results: Sequence[experiment.Result], by: Sequence[str] = ("noise", "method")) -> dict[str, Any]:
    """The settings of all runs, with the keys ``<values of by>``."""
    return {_name(result.settings, by): result.settings.model_dump() for result in results}


def _name(settings: ExperimentSettings, by: Sequence[str]) -> str:
    case = {**case_of(settings), "map": map_kind(settings)}
    return ".".join(str(case[name]) for name in by)


def stage_times(result: experiment.Result) -> dict[str, dict[str, float]]:
    """``median_ms`` and ``p95_ms`` (95th percentile) of the time per scan, for each stage and the whole ``frame``."""
    stages = {**result.seconds, "frame": np.sum(list(result.seconds.values()), axis=0)}
    times = {stage: np.percentile(1e3 * seconds, [50, 95]) for stage, seconds in stages.items()}
    return {stage: {"median_ms": float(median), "p95_ms": float(p95)} for stage, (median, p95) in times.items()}


def timing(results: Sequence[experiment.Result]) -> pd.DataFrame:
    """Milliseconds per frame (median and 95th percentile) of each run: of every stage, and of the whole frame."""
    return pd.DataFrame(
        {**case_of(result.settings), "stage": stage, **times}
        for result in results
        for stage, times in stage_times(result).items()
    )


def column_head(name: str) -> str:
    """The head of a column for a reader: words, and the unit in brackets. ``basin_radius_m`` is *basin radius (m)*."""
    words, _, unit = name.rpartition("_")
    return HEADS.get(name) or (f"{words} ({UNITS[unit]})" if words and unit in UNITS else name).replace("_", " ")


def readable(rows: pd.DataFrame, columns: Sequence[str] | None = None, digits: int = 3) -> pd.DataFrame:
    """Some ``columns`` of a table for display, without those that no run has: rounded, counts as integers, words as
    heads (`column_head`). The table itself, which files are written from, stays as it is."""
    shown = rows if columns is None else rows[[name for name in columns if name in rows]]
    whole = [name for name in shown.select_dtypes("number") if (shown[name].dropna() % 1 == 0).all()]
    counts = {name: "Int64" for name in whole if (shown[name].abs() > 1).any()}  # a share may be 1 everywhere
    shown = shown.astype(counts).round(digits)
    return shown.rename(columns=column_head).rename_axis(index=lambda name: column_head(name) if name else None)


def shared_seeds(runs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """The runs by which the methods of a case may be compared, since each flew all of their seeds. ``by`` names the
    columns of a case. Where no seed has all methods, those seeds are kept that most methods share."""
    kept = []
    for _, case in runs.groupby(list(by), observed=True, sort=False):
        flown = case.groupby("seed")["method"].agg(lambda methods: " ".join(sorted(set(methods))))
        sizes = flown.value_counts()
        chosen = max(sizes.index, key=lambda methods: (len(methods.split()), sizes[methods]))
        kept.append(case[case["seed"].map(flown) == chosen])
    return pd.concat(kept) if kept else runs


def flat(
    rows: pd.DataFrame, by: Sequence[str] = (), columns: Sequence[str] | None = None, prefix: str = ""
) -> dict[str, float]:
    """The finite numbers of a table as a flat dictionary with the keys ``<prefix><values of by>.<column>``. Without
    ``by``, the index stands in for the values."""
    keys = rows[list(by)].astype(str).agg(".".join, axis=1) if by and len(rows) else rows.index.astype(str)
    wanted = [name for name in rows if name not in by] if columns is None else columns
    named = {f"{prefix}{key}.{name}": rows[name].iloc[k] for k, key in enumerate(keys) for name in wanted}
    return {name: float(value) for name, value in named.items() if np.isfinite(value)}
