"""Figures of the claims, from made-up verdicts and runs."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from steelnb.figures import figure_claims, figure_error_bands
from steelnb.figures.claims import AXIS, LINE, MARKS, bands, cell_label, goal, told
from steelnb.study.claims import FAILS, HOLDS, NOT_RUN, ONLY_WHEN, Claim, Verdict

MIDDLE = sum(AXIS) / 2


def verdict(
    word, cells, *, comparison="below", threshold=(0.0,), metric="error_mean_m", text="one is better"
) -> Verdict:
    """A verdict whose cells are ``(trajectory, estimate, low, high, holds)``."""
    claim = Claim(
        section="3.3", claim=text, metric=metric, comparison=comparison, threshold=list(threshold),
        a={"method": "one"}, b={"method": "two"}, by=["trajectory"],
    )  # fmt: skip
    table = pd.DataFrame(cells, columns=["trajectory", "estimate", "low", "high", "holds"])
    condition = "no runs with method = 'one'" if word == NOT_RUN else ""
    return Verdict("x", claim, np.nan, np.nan, np.nan, 30, word, condition, table)


def lines(panel, mark):
    return [line for line in panel.lines if line.get_marker() == mark]


def texts(panel):
    return [text.get_text() for text in panel.texts]


def test_marks_and_colours_tell_the_verdicts_apart_each_by_itself():
    assert len({mark for mark, _ in MARKS.values()}) == len({colour for _, colour in MARKS.values()}) == len(MARKS) == 4


def test_what_is_as_claimed_lies_right_of_the_line_whatever_the_claim():
    cells = [("vertical", -0.3, -0.4, -0.2, True), ("orbit", 0.1, 0.05, 0.2, False)]
    for sign, comparison in ((1, "below"), (-1, "above")):
        turned = [(name, sign * m, *sorted((sign * low, sign * high)), holds) for name, m, low, high, holds in cells]
        (panel,) = figure_claims([verdict(ONLY_WHEN, turned, comparison=comparison)]).axes
        (holding,) = [line for line in lines(panel, "o") if line.get_xdata()[0] > 1]
        (failing,) = lines(panel, "X")
        assert holding.get_xdata()[0] > MIDDLE > failing.get_xdata()[0]
        assert holding.get_ydata()[0] < failing.get_ydata()[0], "cells stand in their order, downwards"
        assert to_hex(holding.get_color()) == MARKS[HOLDS][1].lower()
        assert to_hex(failing.get_color()) == MARKS[FAILS][1].lower()
        # Distances from the line are in proportion.
        assert (holding.get_xdata()[0] - MIDDLE) == pytest.approx(3 * (MIDDLE - failing.get_xdata()[0]))
        (own,) = lines(panel, "D")
        assert own.get_xdata()[0] < 1, "the claim's own mark stands before it"
        assert {"vertical", "orbit"} <= set(texts(panel))


def test_a_range_is_shaded_between_its_ends():
    cells = [("vertical", 2.9, 2.8, 3.1, True), ("orbit", 5.0, 4.5, 5.5, False)]
    (panel,) = figure_claims([verdict(ONLY_WHEN, cells, comparison="between", threshold=(2.5, 3.5))]).axes
    (band,) = panel.collections
    left, right = band.get_paths()[0].get_extents().intervalx
    assert left == pytest.approx(MIDDLE)
    assert right < AXIS[1]
    inside = next(line.get_xdata()[0] for line in lines(panel, "o") if line.get_xdata()[0] > 1)
    assert left < inside < right < lines(panel, "X")[0].get_xdata()[0] < AXIS[1]


def test_an_interval_that_leaves_its_row_ends_in_an_arrow():
    wide = [("vertical", 0.2, -3.0, 3.0, False), ("orbit", 0.1, 0.05, 0.3, False)]
    (panel,) = figure_claims([verdict(FAILS, wide)]).axes
    (left,), (right,) = lines(panel, "<"), lines(panel, ">")
    assert left.get_xdata()[0] == AXIS[0]
    assert right.get_xdata()[0] == AXIS[1]
    assert left.get_ydata()[0] == right.get_ydata()[0] == lines(panel, "X")[1].get_ydata()[0]
    spans = [
        line.get_xdata()
        for line in panel.lines
        if len(line.get_xdata()) == 2 and line.get_ydata()[0] == left.get_ydata()[0]
    ]
    assert min(map(min, spans)) >= AXIS[0]
    (panel,) = figure_claims([verdict(HOLDS, [("vertical", -0.2, -0.3, -0.1, True)])]).axes
    assert not lines(panel, "<") + lines(panel, ">")


def test_numbers_have_units_and_the_claim_its_goal():
    metrics = {"bend_deg": "°", "frame_p95_ms": "ms", "growth_lost_m_s": "m/s", "lost_share": ""}
    cells = [("vertical", -0.123, -0.15, -0.1, True)]
    for metric, unit in metrics.items():
        shown = texts(figure_claims([verdict(HOLDS, cells, metric=metric)]).axes[0])
        assert f"−0.123 [−0.150, −0.100] {unit}".rstrip() in shown
        assert f"3.3 · {metric}, difference < 0 {unit}".rstrip() in shown
    assert goal(verdict(HOLDS, cells, threshold=(-0.05,)).claim) == "error_mean_m, difference < −0.05 m"
    assert goal(verdict(HOLDS, cells, comparison="between", threshold=(2.5, 3.5)).claim).endswith("in 2.5 to 3.5 m")


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
    assert told(*numbers) == text


def test_a_claim_that_was_not_run_says_why():
    (panel,) = figure_claims([verdict(NOT_RUN, [])]).axes
    assert "not run: no runs with method = 'one'" in texts(panel)
    assert not [line for line in panel.lines if line.get_xdata()[0] > AXIS[0]]


def test_rows_do_not_overlap_and_no_text_leaves_its_column():
    long = "a claim of so many words that it takes more than two lines of its column to say what it claims, and another"
    rows = [
        verdict(HOLDS, [(f"orbit {k}", -0.1, -0.2, -0.05, True) for k in range(count)], text=long[: 30 * count])
        for count in (1, 2, 4)
    ]
    figure = figure_claims(rows)
    (panel,) = figure.axes
    height = figure.get_size_inches()[1]
    drawn = sorted((text.get_position() for text in panel.texts), key=lambda place: (place[0], place[1]))
    for (x, y), (other, below) in itertools.pairwise(drawn):
        assert 0 < y < height
        assert x != other or below - y > 0.9 * LINE
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in panel.texts if text.get_position()[1] > 4 * LINE]
    assert not [
        (a, b) for k, a in enumerate(boxes) for b in boxes[k + 1 :] if a.shrunk(1, 0.7).overlaps(b.shrunk(1, 0.7))
    ]


def test_cells_are_named_in_a_few_letters():
    assert cell_label(["vertical", "random-walk+yaw-random-walk"]) == "vertical, walk + yaw"
    assert cell_label(["hough.dx_m=0.029", "orbit"]) == "dx 0.029, orbit"
    assert cell_label(["", "orbit"]) == "orbit"


def curves(seeds=11, **case) -> pd.DataFrame:
    """Runs whose error is time through a hundred, times one to eleven."""
    time = np.linspace(0, 200, 101)
    given = {"trajectory": "orbit", "noise": "random-walk", "method": "icp", "status": "ok", **case}
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
    time, (low, median, high) = bands(curves(), "curve_error_m")
    assert time[-1] == 200
    assert np.allclose(median, time / 100 * 6)
    assert np.allclose(low, time / 100 * 2)
    assert np.allclose(high, time / 100 * 10)


def test_a_flight_that_ended_early_is_left_out_after_its_end():
    runs = curves(3)
    for name in ("curve_time_s", "curve_error_m"):
        runs.at[2, name] = runs.at[2, name][:51]  # the worst seed, 100 s
    time, (_, median, _) = bands(runs, "curve_error_m")
    assert median[time == 100] == pytest.approx(2.0)
    assert median[-1] == pytest.approx(3.0)


def test_a_panel_for_each_method_and_case_and_a_word_where_there_are_no_runs():
    runs = pd.concat([curves(), curves(trajectory="vertical", method="gicp"), curves(method="gicp", status="failed")])
    figure = figure_error_bands(runs, ["icp", "gicp"])
    assert len(figure.axes) == 4
    words = [{text.get_text() for text in panel.texts} for panel in figure.axes]
    assert words == [{"11 seeds"}, {"not run"}, {"not run"}, {"11 seeds"}]
    assert [len(panel.lines) for panel in figure.axes] == [2, 0, 0, 2]
    raw, error = figure.axes[0].lines
    assert raw.get_linestyle() == "--"
    assert error.get_ydata()[-1] == pytest.approx(12.0)
    assert figure.axes[0].get_yscale() == "log"
    assert (error.get_xdata() > 0).all()
    assert figure.axes[0].get_title() == "orbit\nrandom-walk"
    assert len(figure_error_bands(runs.iloc[:0], ["icp"]).axes) == 1


def test_the_range_of_the_report_stands_behind_what_it_shows_alone():
    def ranges(**case):
        (panel,) = figure_error_bands(curves(**case), [case["method"]]).axes
        return [patch.get_extents().transformed(panel.transData.inverted()).intervaly for patch in panel.patches]

    ((low, high),) = ranges(method="gicp", noise="constant-drift")
    assert (low, high) == pytest.approx((0.25, 0.4))
    ((_, high),) = ranges(method="average", trajectory="vertical")
    assert high == pytest.approx(0.28)
    assert ranges(method="gicp", noise="random-walk+yaw-random-walk") == []
    assert ranges(method="best") == []
