"""The table, the picture and the line of changes."""

import numpy as np
import pandas as pd

from steelnb.fusion import Structure
from steelnb.fusion.changes import Changes
from steelnb.report.changes import changes_line, write_changes
from steelnb.report.three_views import CHANGES, figure_changes
from tests.fusion.made import ladder, structure_of_bars

KINDS = ("same", "missing", "moved", "bent", "not seen", "same", "same", "same", "new")


def made(new: Structure) -> Changes:
    nan, kinds = np.nan, KINDS if len(new) else KINDS[:-1]
    columns = [[0.001, nan, 0.05, 0.03, nan, 0, 0, 0, 0.4], [0.003] * 9, [1, 1e-9, 1e-5, 0.01, nan, 1, 1, 1, 0]]
    return Changes(ladder(), new, kinds, *(np.array(column)[: len(kinds)] for column in columns))


def test_each_bar_has_a_row_and_its_ends_where_the_map_has_them(tmp_path):
    write_changes(made(structure_of_bars([[[2, 0, 0], [2, 0, 1]]])), tmp_path / "changes.csv", np.array([10.0, 0, 0]))
    table = pd.read_csv(tmp_path / "changes.csv", keep_default_na=False)
    assert table["kind"].tolist() == list(KINDS)
    assert table["bar"].tolist() == list(range(9))
    assert table["offset_m"].tolist()[:5] == ["0.0010", "", "0.0500", "0.0300", ""]
    assert table["significance"].tolist()[1:5] == ["1e-09", "1e-05", "0.01", ""]
    assert table["start_x_m"].tolist()[-1] == 12.0


def test_the_picture_draws_every_bar_once_in_the_colour_of_its_kind():
    for new in (structure_of_bars([[[2, 0, 0], [2, 0, 1]]]), Structure.empty()):
        changes = made(new)
        figure = figure_changes(changes, "a tower")
        for panel in figure.axes:
            drawn = [len(lines.get_segments()) for lines in panel.collections]
            assert drawn[: len(CHANGES)] == [len(changes.of(kind)) for kind in CHANGES]
        assert "missing: 1" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_line_counts_kinds():
    assert changes_line(made(Structure.empty())) == (
        "changes   8 bars of the map: 4 same, 1 missing, 1 moved, 1 bent, 1 not seen"
    )
