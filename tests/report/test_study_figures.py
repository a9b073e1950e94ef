"""Figures of studies and claims, from made-up verdicts and runs."""

import dataclasses
import itertools

import numpy as np
import pandas as pd
import pytest

from steelnb.report.claims import FAILS, HOLDS, NOT_RUN, OPEN, Claim, Verdict
from steelnb.report.study_figures import (
    claim_goal,
    figure_claims,
    figure_error_bands,
    figures_by_section,
    interval_text,
    percentile_bands,
)


def verdict(
    word, cells, *, comparison="below", threshold=(0.0,), metric="error_mean_m", text="one is better"
) -> Verdict:
    """A verdict whose cells are ``(trajectory, estimate, low, high, as claimed or not)``."""
    claim = Claim(
        section="3.3", claim=text, metric=metric, comparison=comparison, threshold=list(threshold),
        a={"method": "one"}, b={"method": "two"}, by=["trajectory"],
    )  # fmt: skip
    table = pd.DataFrame(cells, columns=["trajectory", "estimate", "low", "high", "holds"])
    table = table.assign(verdict=np.where(table.pop("holds").astype(bool), HOLDS, FAILS), n_seeds=30)
    return Verdict("x", claim, word, table, "no runs with method = 'one'" if word == NOT_RUN else "")


def heading(panel) -> str:
    return panel.get_title(loc="left").replace("\n", " ")


def across(panel, value: float) -> float:
    """The place of a value, 0 at the left edge of a panel and 1 at its right."""
    first, last = panel.get_xlim()
    return (value - first) / (last - first)


def place(panel, mark) -> float:
    (line,) = [line for line in panel.lines if line.get_marker() == mark]
    return line.get_xdata()[0]


def test_what_is_as_claimed_lies_right_of_the_line_whatever_the_claim():
    cells = [("zigzag", -0.3, -0.4, -0.2, True), ("loops", 0.1, 0.05, 0.2, False)]
    for sign, comparison in ((1, "below"), (-1, "above")):
        turned = [(name, sign * m, *sorted((sign * low, sign * high)), holds) for name, m, low, high, holds in cells]
        (panel,) = figure_claims([verdict(OPEN, turned, comparison=comparison)]).axes
        assert place(panel, "o") == pytest.approx(-0.3 * sign), "in metres"
        assert across(panel, 0.0) == pytest.approx(0.5)
        assert across(panel, place(panel, "X")) < 0.5 < across(panel, place(panel, "o")) < 1
        assert [label.get_text() for label in panel.get_yticklabels()] == ["zigzag", "loops"]
        assert heading(panel).startswith("INCONCLUSIVE · one is better (3.3; error_mean_m")
        assert heading(panel).endswith("30 seeds, sensor report-4cm)")


def test_the_scale_of_a_ratio_ends_at_0():
    ratio = Claim(
        section="4", claim="half", metric="error_mean_m", form="ratio", comparison="below", threshold=[0.5],
        a={"method": "one"}, b={"method": "two"}, by=["trajectory"],
    )  # fmt: skip
    cells = [("loops", 6.0, 5.0, 7.0, False)]
    (panel,) = figure_claims([dataclasses.replace(verdict(FAILS, cells), claim=ratio)]).axes
    first, last = panel.get_xlim()
    assert last == 0
    assert first > 7
    assert across(panel, place(panel, "X")) < across(panel, 0.5)


def test_a_range_is_shaded_between_its_ends():
    cells = [("zigzag", 2.9, 2.8, 3.1, True), ("loops", 5.0, 4.5, 5.5, False)]
    (panel,) = figure_claims([verdict(OPEN, cells, comparison="between", threshold=(2.5, 3.5))]).axes
    (band,) = panel.patches
    left, right = band.get_x(), band.get_x() + band.get_width()
    assert (left, right) == pytest.approx((2.5, 3.5))
    assert left < place(panel, "o") < right < place(panel, "X") < panel.get_xlim()[1]


def test_numbers_have_units_and_the_claim_its_goal():
    metrics = {"bend_deg": "°", "frame_p95_ms": "ms", "growth_lost_m_s": "m/s", "lost_share": ""}
    cells = [("zigzag", -0.123, -0.15, -0.1, True)]
    for metric, unit in metrics.items():
        panel = figure_claims([verdict(HOLDS, cells, metric=metric)]).axes[0]
        (numbers,) = [label.get_text() for label in panel.child_axes[0].get_yticklabels()]
        assert numbers == f"−0.123 [−0.150, −0.100] {unit}".rstrip()
        assert f"(3.3; {metric}, difference < 0 {unit}".rstrip() + ";" in heading(panel)
    assert claim_goal(verdict(HOLDS, cells, threshold=(-0.05,)).claim) == "error_mean_m, difference < −0.05 m"
    ranged = verdict(HOLDS, cells, comparison="between", threshold=(2.5, 3.5)).claim
    assert claim_goal(ranged).endswith("in 2.5 to 3.5 m")


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((5.912, 5.1, 7.2), "5.9 [5.1, 7.2]"),
        ((54.31, 51.0, 76.2), "54 [51, 76]"),
        ((0.0046, -0.0012, 0.0084), "0.0046 [−0.0012, 0.0084]"),
        ((0.01, -0.0004, 0.0251), "0.010 [0.000, 0.025]"),
        ((0.0, 0.0, 0.0), "0.00 [0.00, 0.00]"),
    ],
)
def test_numbers_have_two_digits_of_the_interval(numbers, text):
    assert interval_text(*numbers) == text


