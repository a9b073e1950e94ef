"""The closing sentences of the notebooks on drift, odometry and structures: tables → Markdown.

What a sentence says, and not only its numbers, follows from the table.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from steelnb.report.batch import REPORT_SEGMENT_ODOMETRY, beside_report, ranking, seeds_text

REPORT_CLOUDS = {"icp": "bent", "icp-3dof": "straight", "gicp": "straight"}
"""Figures 3.7 to 3.9."""
CLAIMED_ORDER = ("icp", "icp-3dof", "gicp")
"""The report's methods, from worst to best as it ranks them."""
STRAIGHT_DEG = 1.0
INTACT_OFFSET_M, INTACT_BLUR_M = 0.25, 0.05
"""A cloud is intact if no slice is farther off, and its layers are no farther apart."""
DRIFT_TOLERANCE = 0.15
"""Relative difference up to which a root mean square over many seeds agrees with its model."""


def bullets(lines: Iterable[str]) -> str:
    """Sentences as a list in Markdown."""
    return "\n".join(f"- {line}" for line in lines)


def listed(names: Iterable[str]) -> str:
    """Names with commas, or ``none``."""
    return ", ".join(names) or "none"


def drift(rows: pd.DataFrame) -> str:
    """Three sentences on `world.drift_table`: the random walk after three minutes, the report's sentence, the model."""
    walk = rows[(rows["noise"] == "random-walk") & (rows["time_s"] == 180)]
    lines = []
    if len(walk):
        row = walk.iloc[0]
        lines = [
            f"At the report's level the random walk is {row['rms']:.2f} m off after 3 minutes (root mean square of "
            f"{row['seeds']} seeds), {row['expected_rms']:.2f} m by its model.",
            f"The report says about 1 m, beyond which are {row['share_above_1']:.1%} of the seeds: its sentence "
            f"{'agrees' if abs(row['rms'] - 1) < DRIFT_TOLERANCE else 'does not agree'} with its noise.",
        ]
    off = (rows["rms"] / rows["expected_rms"] - 1).abs().max()
    agrees = "as its model says" if off < DRIFT_TOLERANCE else "not as its model says"
    return bullets([*lines, f"Each noise drifts {agrees}: measured and expected differ by at most {off:.0%}."])


def segment_odometry(rows: pd.DataFrame) -> str:
    """Three sentences on runs of one flight, rows of `batch.cloud_table`: beside the report, beside no correction,
    scans without a known bar."""
    mean_m = REPORT_SEGMENT_ODOMETRY[rows["trajectory"].iloc[0]]["mean_m"]
    corrected = rows[rows["method"] != "none"]
    ordered = corrected.sort_values("error_mean_m", kind="stable")
    best, worst = (
        f"{row['error_mean_m']:.3f} m ({row['noise']}, {row['method']})" for _, row in ordered.iloc[[0, -1]].iterrows()
    )
    below = (corrected["error_mean_m"] <= mean_m).sum()
    helps = (corrected["ate_rmse_m"] < corrected["raw_ate_rmse_m"]).sum()
    return bullets(
        [
            f"The report's corrected error stays about {mean_m} m; here {below} of {len(corrected)} runs have a mean "
            f"at or below that, from {best} to {worst}.",
            f"{helps} of {len(corrected)} runs are better than no correction at all.",
            f"Up to {corrected['unused_share'].max():.0%} of the scans showed no bar that the map knew, which the "
            f"report calls losing sight; all this is of {seeds_text(rows['seed'])}, while notebook 08 has many.",
        ]
    )


