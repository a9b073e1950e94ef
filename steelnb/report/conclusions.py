"""The closing sentences of the notebooks: tables → Markdown.

What a sentence says, and not only its numbers, follows from the table.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from steelnb.report.batch import ranking
from steelnb.report.style import LABELS

CLAIMED_ORDER = ("icp", "icp-3dof", "gicp")
"""The report's methods, from worst to best as it ranks them."""
DRIFT_TOLERANCE = 0.15
"""Relative difference up to which a root mean square over many seeds agrees with its model."""
AS_THE_REPORT = 0.3
"""Relative difference up to which the mean error of a run agrees with that of the report's curve."""
GOOD = 0.05
"""A setting is good where recall and precision are less than this below their best."""


def bullets(lines: Iterable[str]) -> str:
    """Sentences as a list in Markdown."""
    return "\n".join(f"- {line}" for line in lines)


def listed(names: Iterable[str]) -> str:
    """Names with commas, or ``none``."""
    return ", ".join(names) or "none"


def ascending(values: pd.Series, factor: float = 1.0, unit: str = "", digits: int = 1) -> str:
    """Named values from the smallest up, without those that are not known: ``best 2.1, GICP 30.4 cm``."""
    known = values.dropna().sort_values(kind="stable")
    said = [f"{LABELS.get(str(name), name)} {factor * value:.{digits}f}" for name, value in known.items()]
    return f"{', '.join(said)} {unit}".rstrip()


def ranked(
    rows: pd.DataFrame, by: str = "trajectory", column: str = "ate_rmse_m", factor: float = 100.0, unit: str = "cm"
) -> list[str]:
    """A sentence for each value of ``by``: the mean of a column for each method, and the methods whose root mean square
    error exceeds that of the drift."""
    lines = []
    for group, own in rows.groupby(by, sort=False, observed=True):
        means = own.groupby("method", sort=False)[list({column, "ate_rmse_m", "raw_ate_rmse_m"})].mean()
        worse = [LABELS[str(name)] for name in means.index[means["ate_rmse_m"] > means["raw_ate_rmse_m"]]]
        end = f"; worse than no correction: {', '.join(worse)}" if worse else ""
        lines.append(f"**{group}**: {ascending(means[column], factor, unit)}{end}.")
    return lines


def orders(rows: pd.DataFrame, methods: Sequence[str]) -> list[str]:
    """A sentence for each flight and noise on the order of ``methods``, which is claimed to be from worst to best; none
    unless there are runs of all of them."""
    claim, known = " < ".join(reversed(methods)), set(methods) <= set(rows["method"])
    return [
        f"**{row['trajectory']}**: by mean error {row['order']}, "
        + ("as the report says." if row["as_claimed"] else f"not as the report says ({claim}).")
        for row in (ranking(rows, methods).to_dict("records") if len(methods) > 1 and known else [])
    ]


def drift(rows: pd.DataFrame) -> str:
    """On `world.drift_table`: the random walk after three minutes beside the report's sentence, and the models."""
    lines = [
        f"At the report's level the random walk is {row['rms']:.2f} m off after 3 minutes (root mean square of "
        f"{row['seeds']} seeds), {row['expected_rms']:.2f} m by its model; the report says about 1 m, beyond which are "
        f"{row['share_above_1']:.1%} of the seeds."
        for row in rows[(rows["noise"] == "random-walk") & (rows["time_s"] == 180)].to_dict("records")
    ]
    off = (rows["rms"] / rows["expected_rms"] - 1).abs().max()
    agrees = "as its model says" if off < DRIFT_TOLERANCE else "not as its model says"
    return bullets([*lines, f"Each noise drifts {agrees}: measured and expected differ by at most {off:.0%}."])


def segment_odometry(rows: pd.DataFrame) -> str:
    """On runs of one flight, rows of `batch.report_table`: errors beside the report's, scans without a known bar."""
    corrected = rows[rows["method"] != "none"]
    return bullets(
        [
            *ranked(corrected, "noise", "error_mean_m"),
            *beside_report(corrected),
            f"Up to {corrected['unused_share'].max():.0%} of the scans showed no bar that the map knew.",
        ]
    )


def beside_report(rows: pd.DataFrame) -> list[str]:
    """A sentence for each run of `batch.report_table` whose experiment the report shows: mean, largest and last error
    of both, and whether their means agree."""
    lines = []
    for row in rows.dropna(subset=["report_mean_m"]).to_dict("records"):
        ours, report = (
            " / ".join(f"{row[f'{whose}_{name}_m']:.3f}" for name in ("mean", "max", "final"))
            for whose in ("error", "report")
        )
        off = row["error_mean_m"] / row["report_mean_m"] - 1
        agrees = f"within {AS_THE_REPORT:.0%} of it" if abs(off) <= AS_THE_REPORT else f"{1 + off:.1f} times it"
        lines.append(
            f"**{row['trajectory']}**, {LABELS[row['method']]}: mean / largest / last error {ours} m; the report's "
            f"curve {report} m; the mean is {agrees}."
        )
    return lines