def test_a_claim_that_was_not_run_says_why_and_headings_do_not_overlap():
    long = "a claim of so many words that it takes more than one line of the figure to say what it claims, and another"
    rows = [verdict(HOLDS, [("loops", -0.1, -0.2, -0.05, True)] * count, text=long) for count in (1, 3)]
    figure = figure_claims([*rows, verdict(NOT_RUN, [])])
    assert "not run" in heading(figure.axes[2]).lower()
    assert "no runs with method = 'one'" in heading(figure.axes[2])
    figure.draw_without_rendering()
    texts = [label for panel in figure.axes[:2] for label in panel.get_yticklabels()]
    texts += [panel._left_title for panel in figure.axes]
    boxes = [text.get_window_extent() for text in texts]
    boxes += [panel.xaxis.get_tightbbox() for panel in figure.axes[:2]]
    assert min(box.x0 for box in boxes) >= 0
    assert max(box.x1 for box in boxes) <= figure.bbox.x1
    pairs = itertools.combinations(boxes, 2)
    assert not [(a, b) for a, b in pairs if a.shrunk(1, 0.7).overlaps(b.shrunk(1, 0.7))]


def test_each_section_has_a_figure_of_its_own():
    here, there = verdict(HOLDS, []), verdict(HOLDS, [])
    there.claim.__dict__["section"] = "5, figure 5.1"
    drawn = figures_by_section([here, there, here])
    assert {name: len(figure.axes) for name, figure in drawn.items()} == {"claims_3_3": 2, "claims_5": 1}


def curves(seeds=11, **case) -> pd.DataFrame:
    """Runs whose error is time through a hundred, times one to eleven."""
    time = np.linspace(0, 200, 101)
    usual = {"trajectory": "loops", "noise": "random-walk", "method": "icp", "sensor": "report-4cm", "status": "ok"}
    given = {**usual, **case}
    return pd.DataFrame(
        {
            **given,
            "seed": seed,
            "curve_time_s": time,
            "curve_raw_m": time / 50,
            "curve_error_m": time / 100 * (seed + 1),
        }
        for seed in range(seeds)
    )


def test_a_band_is_median_and_percentiles_over_the_seeds():
    time, (low, median, high) = percentile_bands(curves(), "curve_error_m")
    assert time[-1] == 200
    assert np.allclose(median, time / 100 * 6)
    assert np.allclose(low, time / 100 * 2)
    assert np.allclose(high, time / 100 * 10)


def test_a_flight_that_ended_early_is_left_out_after_its_end():
    runs = curves(3)
    for name in ("curve_time_s", "curve_error_m"):
        runs.at[2, name] = runs.at[2, name][:51]  # the worst seed, 100 s
    time, (_, median, _) = percentile_bands(runs, "curve_error_m")
    assert median[time == 100] == pytest.approx(2.0)
    assert median[-1] == pytest.approx(3.0)


def test_a_panel_for_each_method_and_case_and_a_word_where_there_are_no_runs():
    runs = pd.concat([curves(), curves(trajectory="zigzag", method="gicp"), curves(method="gicp", status="failed")])
    figure = figure_error_bands(runs, ["icp", "gicp"])
    assert len(figure.axes) == 4
    words = [{text.get_text() for text in panel.texts} for panel in figure.axes]
    assert words == [set(), {"not run"}, {"not run"}, set()]
    assert figure.get_suptitle() == "sensor report-4cm, 11 seeds: median and band"
    keys = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"no correction", "ICP", "GICP", "10–90 % of the seeds"} <= keys
    colours = [handle.get_color() for handle in figure.legends[0].get_lines()]
    assert [line.get_color() for line in (*figure.axes[0].lines, figure.axes[3].lines[1])] == colours
    assert [len(panel.lines) for panel in figure.axes] == [2, 0, 0, 2]
    raw, error = figure.axes[0].lines
    assert raw.get_linestyle() == "--"
    assert error.get_ydata()[-1] == pytest.approx(12.0)
    assert figure.axes[0].get_yscale() == "log"
    assert (error.get_xdata() > 0).all()
    assert figure.axes[0].get_title() == "loops\nrandom-walk"
    assert len(figure_error_bands(runs.iloc[:0], ["icp"]).axes) == 1


def test_small_errors_are_within_the_panels_of_bands():
    runs = curves(method="best")
    runs["curve_error_m"] = runs["curve_error_m"] / 1000
    (panel,) = figure_error_bands(runs, ["best"]).axes
    assert panel.get_ylim()[0] < 4e-5, "the lower end of the band"


def test_the_range_of_the_report_stands_behind_what_it_shows_alone():
    def ranges(**case):
        (panel,) = figure_error_bands(curves(**case), [case["method"]]).axes
        seeds = min(band.get_zorder() for band in panel.collections)
        assert all(patch.get_zorder() < seeds for patch in panel.patches), "behind the band of the seeds"
        return [patch.get_extents().transformed(panel.transData.inverted()).intervaly for patch in panel.patches]

    ((_, high),) = ranges(method="gicp", noise="constant-drift")
    assert high == pytest.approx(0.349, abs=0.003)
    ((_, high),) = ranges(method="average", trajectory="zigzag", noise="constant-drift")
    assert high == pytest.approx(0.263, abs=0.003)
    assert ranges(method="average", trajectory="zigzag", noise="random-walk") == []
    assert ranges(method="gicp", noise="random-walk+yaw-random-walk") == []
    assert ranges(method="best") == []