def cloud_odometry(rows: pd.DataFrame, timing: pd.DataFrame, noise: str, methods: Sequence[str]) -> str:
    """A few sentences a flight on rows of `batch.cloud_table` and `batch.timing` with maps: the order of the
    ``methods``, claimed to be from worst to best; their ranges beside the report's; all methods; the time of GICP."""
    first = rows.drop_duplicates(["trajectory", "method"])
    switched = rows[rows.duplicated(["trajectory", "method"])]
    beside = beside_report(rows, noise)
    lines = [_ordered(row, methods) for row in ranking(rows, methods).to_dict("records")] if len(methods) > 1 else []
    for flight, own in first.groupby("trajectory", sort=False):
        mean = own.set_index("method")["error_mean_m"]
        worse = own.loc[own["ate_rmse_m"] > own["raw_ate_rmse_m"], "method"]
        ranges = [
            f"{row['method']} up to {row['error_max_m']:.2f} m, {row['report_high_m']:.2f} m in the report"
            for row in beside[beside["trajectory"] == flight].to_dict("records")
        ]
        maps = [
            f"{row['method']} from {mean[row['method']]:.3f} to {row['error_mean_m']:.3f} m"
            for row in switched[switched["trajectory"] == flight].to_dict("records")
        ]
        lines.append(
            f"**{flight}**: {mean.idxmin()} is the most accurate, {mean.min():.3f} m; worse than no correction (root "
            f"mean square): {listed(worse)}."
            + (f" Largest errors: {'; '.join(ranges)}." if ranges else "")
            + (f" The weighted map takes {', '.join(maps)}." if maps else "")
            + _time_of_gicp(timing[timing["trajectory"] == flight])
        )
    return bullets(lines)


def _ordered(row: Mapping, methods: Sequence[str]) -> str:
    claim = " < ".join(reversed(methods))
    agrees = "as the report says" if row["as_claimed"] else f"not as the report says ({claim})"
    return (
        f"**{row['trajectory']}**: by mean error {row['order']}, {agrees}; {row['pairs_as_claimed']:.0%} of the pairs "
        "are in the report's order."
    )


def _time_of_gicp(timing: pd.DataFrame) -> str:
    frames = timing[timing["stage"] == "frame"].drop_duplicates("method").set_index("method")["median_ms"]
    if not {"icp", "gicp"} <= set(frames.index):
        return ""
    ratio = frames["gicp"] / frames["icp"]
    return f" GICP takes {ratio:.1f} times as long as ICP a frame; the report: nearly 3."


def bent_clouds(bends: pd.DataFrame) -> str:
    """Three sentences on `batch.bend_summary`: the most bent cloud, the straight ones, the report's pictures."""
    bend = bends["bend_deg"]
    most, straight = str(bend.idxmax()), bend.index[bend < STRAIGHT_DEG]
    here = {name: "straight" if name in straight else "bent" for name in bend.index}
    agree = [name for name in here if REPORT_CLOUDS.get(name) == here[name]]
    differ = [f"{name} ({bend[name]:.1f}°)" for name in here if name in REPORT_CLOUDS and name not in agree]
    return bullets(
        [
            f"The cloud of {most} is bent most, by {bend[most]:.1f}°, and is off by up to "
            f"{bends['offset_max_m'][most]:.2f} m.",
            f"Straight to {STRAIGHT_DEG:g}°: {listed(straight)}.",
            "As in the report's pictures (ICP bent, 3-DoF ICP and GICP straight): "
            f"{listed(agree)}; not so: {listed(differ)}.",
        ]
    )


def false_convergence(basins: pd.DataFrame, flights: pd.DataFrame, rescued_final_m: float) -> str:
    """Three sentences on `false_convergence.basin_table` and `find_slips`; ``rescued_final_m`` is the final error of
    ``best`` on the scans of the worst flight."""
    widest, locked = str(basins["radius_m"].idxmax()), str(basins["locked_share"].idxmax())
    others = [f"{row['radius_m']:.2f} m with {label}" for label, row in basins.drop(widest).iterrows()]
    noticed = (
        f"{locked} locks onto something else without noticing from {basins['locked_share'][locked]:.0%} of the starts"
        if basins["locked_share"][locked] > 0
        else "none locks onto something else without noticing"
    )
    wrong, gap = flights["wrong"], flights["blind_s"] > 0
    row = flights.to_dict("records")[int(flights["wrong_share"].argmax())]
    worst = "The worst" if wrong.any() else "The one that came nearest to it"
    return bullets(
        [
            f"Every start within {basins['radius_m'][widest]:.2f} m converges to the truth with {widest}"
            + (f", within {', '.join(others)}" if others else "")
            + f"; {noticed}.",
            f"{wrong.sum()} of {len(flights)} flights converged wrongly: {(wrong & ~gap).sum()} of {(~gap).sum()} with "
            f"the tower always in sight, {(wrong & gap).sum()} of {gap.sum()} with gaps.",
            f"{worst} ({row['trajectory']}, {row['noise']}, seed {row['seed']}, {row['max_correspondence_m']:g} m) "
            f"slips by {row['slip_m']:.2f} m within a second at {row['slip_s']:.0f} s and ends "
            f"{row['error_final_m']:.2f} m off; best, on the same scans, {rescued_final_m:.2f} m.",
        ]
    )


