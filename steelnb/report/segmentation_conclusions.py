"""The closing sentences of notebooks 07 and 13: tables on methods of segmentation → Markdown."""

from collections.abc import Mapping

import pandas as pd

from steelnb.report.conclusions import bullets, listed
from steelnb.report.segmentation import NOISE_M
from steelnb.report.segmentation_tuning import CHOSEN, FIXED, REFERENCE

GOOD = 0.05
"""A setting is good where recall and precision are less than this below their best."""
EFFECTIVE_RECALL = 0.5
"""A method that finds less than half of the bars is called ineffective."""
SLOW = 3.0
"""A method that takes this many times as long as the Hough transform is called slow."""
GOALS = {"recall": 0.95, "precision": 0.98, "duplicates": 1.0, "angle_deg": 0.4, "offset_m": 0.012}
"""For the Hough transform over seeds: at least this recall and precision, at most this of the others."""


def tuning(votes: pd.DataFrame, cost: pd.DataFrame) -> str:
    """Three sentences on `tuning_map` over votes and `cost_of_rules` over noises: how many settings are good, and what
    the two rules for dx lose."""
    fixed, spans = votes[votes["rule"] == FIXED], ""
    good = fixed[
        (fixed["recall"] > fixed["recall"].max() - GOOD) & (fixed["precision"] > fixed["precision"].max() - GOOD)
    ]
    if len(good):
        low, high = good[["dx_m", "min_votes"]].min(), good[["dx_m", "min_votes"]].max()
        spans = (
            f", from dx {100 * low['dx_m']:g} to {100 * high['dx_m']:g} cm and from {low['min_votes']:g} to "
            f"{high['min_votes']:g} votes"
        )
    own, lost = cost[cost["noise_m"] == NOISE_M].set_index("rule"), ["recall_lost", "precision_lost"]
    most = cost[cost["rule"] == CHOSEN][lost].max()
    lines = [f"Recall and precision stay within {GOOD} of their best at {len(good)} of {len(fixed)} settings{spans}."]
    for rule, name in ((CHOSEN, "The dx from the points"), (REFERENCE, "The reference program's default")):
        if rule in own.index:
            recall, precision = own.loc[rule, lost]
            lines.append(
                f"{name} ({100 * own['dx_m'][rule]:.1f} cm) loses {recall:.3f} of recall and {precision:.3f} of "
                f"precision to the best fixed one ({100 * own['best_dx_m'][rule]:g} cm)."
            )
    lines.append(
        f"Over all noises the dx from the points loses at most {most['recall_lost']:.3f} and "
        f"{most['precision_lost']:.3f}."
    )
    return bullets(lines)


