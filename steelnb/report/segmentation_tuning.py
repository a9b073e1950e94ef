"""Notebook 07: the Hough transform over its two parameters, and rules for dx that need no tuning."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from steelnb.hough import suggest_dx
from steelnb.report.batch import flat
from steelnb.report.segmentation import MEASURES, Scene, attempt, over_cases, trial_table
from steelnb.settings import SegmentationSettings
from steelnb.types import Array

FIXED, CHOSEN, REFERENCE = "fixed", "from the points", "diagonal/64"
"""Origin of a dx of `tuning_map`: given, `steelnb.hough.suggest_dx`, or the reference program's default."""


def tuning_map(scenes: Mapping[float, Sequence[Scene]], dx: Sequence[float], min_votes: Sequence[int]) -> pd.DataFrame:
    """Hough on the scenes of each noise with every dx × every least number of votes: means over all frames, a row each.

    The two rules for dx that need no tuning are tried too; ``dx_m`` is then their mean, and ``rule`` says which.
    """
    rules = [*((FIXED, width) for width in dx), (CHOSEN, math.nan), (REFERENCE, math.nan)]
    rows = []
    for noise_m, (rule, width), votes in itertools.product(scenes, rules, min_votes):
        settings = SegmentationSettings(points_min=votes)
        own = [_dx(rule, width, scene.points) for scene in scenes[noise_m]]
        trials = [
            attempt("hough", scene, settings=settings, dx=each)
            for scene, each in zip(scenes[noise_m], own, strict=True)
        ]
        means = over_cases(trial_table(trials)).iloc[0][list(MEASURES)].to_dict()
        rows.append({"noise_m": noise_m, "rule": rule, "dx_m": float(np.mean(own)), "min_votes": votes, **means})
    return pd.DataFrame(rows)


def _dx(rule: str, width: float, points: Array) -> float:
    if rule == CHOSEN:
        return suggest_dx(points)
    return width if rule == FIXED else float(np.linalg.norm(np.ptp(points, axis=0))) / 64


def cost_of_rules(tuning: pd.DataFrame) -> pd.DataFrame:
    """The loss of each rule for dx against the best fixed dx of each noise and least number of votes.

    The best has the largest mean of recall and precision. Columns: ``best_dx_m``, ``dx_m`` of the rule, and how much
    ``recall`` and ``precision`` are below the best one's.
    """
    by = ["noise_m", "min_votes"]
    fixed = tuning[tuning["rule"] == FIXED]
    best = fixed.loc[(fixed["recall"] + fixed["precision"]).groupby([fixed[name] for name in by]).idxmax()]
    cost = (
        tuning[tuning["rule"] != FIXED]
        .merge(best, on=by, suffixes=("", "_best"))
        .rename(columns={"dx_m_best": "best_dx_m"})
    )
    for name in ("recall", "precision"):
        cost[f"{name}_lost"] = cost[f"{name}_best"] - cost[name]
    return cost[[*by, "rule", "best_dx_m", "dx_m", "recall_lost", "precision_lost"]]


def rule_metrics(cost: pd.DataFrame) -> dict[str, float]:
    """The numbers of `cost_of_rules` in one flat map, ``<rule>.<noise>_cm.<name>``."""
    rules = cost["rule"].map({CHOSEN: "dx_from_points", REFERENCE: "dx_of_reference"})
    named = cost.assign(rule=rules, noise=[f"{100 * noise_m:g}_cm" for noise_m in cost["noise_m"]])
    return flat(named, ("rule", "noise"), ("dx_m", "recall_lost", "precision_lost"))
