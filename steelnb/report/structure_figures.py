"""Figures of maps over a tower (Figures 3.4 and 5.1)."""

from collections.abc import Sequence

import numpy as np

from steelnb.batch import caption
from steelnb.experiment import Result
from steelnb.metrics import score_segments
from steelnb.plots import LABELS, Figure, draw_judged_bars, end_points, gather_legend, project_perspective, style

TOWER_IN = 7.0


@style()
def figure_maps(results: Sequence[Result]) -> Figure:
    """All segments of each run's map over the true members, a panel a run.

    Segments within 5° and 10 cm of a true member along half their length are right, the others wrong.
    """
    tower = results[0].truth.tower
    width, height = np.ptp(project_perspective(tower.vertices, tower.vertices), axis=0)
    figure = Figure(figsize=(len(results) * max(width * TOWER_IN / height + 0.3, 3.7) + 0.8, TOWER_IN + 1.8))
    for panel, result in zip(figure.subplots(1, len(results), squeeze=False)[0], results, strict=True):
        right = score_segments(result.segments, tower.axes).right
        draw_judged_bars(panel, tower.axes, end_points(result.segments), right)
        counts = f"{np.count_nonzero(right)} on a member, {np.count_nonzero(~right)} not"
        panel.set_title(f"{LABELS[result.settings.odometry.method]}\n{counts}", fontsize=11)
    gather_legend(figure, ncols=3)
    figure.suptitle(caption(results))
    return figure