def reasons(
    scores: pd.DataFrame, ms: Mapping[str, float], tower: pd.DataFrame, noisy: pd.DataFrame, cost: pd.DataFrame
) -> str:
    """The report's reasons for the Hough transform, one by one, for the methods that were run.

    ``scores`` and ``tower`` are `segmentation.over_cases`, by method, of single frames and of the whole tower at once;
    ``noisy`` of the conditions with the most noise; ``ms`` the median milliseconds of a frame; ``cost`` that of
    `cost_of_rules`.
    """
    recall, precision, lines = scores["recall"], scores["precision"], []
    if "ransac-planes" in scores.index:
        lines.append(
            '**RANSAC is "limited to separating planes and is computationally intensive".** For planes, '
            f"{_no_bars(recall['ransac-planes'])}: recall {recall['ransac-planes']:.2f} in {ms['ransac-planes']:.0f} "
            f"ms, where Hough has {recall['hough']:.3f} in {ms['hough']:.0f} ms; a face of a lattice is one plane and "
            "many bars."
        )
    if "ransac-lines" in scores.index:
        close = all(score["ransac-lines"] > score["hough"] - GOOD for score in (recall, precision))
        lines.append(
            f"For lines, which the report does not mention, {'no' if close else 'yes'}: recall "
            f"{recall['ransac-lines']:.3f}, precision {precision['ransac-lines']:.3f} in {ms['ransac-lines']:.0f} ms, "
            f"where Hough has {recall['hough']:.3f} and {precision['hough']:.3f}."
            + (
                f" Its two points are drawn near each other; drawn anywhere, they give "
                f"{recall['ransac-lines-uniform']:.3f} and {precision['ransac-lines-uniform']:.3f}."
                if "ransac-lines-uniform" in scores.index
                else ""
            )
        )
    if "dbscan" in scores.index:
        ratio = ms["dbscan"] / ms["hough"]
        lines.append(
            '**DBSCAN is "time-consuming and ineffective for segmenting individual metal beams".** Ineffective, '
            f"{_no_bars(recall['dbscan'])}: recall {recall['dbscan']:.2f}; bars touch at their joints, and a face is "
            f"one cluster. Time-consuming, {'yes' if ratio > SLOW else 'hardly'}: {ms['dbscan']:.0f} ms, "
            f"{ratio:.1f} times what Hough takes."
        )
    if "gmm" in scores.index:
        told = f"; told twice the number of bars, {recall['gmm-told']:.2f}" if "gmm-told" in scores.index else ""
        lines.append(
            '**GMM "requires prior knowledge of the number of clusters and struggles with complex arrangements", and '
            f"is time-consuming.** {'Yes' if recall['gmm'] < recall['hough'] - GOOD else 'No'}: with the number chosen "
            f"by the Bayesian information criterion, its recall is {recall['gmm']:.2f}{told}, its precision "
            f"{precision['gmm']:.2f}. It takes {ms['gmm'] / ms['hough']:.0f} times the time of Hough."
        )
    row = noisy.set_index("method").loc["hough"]
    robust = row["recall"] > recall["hough"] - 2 * GOOD and row["precision"] > precision["hough"] - 2 * GOOD
    blocks = f", {tower['recall']['hough-blocks']:.2f} in blocks" if "hough-blocks" in tower.index else ""
    lines.append(
        f'**The Hough transform shows "robustness to noise" and "accurate line parameters".** '
        f"{'Yes' if robust else 'No'}: with {100 * row['noise_m']:g} cm of noise recall {row['recall']:.2f}, precision "
        f"{row['precision']:.2f}, median angle {row['angle_deg']:.2f}°, median offset {100 * row['offset_m']:.1f} cm. "
        f"On a whole tower at once its recall is {tower['recall']['hough']:.2f}{blocks}."
    )
    lost = cost[cost["noise_m"] == NOISE_M].set_index("rule")["recall_lost"]
    lines.append(
        '**"It requires careful tuning of parameters like … dx and … minvotes".** Of dx, '
        f"{'yes' if lost[REFERENCE] > GOOD else 'no'}: with the reference program's default recall falls by "
        f"{lost[REFERENCE]:.2f}. The points themselves tell one that loses {lost[CHOSEN]:.3f}."
    )
    return bullets(lines)


def _no_bars(recall: float) -> str:
    return "yes" if recall < EFFECTIVE_RECALL else "no"


def reached_goals(means: pd.DataFrame) -> list[str]:
    """The `GOALS` that the Hough transform reaches, in `segmentation.over_cases` by method."""
    hough, larger = means.loc["hough"], ("recall", "precision")  # is better
    return [name for name, goal in GOALS.items() if (hough[name] >= goal if name in larger else hough[name] <= goal)]


def goal_metrics(means: pd.DataFrame) -> dict[str, float]:
    """The number of `GOALS`, and how many of them are reached."""
    return {"goals_reached": len(reached_goals(means)), "goals": len(GOALS)}


def over_seeds(means: pd.DataFrame, ms: Mapping[str, float], seeds: int) -> str:
    """A sentence a method on `segmentation.over_cases` by method and median milliseconds of a frame, then the goals."""
    hough, reached = means.loc["hough"], reached_goals(means)
    lines = [
        f"`{name}`: recall {means['recall'][name]:.3f}, precision {means['precision'][name]:.3f}, {ms[name]:.0f} ms a "
        f"frame, {ms[name] / ms['hough']:.1f} times the time of Hough."
        for name in map(str, means.index)
    ]
    return bullets(
        [
            *lines,
            f"Over {seeds} seeds Hough has {hough['duplicates']:.2f} duplicates a frame, a median angle of "
            f"{hough['angle_deg']:.2f}° and a median offset of {100 * hough['offset_m']:.1f} cm: {len(reached)} of "
            f"{len(GOALS)} goals are reached; not reached: {listed(name for name in GOALS if name not in reached)}.",
        ]
    )