def cloud_odometry(rows: pd.DataFrame, timing: pd.DataFrame, methods: Sequence[str]) -> str:
    """On rows of `batch.report_table` and `batch.timing`: the report's programs beside its curves; the order of
    ``methods``, claimed to be from worst to best, of the programs, and of the report's own curves; errors, and the time
    of GICP."""
    programs = [f"report-{name}" for name in methods]
    own = rows[rows["method"].isin(programs)]
    shown = own.assign(error_mean_m=own["report_mean_m"]).dropna(subset=["report_mean_m"])
    frames = timing[timing["stage"] == "frame"].groupby("method")["median_ms"].median()
    lines = [
        *beside_report(own),
        *(f"The report's curves, {line}" for line in orders(shown, programs)),
        *(line for names in (programs, methods) for line in orders(rows, names)),
        *ranked(rows.drop_duplicates(["trajectory", "method"]), column="error_mean_m"),
    ]
    if {"icp", "gicp"} <= set(frames.index):
        lines.append(f"GICP takes {frames['gicp'] / frames['icp']:.1f} times as long as ICP; the report: nearly 3.")
    return bullets(lines)


def bent_clouds(bends: pd.DataFrame) -> str:
    """On `batch.bend_summary`: the bend of each cloud, and the report's pictures."""
    return bullets(
        [
            f"Bend of the clouds: {ascending(bends['bend_deg'], unit='°')}. In the report's pictures that of ICP is "
            "bent, those of 3-DoF ICP and GICP are straight.",
            f"Largest offset of a slice: {ascending(bends['offset_max_m'], unit='m', digits=2)}.",
        ]
    )


def false_convergence(basins: pd.DataFrame, flights: pd.DataFrame, rescued_final_m: float) -> str:
    """On `false_convergence.basin_table` and `find_slips`; ``rescued_final_m`` is the final error of ``best`` on the
    scans of the worst flight."""
    wrong, gap = flights["wrong"], flights["blind_s"] > 0
    row = flights.to_dict("records")[int(flights["wrong_share"].argmax())]
    return bullets(
        [
            f"Every start converges to the truth within {ascending(basins['radius_m'], unit='m', digits=2)}.",
            f"{wrong.sum()} of {len(flights)} flights converged wrongly: {(wrong & ~gap).sum()} of {(~gap).sum()} with "
            f"the tower always in sight, {(wrong & gap).sum()} of {gap.sum()} with gaps.",
            f"The one that was off most often ({LABELS[row['method']]}, {row['max_correspondence_m']:g} m, "
            f"{row['trajectory']}, {row['noise']}, seed {row['seed']}) slips by {row['slip_m']:.2f} m within a second "
            f"and ends {row['error_final_m']:.2f} m off; best, on the same scans, {rescued_final_m:.2f} m.",
        ]
    )


def yaw_drift(rows: pd.DataFrame, bends: pd.DataFrame) -> str:
    """On rows of `batch.cloud_table` and `batch.bend_summary` of some clouds: errors, the report's order, clouds."""
    claimed = [name for name in CLAIMED_ORDER if name in set(rows["method"])]
    turns = f"Clouds turn by up to {ascending(bends['yaw_max_deg'], unit='°')}; that of GICP is intact in the report."
    return bullets([*ranked(rows), *orders(rows, claimed), turns])


def segmentation(means: pd.DataFrame, ms: Mapping[str, float]) -> str:
    """A sentence a method on `segmentation.over_cases` by method and the median milliseconds of a frame."""
    return bullets(
        f"`{name}`: recall {row['recall']:.3f}, precision {row['precision']:.3f}, {ms[name]:.0f} ms a frame, "
        f"{ms[name] / ms['hough']:.1f} times the time of Hough."
        for name, row in zip(map(str, means.index), means.to_dict("records"), strict=True)
    )


def noise_and_tuning(noisy: pd.DataFrame, votes: pd.DataFrame, rules: pd.DataFrame) -> str:
    """On the cases of `segmentation.over_cases` with the most noise, and on the rows of `segmentation.tuning_map` that
    have a fixed dx or, ``rules``, one that needs no tuning."""
    row = noisy.set_index("method").loc["hough"]
    best = votes[["recall", "precision"]].max()
    good = (votes[["recall", "precision"]] > best - GOOD).all(axis=1).sum()
    lost = [
        f"{rule} ({100 * own['dx_m'].mean():.1f} cm) {best['recall'] - own['recall'].max():.2f}"
        for rule, own in rules.groupby("rule", sort=False)
    ]
    return bullets(
        [
            f"With {100 * row['noise_m']:g} cm of noise Hough has a recall of {row['recall']:.2f} and a precision of "
            f"{row['precision']:.2f}, a median angle of {row['angle_deg']:.2f}°, a median offset of "
            f"{100 * row['offset_m']:.1f} cm.",
            f"Recall and precision stay within {GOOD} of their best at {good} of {len(votes)} settings of dx and "
            f"votes. Without tuning, dx loses of recall: {', '.join(lost)}.",
        ]
    )


