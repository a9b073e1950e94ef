"""Verdicts on claims, over made-up runs whose verdicts are known."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from steelnb.claims import (
    FAILS,
    HOLDS,
    NOT_RUN,
    OPEN,
    USUAL,
    Claim,
    judge,
    judge_all,
    read_claims,
    verdict_metrics,
    verdict_table,
)
from steelnb.errors import InputError
from steelnb.frames import frame_runs
from steelnb.row import case_of
from steelnb.runs import read_grids

ROOT = Path(__file__).parents[1]
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
    """Runs in which two is better than one by so much in some cells, and no worse elsewhere."""
    return runs(lambda t, n, method, z: (by if method == "one" and where(t, n) else 0.0) + 0.1 * z)


def claim(**changes) -> Claim:
    given = {
        "section": "1", "claim": "two is better than one", "metric": "error_mean_m", "comparison": "below",
        "threshold": [0.0], "a": {"method": "two"}, "b": {"method": "one"},
    }  # fmt: skip
    return Claim(**{**given, **changes})


def test_a_difference_that_pairing_alone_shows_holds():
    table = better()
    found = judge("c", claim(), table)
    assert (found.verdict, found.where, found.n_seeds) == (HOLDS, "", 30)
    assert len(found.cells) == 4
    assert (found.cells["verdict"] == HOLDS).all()
    assert (found.cells["low"] < found.cells["estimate"]).all()
    assert (found.cells["estimate"] < found.cells["high"]).all()
    assert found.cells["estimate"].to_numpy() == pytest.approx([-0.5] * 4, abs=0.05)
    # The seeds differ by twenty times as much: unpaired, nothing would show.
    apart = table.groupby("method")["error_mean_m"].std() / np.sqrt(30)
    assert apart.min() > 0.5


def test_the_opposite_does_not_hold_and_no_difference_is_inconclusive():
    assert judge("c", claim(), better(by=-0.5)).verdict == FAILS
    found = judge("c", claim(), better(by=0.0))
    assert (found.verdict, found.where) == (OPEN, "")


def test_one_cell_against_a_claim_refutes_it_and_those_as_claimed_are_named():
    table = runs(lambda t, n, method, z: (0.5 if t == "zigzag" else -0.5) * (method == "one") + 0.1 * z)
    found = judge("c", claim(), table)
    assert (found.verdict, found.where) == (FAILS, "zigzag")
    assert found.cells["verdict"].tolist() == [HOLDS, HOLDS, FAILS, FAILS]
    # Where the other cells only cannot tell, the claim is neither shown nor refuted.
    found = judge("c", claim(), better(lambda trajectory, noise: (trajectory, noise) == ("zigzag", "random-walk")))
    assert (found.verdict, found.where) == (OPEN, "zigzag, random-walk")


def test_levels_ratios_and_ranges():
    table = runs(lambda t, n, method, z: 0.0).assign(ms=lambda rows: np.where(rows["method"] == "two", 9.0, 3.0))
    table["ms"] += 0.1 * np.random.default_rng(1).normal(size=len(table))
    ratio = judge("c", claim(metric="ms", form="ratio", comparison="between", threshold=[2.5, 3.5]), table)
    assert ratio.verdict == HOLDS
    assert ratio.cells["estimate"].to_numpy() == pytest.approx([3.0] * 4, abs=0.05)
    narrow = claim(metric="ms", form="ratio", comparison="between", threshold=[3.2, 3.5])
    assert judge("c", narrow, table).verdict == FAILS
    level = claim(metric="ms", form="level", a={"method": "two"}, b={}, threshold=[8.0])
    assert judge("c", level, table).verdict == FAILS
    assert judge("c", level.replace(threshold=[10.0]), table).verdict == HOLDS
    assert judge("c", level.replace(threshold=[8.0], comparison="above"), table).verdict == HOLDS


def test_a_correlation_over_seeds():
    table = runs(lambda t, n, method, z: 0.0)
    random = np.random.default_rng(2)
    table["cause"] = table["by_seed"] + 0.3 * random.normal(size=len(table))
    table["chance"] = random.normal(size=len(table))
    base = {"form": "correlation", "comparison": "above", "a": {"method": "one"}, "b": {"metric": "error_mean_m"}}
    found = judge("c", claim(metric="cause", **base), table)
    assert found.verdict == HOLDS
    assert (found.cells["low"] > 0.6).all()
    assert (found.cells["high"] < 1).all()
    assert judge("c", claim(metric="chance", **base), table).verdict == OPEN
    constant = judge("c", claim(metric="constant", **base), table.assign(constant=1.0))
    assert (constant.cells[["low", "high"]] == 0.0).all(axis=None)


def test_failed_runs_and_missing_numbers_are_left_out():
    table = better()
    table.loc[table["seed"] == 3, "status"] = "failed"
    lost = (table["seed"] == 4) & (table["trajectory"] == "loops")
    table.loc[(table["seed"] == 3) | lost, "error_mean_m"] = np.nan
    found = judge("c", claim(), table)
    assert found.n_seeds == 29  # seed 4 still has its zigzag
    assert found.verdict == HOLDS
    with pytest.raises(InputError, match="fewer than two seeds"):
        judge("c", claim(), table[table["seed"] == 0])


def test_a_walk_is_read_off_the_curve_at_three_minutes():
    time = np.linspace(0, 199.8, 100)
    table = runs(lambda t, n, method, z: 0.0, seeds=4)
    table["curve_time_s"] = [time] * len(table)
    table["curve_raw_m"] = [time / 100 + seed for seed in table["seed"]]
    level = claim(metric="raw_at_180_s_m", form="level", b={}, comparison="between", threshold=[0.0, 9.0])
    assert judge("c", level, table).cells["estimate"].to_numpy() == pytest.approx([1.8 + 1.5] * 4)
    table["curve_time_s"] = [time / 2] * len(table)
    with pytest.raises(InputError, match="fewer than two"):
        judge("c", level, table)


def test_a_flight_that_converged_wrongly_counts_once_for_its_seed():
    table = runs(lambda t, n, method, z: 0.0, methods=("one",))
    wrong = (table["seed"] % 5 == 0) & (table["trajectory"] == "loops")
    table["wrong_share"] = np.where(wrong, 0.4, 0.01)
    base = {"metric": "converged_wrongly", "form": "level", "a": {}, "b": {}, "comparison": "above"}
    by_seed = judge("c", claim(**base, threshold=[0.02], by=["variant"]), table)
    assert by_seed.cells["estimate"].tolist() == [pytest.approx(0.1)]
    assert by_seed.n_seeds == 30, "not the 120 flights"
    rare = judge("c", claim(**base, threshold=[0.05], by=["trajectory"]), table).cells.set_index("trajectory")
    assert rare.loc["loops", "estimate"] == pytest.approx(0.2)
    assert rare["verdict"].to_dict() == {"zigzag": OPEN, "loops": HOLDS}
    never = judge("c", claim(**base, threshold=[0.2], by=["trajectory"]), table.assign(wrong_share=0.0))
    assert never.verdict == FAILS, "a threshold above zero can be refuted"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"comparison": "near"}, ["comparison = 'near'"]),
        ({"threshold": [1.0, 2.0]}, ["threshold = [1.0, 2.0]", "between"]),
        ({"b": {}}, ["b:", "a difference or ratio names runs"]),
        ({"form": "level"}, ["a level has none"]),
        ({"form": "correlation"}, ["a correlation a metric"]),
        ({"by": ["planet"]}, ["unknown column 'planet'", "trajectory"]),
        ({"a": {"metric": "x"}}, ["unknown column 'metric'"]),
        ({"bye": []}, ["bye"]),
    ],
)
def test_bad_claims_are_one_line(changes, words):
    with pytest.raises(InputError) as told:
        claim(**changes)
    assert "\n" not in str(told.value)
    assert all(word in str(told.value) for word in words), told.value


def test_claims_of_runs_or_numbers_that_are_not_there_are_one_line(tmp_path):
    table = runs(lambda t, n, method, z: 0.0, seeds=3)
    with pytest.raises(InputError, match=r"\[c\]: no runs with method = 'three'"):
        judge("c", claim(a={"method": "three"}), table)
    with pytest.raises(InputError, match=r"\[c\]: metric = 'mass_kg'"):
        judge("c", claim(metric="mass_kg"), table)
    with pytest.raises(InputError, match="expected a file of claims"):
        read_claims(tmp_path / "claims.toml")
    (tmp_path / "claims.toml").write_text("[a]\nsection = 3")
    with pytest.raises(InputError, match=r"claims.toml: \[a\]"):
        read_claims(tmp_path / "claims.toml")


def test_every_claim_of_the_project_has_runs_of_enough_seeds_in_its_study():
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    cases = pd.DataFrame([case_of(*run) for run in read_grids(ROOT / "notebooks" / "study.toml")])
    flown = {name: each for name, each in claims.items() if each.where.get("duration_s") != 0.0}
    assert len(flown) >= 20
    for name, each in flown.items():
        for side in (each.a, each.b):
            chosen = {**USUAL, **each.where, **each.a, **side}
            rows = cases
            for column, value in chosen.items():
                if column != "metric":
                    rows = rows[rows[column].isin(value if isinstance(value, list) else [value])]
            for cell, some in rows.groupby([column for column in each.by if column not in side] or ["sensor"]):
                few = "speed" in name or any("waist" in str(value) for value in cell)
                assert some["seed"].nunique() >= (10 if few else 30), (name, cell)
            assert len(rows), name


def test_claims_on_frames_are_judged_by_the_table_of_the_segmentation_methods(tmp_path):
    frames = frame_runs(ROOT / "results" / "segmentation-seeds")
    assert frames["seed"].nunique() >= 30
    assert not frames.duplicated(["method", "seed"]).any()
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    of_frames = {name: each for name, each in claims.items() if each.where.get("duration_s") == 0.0}
    assert len(of_frames) == 8
    found = {name: judge(name, each, frames) for name, each in of_frames.items()}
    dbscan = found["hough-better-than-dbscan"]
    assert (dbscan.verdict, dbscan.n_seeds) == (HOLDS, frames["seed"].nunique())
    wide = frames.pivot(index="seed", columns="method", values=["recall", "precision"])
    recall, precision = wide["recall"], wide["precision"]
    f1 = 2 * recall * precision / (recall + precision)
    assert dbscan.cells["estimate"].tolist() == pytest.approx([(f1["hough"] - f1["dbscan"]).mean()])
    slower = found["hough-faster-than-ransac-planes"]
    ms = frames.pivot(index="seed", columns="method", values="frame_median_ms")
    assert slower.cells["estimate"].tolist() == pytest.approx([(ms["hough"] / ms["ransac-planes"]).mean()])
    with pytest.raises(InputError, match=r"table\.csv.*segmentation-seeds"):
        frame_runs(tmp_path)


def test_a_claim_without_runs_is_not_run_and_the_others_are_judged():
    table = better()
    claims = {"there": claim(), "missing": claim(a={"method": "three"}), "unmeasured": claim(metric="frame_p95_ms")}
    there, missing, unmeasured = judge_all(claims, table)
    assert there.verdict == HOLDS
    assert (missing.verdict, missing.missing, missing.n_seeds) == (NOT_RUN, "no runs with method = 'three'", 0)
    assert unmeasured.verdict == NOT_RUN
    assert "frame_p95_ms" in unmeasured.missing
    assert verdict_table([there, missing, unmeasured])["lowest"].isna().tolist() == [False, True, True]
    numbers = verdict_metrics([there, missing])
    assert numbers["missing.n_seeds"] == 0
    assert "missing.lowest" not in numbers
    assert numbers["there.as_claimed"] == numbers["there.cells"] == 4


@pytest.mark.parametrize(
    ("comparison", "threshold", "outside", "undecided"),
    [
        ("below", [1.0], (1.1, 2.0), (0.9, 1.1)),
        ("above", [1.0], (0.1, 0.9), (0.9, 1.1)),
        ("between", [1.0, 2.0], (2.1, 3.0), (1.9, 2.1)),
        ("between", [1.0, 2.0], (0.1, 0.9), (0.5, 2.5)),
    ],
)
def test_an_interval_is_as_claimed_or_not_or_cannot_tell(comparison, threshold, outside, undecided):
    found = claim(comparison=comparison, threshold=threshold)
    assert found.outside(*outside)
    assert not found.satisfied(*outside)
    assert not found.outside(*undecided)
    assert not found.satisfied(*undecided)
