"""Results → pictures that seaborn cannot draw, in one style with one table of colours and names."""

from steelnb.plots.draw import (
    draw_bars,
    draw_flight,
    draw_judged_bars,
    draw_lines,
    draw_tower,
    end_points,
    figure_clouds,
    thinned,
)
from steelnb.plots.style import (
    BANDS,
    BLACK,
    BLUE,
    COLOURS,
    CURVES,
    GREY,
    LABELS,
    ORANGE,
    Figure,
    gather_bar,
    gather_legend,
    use,
)

__all__ = [
    "BANDS", "BLACK", "BLUE", "COLOURS", "CURVES", "GREY", "LABELS", "ORANGE", "Figure", "draw_bars", "draw_flight",
    "draw_judged_bars", "draw_lines", "draw_tower", "end_points", "figure_clouds", "gather_bar", "gather_legend",
    "thinned", "use",
]  # fmt: skip