def yaw_drift(rows: pd.DataFrame, bends: pd.DataFrame) -> str:
    """Two sentences a flight on rows of `batch.cloud_table`, and one on `batch.bend_summary` of some clouds: errors
    beside no correction, the report's order, and whether the cloud of GICP is intact."""
    ate = rows.pivot_table(index="method", columns="trajectory", values="ate_rmse_m", sort=False)
    claimed = [name for name in CLAIMED_ORDER if name in ate.index]
    order = ranking(rows, claimed).set_index("trajectory") if len(claimed) > 1 else pd.DataFrame()
    lines = []
    for flight in map(str, ate.columns):
        none, own = ate[flight]["none"], ate[flight].drop("none").sort_values()
        line = (
            f"**{flight}**: root mean square errors from {own.iloc[0]:.3f} m ({own.index[0]}) to {own.iloc[-1]:.3f} m "
            f"({own.index[-1]}); no correction {none:.3f} m. Better than none: {listed(own.index[own < none])}."
        )
        if flight in order.index:
            holds = "holds" if order["as_claimed"][flight] else "does not hold"
            line += f" The report's order, {' < '.join(reversed(claimed))}, {holds}: {order['order'][flight]}."
        lines.append(line)
    if "gicp" in bends.index:
        gicp = bends.loc["gicp"]
        intact = gicp["offset_max_m"] < INTACT_OFFSET_M and gicp["blur_mean_m"] < INTACT_BLUR_M
        fixed = (
            f" The cloud of 3-DoF ICP, which cannot turn back, turns by up to {bends['yaw_max_deg']['icp-3dof']:.1f}°."
            if "icp-3dof" in bends.index
            else ""
        )
        lines.append(
            f"The cloud of GICP, intact in the report, is {'intact' if intact else 'not intact'} here: it turns by up "
            f"to {gicp['yaw_max_deg']:.1f}°, tilts by up to {gicp['tilt_max_deg']:.1f}° and is off by up to "
            f"{gicp['offset_max_m']:.2f} m.{fixed}"
        )
    return bullets(lines)


def recording(numbers: Mapping[str, float]) -> str:
    """Two sentences on the numbers of a corrected recording, the second where its truth is there."""
    used = f"Of {numbers['frames']} scans, {numbers['used']} corrected the pose."
    if "corrected_ate_rmse_m" not in numbers:
        return f"{used} There is no truth beside this recording, so nothing is said of errors."
    prior_m, corrected_m = numbers["prior_ate_rmse_m"], numbers["corrected_ate_rmse_m"]
    removed = numbers.get("drift_removed_percent", 0.0)
    change = f"{removed:.0f} % of the drift is gone" if removed > 0 else "the correction did not help"
    return (
        f"{used} The recorded poses are off by {100 * prior_m:.1f} cm (ATE), the corrected ones by "
        f"{100 * corrected_m:.1f} cm: {change}."
    )


