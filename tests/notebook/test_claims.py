"""Verdicts on claims, over made-up runs whose verdicts are known."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

from steelnb.core.errors import InputError
from steelnb.notebook.claims import (
    FAILS,
    HOLDS,
    NOT_RUN,
    OPEN,
    USUAL,
    Claim,
    claim_cells,
    interval,
    judge,
    read_claims,
    verdict_table,
)
from steelnb.notebook.frames import frame_runs
from steelnb.notebook.report import sample_runs

ROOT = Path(__file__).parents[2]
NOISES = ("random-walk", "constant-drift")


def runs(error, seeds=30, methods=("one", "two"), **more) -> pd.DataFrame:
    """A run for each flight, noise, method and seed, its error as a function of these and of normal noise."""
    random = np.random.default_rng(5)
    rows = []
    for seed in range(seeds):
        common = random.normal()  # what a seed does to both methods: pairing takes it out
        for trajectory in ("zigzag", "loops"):
            for noise in NOISES:
                for method in methods:
                    case = {"trajectory": trajectory, "noise": noise, "method": method, "seed": seed}
                    value = error(trajectory, noise, method, random.normal()) + 10 * common
                    numbers = {"error_mean_m": value, "by_seed": common}
                    rows.append({**USUAL, "variant": "", **case, "status": "ok", **numbers, **more})
    return pd.DataFrame(rows)


def better(where=lambda trajectory, noise: True, by=0.5) -> pd.DataFrame:
    """Runs in which method two is better than one by a given amount in some cells, and equal elsewhere."""
    return runs(lambda t, n, method, z: (by if method == "one" and where(t, n) else 0.0) + 0.1 * z)


def claim(**changes) -> Claim:
    given = {
        "topic": "t", "section": "1", "claim": "two is better than one", "metric": "error_mean_m",
        "comparison": "below", "threshold": [0.0], "a": {"method": "two"}, "b": {"method": "one"},
    }  # fmt: skip
    return Claim(**{**given, **changes})


class Judged(NamedTuple):
    """Result of judging one claim: its verdict, its largest number of seeds, its cells."""

    verdict: str
    n_seeds: int
    cells: pd.DataFrame


def judged(each: Claim, table: pd.DataFrame) -> Judged:
    cells = judge({"c": each}, table)
    (row,) = verdict_table(cells).itertuples()
    assert row.cells == len(cells)
    return Judged(row.verdict, row.n_seeds, cells)


def test_a_difference_that_pairing_alone_shows_holds():
    table = better()
    found = judged(claim(), table)
    assert (found.verdict, found.n_seeds) == (HOLDS, 30)
    assert len(found.cells) == 4
    assert (found.cells["verdict"] == HOLDS).all()
    assert (found.cells["low"] < found.cells["estimate"]).all()
    assert (found.cells["estimate"] < found.cells["high"]).all()
    assert found.cells["estimate"].to_numpy() == pytest.approx([-0.5] * 4, abs=0.05)
    # The seeds differ by twenty times as much: unpaired, nothing would show.
    apart = table.groupby("method")["error_mean_m"].std() / np.sqrt(30)
    assert apart.min() > 0.5


def test_one_cell_against_a_claim_refutes_it_and_those_as_claimed_are_named():
    table = runs(lambda t, n, method, z: (0.5 if t == "zigzag" else -0.5) * (method == "one") + 0.1 * z)
    found = judged(claim(), table)
    assert found.verdict == FAILS
    assert found.cells["cell"].str.startswith("zigzag").tolist() == [True, True, False, False]
    assert found.cells["verdict"].tolist() == [HOLDS, HOLDS, FAILS, FAILS]
    # If the other cells are inconclusive, the claim is neither shown nor refuted.
    found = judged(claim(), better(lambda trajectory, noise: (trajectory, noise) == ("zigzag", "random-walk")))
    assert found.verdict == OPEN
    assert found.cells.set_index("cell")["verdict"].to_dict()["zigzag, random-walk"] == HOLDS
    assert sorted(found.cells["verdict"]) == [HOLDS, OPEN, OPEN, OPEN]


def test_levels_ratios_and_ranges():
    table = runs(lambda t, n, method, z: 0.0).assign(ms=lambda rows: np.where(rows["method"] == "two", 9.0, 3.0))
    table["ms"] += 0.1 * np.random.default_rng(1).normal(size=len(table))
    ratio = judged(claim(metric="ms", form="ratio", comparison="between", threshold=[2.5, 3.5]), table)
    assert ratio.verdict == HOLDS
    assert ratio.cells["estimate"].to_numpy() == pytest.approx([3.0] * 4, abs=0.05)
    # A ratio of means, even where a seed has nothing to compare with.
    table.loc[table["seed"] == 3, "ms"] = 0.0
    some = judged(claim(metric="ms", form="ratio", comparison="above", threshold=[2.5]), table)
    assert some.verdict == HOLDS
    assert some.cells["estimate"].to_numpy() == pytest.approx([3.0] * 4, abs=0.05)
    table = table[table["seed"] != 3]
    level = claim(metric="ms", form="level", a={"method": "two"}, b={}, threshold=[8.0])
    assert judged(level, table).verdict == FAILS


def test_a_ratio_s_interval_holds_the_true_ratio_and_is_unbounded_over_nothing():
    random = np.random.default_rng(7)
    common = random.normal(size=(1000, 12))
    b = 1 + 0.3 * common + 0.2 * random.normal(size=common.shape)
    a = 2 + 0.5 * common + 0.2 * random.normal(size=common.shape)
    found = np.array([interval("ratio", np.column_stack(sides)) for sides in zip(a, b, strict=True)])
    assert ((found[:, 1] < 2) & (found[:, 2] > 2)).mean() == pytest.approx(0.95, abs=0.02)
    zeros = interval("ratio", np.column_stack([a[0], b[0] - b[0].mean()]))
    assert zeros[1:] == (-np.inf, np.inf)
    none = interval("ratio", np.zeros((5, 2)))
    assert claim(form="ratio").verdict(*none[1:]) == OPEN


@pytest.mark.parametrize("name", ["hough-robust-to-noise", "hough-precise-in-noise", "recall-sensitive-to-tuning"])
@pytest.mark.parametrize("level", [0.03, 0.5])
def test_a_claim_on_a_change_can_hold_and_fail_however_small_the_whole_is(name, level):
    each = read_claims(ROOT / "notebooks" / "claims.toml")[name]
    variants = ["", *each.a["variant"]]
    made = runs(lambda t, n, method, z: 0.1 * z, seeds=15, methods=variants).rename(columns={"method": "variant_"})
    made = made.assign(**{**each.where, "variant": made["variant_"]}).query("noise == 'random-walk'")
    noise = made["error_mean_m"] - 10 * made["by_seed"]
    verdicts = []
    for kept in (0.4, 1.0):
        factor = np.where(made["variant"] == "", 1.0, kept)
        verdicts.append(judged(each, made.assign(**{each.metric: level * (factor + 0.1 * noise)})).verdict)
    assert verdicts == ([HOLDS, FAILS] if each.comparison == "below" else [FAILS, HOLDS])


def test_the_report_s_samples_tell_how_long_its_slow_programs_took():
    samples = sample_runs()
    assert set(samples["method"]) == {"report-gicp", "report-segments"}
    assert set(samples["trajectory"]) == {"vertical", "orbit", "orbit-3.3"}
    cases = ["trajectory", "noise", "method"]
    mean = samples.groupby(cases)["scan_s"].mean()
    assert mean[:, :, "report-gicp"].between(1.0, 1.7).all()
    assert mean["vertical", "constant-drift", "report-segments"] == pytest.approx(0.392, abs=1e-3)
    assert not samples.duplicated([*cases, "seed"]).any()
    each = claim(metric="scan_missed", form="level", a={}, b={}, by=["trajectory", "noise", "method"])
    each = each.replace(where={"variant": "samples", "duration_s": 0.0}, comparison="above", threshold=[0.05])
    cells = claim_cells(each, pd.concat([samples, runs(lambda t, n, method, z: z, seeds=2)]))
    assert len(cells) == 6
    assert all(0.2 < cell["estimate"] < 1 for cell in cells)


def test_a_correlation_over_seeds():
    table = runs(lambda t, n, method, z: 0.0)
    random = np.random.default_rng(2)
    table["cause"] = table["by_seed"] + 0.3 * random.normal(size=len(table))
    table["chance"] = random.normal(size=len(table))
    base = {"form": "correlation", "comparison": "above", "a": {"method": "one"}, "b": {"metric": "error_mean_m"}}
    found = judged(claim(metric="cause", **base), table)
    assert found.verdict == HOLDS
    assert (found.cells["low"] > 0.6).all()
    assert (found.cells["high"] < 1).all()
    assert judged(claim(metric="chance", **base), table).verdict == OPEN
    constant = judged(claim(metric="constant", **base), table.assign(constant=1.0))
    assert (constant.cells[["low", "high"]] == 0.0).all(axis=None)


def test_failed_runs_and_missing_numbers_are_left_out():
    table = better()
    table.loc[table["seed"] == 3, "status"] = "failed"
    lost = (table["seed"] == 4) & (table["trajectory"] == "loops")
    table.loc[(table["seed"] == 3) | lost, "error_mean_m"] = np.nan
    found = judged(claim(), table)
    assert found.n_seeds == 29  # seed 4 still has its zigzag
    assert found.verdict == HOLDS
    with pytest.raises(InputError, match="fewer than two seeds"):
        claim_cells(claim(), table[table["seed"] == 0])


def test_a_walk_is_read_off_the_curve_at_three_minutes():
    time = np.linspace(0, 199.8, 100)
    table = runs(lambda t, n, method, z: 0.0, seeds=4)
    table["curve_time_s"] = [time] * len(table)
    table["curve_raw_m"] = [time / 100 + seed for seed in table["seed"]]
    level = claim(metric="raw_at_180_s_m", form="level", b={}, comparison="between", threshold=[0.0, 9.0])
    assert judged(level, table).cells["estimate"].to_numpy() == pytest.approx([1.8 + 1.5] * 4)
    table["curve_time_s"] = [time / 2] * len(table)
    with pytest.raises(InputError, match="fewer than two"):
        claim_cells(level, table)


def test_a_flight_that_converged_wrongly_counts_once_for_its_seed():
    table = runs(lambda t, n, method, z: 0.0, methods=("one",))
    wrong = (table["seed"] % 5 == 0) & (table["trajectory"] == "loops")
    table["wrong_share"] = np.where(wrong, 0.4, 0.01)
    base = {"metric": "converged_wrongly", "form": "level", "a": {}, "b": {}, "comparison": "above"}
    by_seed = judged(claim(**base, threshold=[0.02], by=["variant"]), table)
    assert by_seed.cells["estimate"].tolist() == [pytest.approx(0.1)]
    assert by_seed.n_seeds == 30, "not the 120 flights"
    rare = judged(claim(**base, threshold=[0.05], by=["trajectory"]), table).cells.set_index("cell")
    assert rare.loc["loops", "estimate"] == pytest.approx(0.2)
    assert rare["verdict"].to_dict() == {"zigzag": OPEN, "loops": HOLDS}
    never = judged(claim(**base, threshold=[0.2], by=["trajectory"]), table.assign(wrong_share=0.0))
    assert never.verdict == FAILS, "a threshold above zero can be refuted"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"threshold": [1.0, 2.0]}, ["threshold = [1.0, 2.0]", "between"]),
        ({"b": {}}, ["b:", "a difference or ratio names runs"]),
        ({"form": "level"}, ["a level has none"]),
        ({"form": "correlation"}, ["a correlation a metric"]),
        ({"by": ["planet"]}, ["unknown column 'planet'", "trajectory"]),
        ({"a": {"metric": "x"}}, ["unknown column 'metric'"]),
    ],
)
def test_bad_claims_are_one_line(changes, words):
    with pytest.raises(InputError) as told:
        claim(**changes)
    assert "\n" not in str(told.value)
    assert all(word in str(told.value) for word in words), told.value


def test_claims_on_frames_are_judged_by_the_table_of_the_segmentation_methods(tmp_path):
    frames = frame_runs(ROOT / "results" / "segmentation-seeds")
    assert frames["seed"].nunique() >= 30
    assert not frames.duplicated(["method", "seed"]).any()
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    of_frames = {name: each for name, each in claims.items() if each.where.get("sensor") == "starling2"}
    of_frames = {name: each for name, each in of_frames.items() if each.where["duration_s"] == 0.0}
    cells = judge(of_frames, frames).set_index(["name", "cell"])
    assert len(cells) == 10
    assert (cells["verdict"] != NOT_RUN).all()
    wide = frames.pivot(index="seed", columns="method", values=["recall", "precision", "frame_median_ms"])
    f1 = 2 * wide["recall"] * wide["precision"] / (wide["recall"] + wide["precision"])
    better, slower = cells.loc[("hough-better", "dbscan")], cells.loc[("hough-faster", "ransac-planes")]
    assert (better["verdict"], better["n_seeds"]) == (HOLDS, frames["seed"].nunique())
    assert better["estimate"] == pytest.approx((f1["dbscan"] - f1["hough"]).mean())
    ms = wide["frame_median_ms"]
    assert slower["estimate"] == pytest.approx(ms["ransac-planes"].mean() / ms["hough"].mean())
    with pytest.raises(InputError, match=r"table\.csv.*segmentation-seeds"):
        frame_runs(tmp_path)


def test_a_claim_without_runs_is_not_run_and_the_others_are_judged():
    table = better()
    claims = {"there": claim(), "missing": claim(a={"method": "three"}), "unmeasured": claim(metric="frame_p95_ms")}
    table = verdict_table(judge(claims, table)).set_index("name")
    assert table["verdict"].to_dict() == {"there": HOLDS, "missing": NOT_RUN, "unmeasured": NOT_RUN}
    assert table["lowest"].isna().tolist() == [False, True, True]
    assert table["n_seeds"].tolist() == [30, 0, 0]
    assert table.loc["there", "as_claimed"] == table.loc["there", "cells"] == 4
    missing = judge(claims, better()).set_index("name")["cell"]
    assert missing["missing"] == "no runs with method = 'three'"
    assert "frame_p95_ms" in missing["unmeasured"]


@pytest.mark.parametrize(
    ("comparison", "threshold", "inside", "outside", "undecided"),
    [
        ("below", [1.0], (0.1, 0.9), (1.1, 2.0), (0.9, 1.1)),
        ("above", [1.0], (1.1, 2.0), (0.1, 0.9), (0.9, 1.1)),
        ("between", [1.0, 2.0], (1.1, 1.9), (2.1, 3.0), (1.9, 2.1)),
        ("between", [1.0, 2.0], (1.1, 1.9), (0.1, 0.9), (0.5, 2.5)),
        ("below", [0.0], (-0.1, -0.1), (0.1, 0.1), (0.0, 0.0)),
    ],
)
def test_an_interval_is_as_claimed_or_not_or_cannot_tell(comparison, threshold, inside, outside, undecided):
    verdict = claim(comparison=comparison, threshold=threshold).verdict
    assert [verdict(*inside), verdict(*outside), verdict(*undecided)] == [HOLDS, FAILS, OPEN]