def recording(numbers: Mapping[str, float]) -> str:
    """On the numbers of a corrected recording; of errors where its truth is there."""
    used = f"Of {numbers['frames']} scans, {numbers['used']} corrected the pose."
    if "corrected_ate_rmse_m" not in numbers:
        return f"{used} There is no truth beside this recording, so nothing is said of errors."
    prior_m, corrected_m = numbers["prior_ate_rmse_m"], numbers["corrected_ate_rmse_m"]
    change = "less" if corrected_m < prior_m else "no less"
    return (
        f"{used} The recorded poses are off by {100 * prior_m:.1f} cm (ATE), the corrected ones by "
        f"{100 * corrected_m:.1f} cm, {change} than those."
    )


def structure(rows: pd.DataFrame, near_side: pd.DataFrame, goals: pd.DataFrame) -> str:
    """On `structure_tables.structure_table` of one flight, `near_side_summary` and `structure_goals`."""
    median_cm = near_side[near_side["kind"] == "all"].set_index("axis")["median_m"]
    return bullets(
        [
            *(
                f"{row['poses']} poses (ATE {100 * row['ate_rmse_m']:.1f} cm), {row['method']}: recall "
                f"{row['recall']:.2f}, precision {row['precision']:.2f}, axes off by "
                f"{100 * row['offset_median_m']:.1f} cm (median), recall of joints {row['joint_recall']:.2f}."
                for row in rows.to_dict("records")
            ),
            f"Bars lie nearer to the sensor than the members by (median): {ascending(median_cm, 100, 'cm')}.",
            reached(goals),
        ]
    )


def structure_over_seeds(rows: pd.DataFrame, goals: pd.DataFrame) -> str:
    """On rows of `structure_tables.structure_table`, whose first method is judged by the ``goals``."""
    lines = [
        f"{method}, mean of {len(own)} flights over {own['tower'].nunique()} towers: recall "
        f"{own['recall'].mean():.2f}, precision {own['precision'].mean():.2f}, axes off by "
        f"{100 * own['offset_median_m'].mean():.1f} cm."
        for method, own in rows.groupby("method", sort=False)
    ]
    return bullets([*lines, reached(goals)])


def reached(goals: pd.DataFrame) -> str:
    """The goals that are reached, of a table with the columns ``goal`` and ``reached``."""
    missed = goals.loc[~goals["reached"], "goal"]
    return f"{goals['reached'].sum()} of {len(goals)} goals are reached; not reached: {listed(missed)}."


def accuracy(runs: pd.DataFrame, other: pd.DataFrame, goal_m: float) -> str:
    """On runs of a study by ``case``, and on those in other worlds by ``world``: mean errors, and the goal."""
    means = runs[~runs["case"].str.endswith("blind")].groupby(["case", "method"])["ate_rmse_m"].mean()
    goal = f"{(means <= goal_m).sum()} of {len(means)} means without gaps reach the goal of {100 * goal_m:g} cm."
    return bullets([*ranked(runs, "case"), goal, *ranked(other, "world")])


def honest(faults: pd.DataFrame, table: pd.DataFrame) -> str:
    """On `honest.error_table` and `honest.honest_table`."""
    cost = table.pivot_table("ate_mean_m", "case", "method", sort=False)
    return bullets(
        [
            f"Median size of the range error: {ascending(faults.set_index('fault')['median_mm'], unit='mm')}.",
            *(f"Mean ATE, {case}: {ascending(row, 100, 'cm')}." for case, row in cost.iterrows()),
        ]
    )


def planned_flights(table: pd.DataFrame) -> str:
    """On `planned_flights.flight_table`: sight, error and coverage."""
    of: Any = table.set_index("flight")
    return bullets(
        [
            f"Scans that have lost sight: {ascending(of['few_share'], 100, '%')}.",
            f"Error of the corrected position (ATE): {ascending(of['ate_rmse_m'], 1e3, 'mm', 0)}.",
            f"Share of the steel seen: {ascending(of['seen_share'], 100, '%')}.",
        ]
    )


def literature(runs: pd.DataFrame, other: str = "combined") -> str:
    """On `literature.literature_runs`: the error of each method beside that of another, on the flights of both."""
    case = ["sensor", "trajectory", "noise"]
    both = runs.merge(runs.loc[runs["method"] == other, [*case, "seed", "ate_rmse_m"]], on=[*case, "seed"])
    means = both.groupby([*case, "method"], sort=False)[["ate_rmse_m_x", "ate_rmse_m_y"]].mean()
    ratio = (means["ate_rmse_m_x"] / means["ate_rmse_m_y"]).map(math.log).groupby(["sensor", "method"]).mean()
    return bullets(
        f"Sensor {sensor}, error in multiples of that of {LABELS[other]} on the same flights (geometric mean): "
        f"{ascending(own.droplevel('sensor').map(math.exp))}."
        for sensor, own in ratio.groupby("sensor", sort=False)
    )