def structure(rows: pd.DataFrame, near_side: pd.DataFrame, goals: pd.DataFrame) -> str:
    """Four sentences on `structure_tables.structure_table` of one flight, `near_side_summary` and `structure_goals`:
    corrected poses beside drifting and true ones, frame by frame, the near side, the goals."""
    of: dict[Any, dict[Any, float]] = rows.set_index(["poses", "method"]).to_dict("index")
    fixed, raw, true = (of[poses, "final"] for poses in ("corrected", "raw", "true"))
    live = of["corrected", "incremental"]
    median_cm = 100 * near_side[near_side["kind"] == "all"].set_index("axis")["median_m"]
    return bullets(
        [
            f"Corrected poses (ATE {100 * fixed['ate_rmse_m']:.1f} cm) give {fixed['bars']:.0f} bars and "
            f"{fixed['joints']:.0f} joints: {fixed['recall']:.0%} of the {fixed['observed']:.0f} members observed, "
            f"{fixed['precision']:.0%} of the bars on a member, axes off by {100 * fixed['offset_median_m']:.1f} cm "
            f"(median); {fixed['joint_recall']:.0%} of the {fixed['joints_observed']:.0f} joints, off by "
            f"{100 * fixed['joint_error_median_m']:.1f} cm. The drifting poses (ATE {100 * raw['ate_rmse_m']:.1f} cm) "
            f"give a recall of {raw['recall']:.0%}, the true ones {true['recall']:.0%}.",
            f"Frame by frame, the same corrected poses give a recall of {live['recall']:.0%}, a precision of "
            f"{live['precision']:.0%} and axes off by {100 * live['offset_median_m']:.1f} cm.",
            f"Bars in the middle of their points lie {median_cm['middle of points']:.1f} cm nearer to the sensor than "
            f"the members (median); with the section fitted, {median_cm['section fitted']:+.1f} cm.",
            _reached(goals),
        ]
    )


def structure_over_seeds(rows: pd.DataFrame, goals: pd.DataFrame) -> str:
    """Three sentences on rows of `structure_tables.structure_table`, whose first method is judged by the ``goals``:
    means and worst, goals, and the near side of each method and tower."""
    method = rows["method"].iloc[0]
    own, towers = rows[rows["method"] == method], rows["tower"].unique()
    nearer_cm = 100 * rows.groupby(["method", "tower"], sort=False)["toward_sensor_median_m"].mean()
    by_tower = "; ".join(
        f"{name} {', '.join(f'{tower} {value:+.1f}' for tower, value in nearer_cm[name].items())}"
        for name in rows["method"].unique()
    )
    return bullets(
        [
            f"{method}, mean (worst) of {len(own)} flights over {len(towers)} towers: recall "
            f"{own['recall'].mean():.2f} ({own['recall'].min():.2f}), precision {own['precision'].mean():.2f} "
            f"({own['precision'].min():.2f}), axes off by {100 * own['offset_median_m'].mean():.1f} cm "
            f"({100 * own['offset_median_m'].max():.1f}), joints by "
            f"{100 * own['joint_error_median_m'].mean():.1f} cm ({100 * own['joint_error_median_m'].max():.1f}).",
            _reached(goals),
            f"Axes lie nearer to the sensor than the true ones by (cm, median): {by_tower}.",
        ]
    )


def _reached(goals: pd.DataFrame) -> str:
    missed = goals.loc[~goals["reached"], "goal"]
    return f"{goals['reached'].sum()} of {len(goals)} goals are reached; not reached: {listed(missed)}."


def accuracy(summary: pd.DataFrame, runs: pd.DataFrame, goal_m: float) -> str:
    """Three sentences a method on `study_figures.summarise` of runs without and with gaps in sight."""
    lines = []
    for name, own in summary.groupby("method", sort=False):
        blind = own["case"].str.endswith("blind")
        seen, mean_cm = own[~blind], 100 * own.loc[~blind, "ate_mean_m"]
        its = runs[runs["method"] == name]
        ms, s = (its[columns].median() for columns in (["frame_median_ms", "frame_p95_ms"], ["duration_s", "seconds"]))
        gaps = f" Through gaps, the worst seed is off by {100 * own.loc[blind, 'ate_worst_m'].max():.1f} cm."
        lines.append(
            f"**{name}**: mean ATE {mean_cm.min():.1f} to {mean_cm.max():.1f} cm, worst seed "
            f"{100 * seen['ate_worst_m'].max():.1f} cm; the goal of {100 * goal_m:g} cm is reached under "
            f"{(seen['ate_mean_m'] <= goal_m).sum()} of {len(seen)} noises."
            + (gaps if blind.any() else "")
            + f" A frame takes {ms.iloc[0]:.1f} ms, p95 {ms.iloc[1]:.1f} ms; "
            f"a flight of {s.iloc[0]:g} s takes {s.iloc[1]:.0f} s."
        )
    return bullets(lines)
