"""Figure 3.4: all extracted segments, without and with correction."""

from collections.abc import Sequence

import numpy as np

from steelnb.experiment import Result
from steelnb.figures.style import COLOURS, LABELS, Figure, draw_bars, frame_3d, style
from steelnb.metrics import score_segments


def figure_maps(results: Sequence[Result]) -> Figure:
    """All segments of each run's map over the true members (grey), a panel a run, seen at an angle.

    Segments within 5° and 10 cm of a true member along half their length are green, the others red.
    """
    colour = COLOURS["least_squares"]
    width, height, side = 4.2 * len(results), 7.3, 5.9
    with style():
        # Placed by hand: a 3D axis is square, and squares side by side would leave the towers small.
        figure = Figure(figsize=(width, height))
        figure.set_layout_engine("none")
        for k, result in enumerate(results):
            centre = (k + 0.5) / len(results)
            place = (centre - 0.5 * side / width, 0.1, side / width, side / height)
            scene = figure.add_axes(place, projection="3d", facecolor="none")
            truth, segments = result.truth, result.segments
            right = score_segments(segments, truth.tower.axes).right
            draw_bars(scene, truth.tower.axes, colors="#bbbbbb", linewidths=0.6)
            bars = np.stack([segments.start, segments.end], axis=1)
            draw_bars(scene, bars[right], colors=colour, linewidths=1.6)
            draw_bars(scene, bars[~right], colors="#c0392b", linewidths=1.0)
            frame_3d(scene, truth.tower.vertices, -65, zoom=1.0)
            title = f"{np.count_nonzero(right)} on a member, {np.count_nonzero(~right)} not"
            figure.text(centre, 0.99, f"{LABELS[result.settings.odometry.method]}\n{title}", ha="center", va="top",
                        fontsize=12)  # fmt: skip
        for label, shade in {"on a member": colour, "not on one": "#c0392b", "true members": "#bbbbbb"}.items():
            scene.plot([], [], color=shade, label=label)
        figure.legend(*scene.get_legend_handles_labels(), loc="lower center", ncols=3)
    return figure
