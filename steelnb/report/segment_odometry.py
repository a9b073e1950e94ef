"""Notebook 02: segment odometry under drift (Figures 3.2 and 3.3) and its maps of segments (Figure 3.4)."""

from collections.abc import Sequence

import numpy as np

from steelnb.experiment import Result
from steelnb.metrics import position_error_m, score_segments
from steelnb.report.style import COLOURS, LABELS, Figure, draw_bars, end_points, frame_3d, style

REPORT_SEGMENT_ODOMETRY: dict[str, dict[str, float]] = {
    "vertical": {"raw_final_m": 4.2, "mean_m": 0.2, "max_m": 0.28, "steps": 1050},
    "orbit": {"raw_final_m": 2.1, "mean_m": 0.3, "max_m": 0.42, "steps": 800},
}
"""Figures 3.2b and 3.3b: the drift at the end, and the corrected error's usual and largest value."""


@style()
def figure_errors(results: Sequence[Result]) -> Figure:
    """A row for each noise: the trajectories (left), the distance to the truth with and without correction (right).

    ``results`` hold one flight under any noises, each with the correction ``none`` among others. The dashed line and
    the grey band are the report's usual and largest corrected error.
    """
    noises = list(dict.fromkeys(result.settings.noise_name for result in results))
    flight = results[0].settings.flight.trajectory
    report = REPORT_SEGMENT_ODOMETRY[flight]
    figure = Figure(figsize=(11, 4.6 * len(noises)))
    grid = figure.add_gridspec(len(noises), 2, width_ratios=(1, 1.7))
    for row, noise in enumerate(noises):
        of_noise = [result for result in results if result.settings.noise_name == noise]
        best = of_noise[-1]
        truth, tower = best.truth.trajectory, best.truth.tower
        scene = figure.add_subplot(grid[row, 0], projection="3d")
        draw_bars(scene, tower.axes, colors="#bbbbbb", linewidths=0.4)
        scene.plot(*best.prior.position.T, color=COLOURS["none"], linewidth=1.0, label="Noisy")
        scene.plot(*truth.position.T, color=COLOURS["truth"], linewidth=1.4, label="Truth")
        adjusted = COLOURS[best.settings.odometry.method]
        scene.plot(*best.corrected.position.T, color=adjusted, linewidth=1.0, label="Adjust")
        frame_3d(scene, np.concatenate([tower.vertices, truth.position, best.prior.position]), -50, zoom=1.1)
        scene.legend(loc="upper left", bbox_to_anchor=(-0.15, 1.0), fontsize=10)

        curve = figure.add_subplot(grid[row, 1])
        for result in of_noise:
            method = result.settings.odometry.method
            error = position_error_m(result.corrected, truth)
            label = f"{LABELS[method]}: mean {error.mean():.3f} m, max {error.max():.3f} m"
            curve.plot(error, color=COLOURS[method], label=label)
        curve.axhline(report["mean_m"], color=COLOURS["report"], linestyle="--", linewidth=1.2)
        label = f"report: about {report['mean_m']} m, max {report['max_m']} m"
        curve.axhspan(0, report["max_m"], color=COLOURS["report"], alpha=0.12, linewidth=0, label=label)
        curve.set(xlabel="ToF scan (5 Hz)", ylabel="distance to the truth (m)", xlim=(0, len(best.corrected) - 1))
        curve.set_ylim(0, 1.45 * curve.get_ylim()[1])
        curve.set_title(f"{flight} flight, {noise}, sensor {best.settings.sensor}, seed {best.settings.seed}")
        curve.legend(loc="upper left", fontsize=10)
    return figure


@style()
def figure_maps(results: Sequence[Result]) -> Figure:
    """All segments of each run's map over the true members (grey), a panel a run, seen at an angle.

    Segments within 5° and 10 cm of a true member along half their length are green, the others red.
    """
    shades = {"on a member": COLOURS["least_squares"], "not on one": "#c0392b", "true members": "#bbbbbb"}
    width, height, side = 4.2 * len(results), 7.3, 5.9
    # Placed by hand: a 3D axis is square, and squares side by side would leave the towers small.
    figure = Figure(figsize=(width, height))
    figure.set_layout_engine("none")
    for k, result in enumerate(results):
        centre = (k + 0.5) / len(results)
        place = (centre - 0.5 * side / width, 0.1, side / width, side / height)
        scene = figure.add_axes(place, projection="3d", facecolor="none")
        tower, bars = result.truth.tower, end_points(result.segments)
        right = score_segments(result.segments, tower.axes).right
        draw_bars(scene, tower.axes, colors=shades["true members"], linewidths=0.6)
        draw_bars(scene, bars[right], colors=shades["on a member"], linewidths=1.6)
        draw_bars(scene, bars[~right], colors=shades["not on one"], linewidths=1.0)
        frame_3d(scene, tower.vertices, -65, zoom=1.0)
        title = f"{np.count_nonzero(right)} on a member, {np.count_nonzero(~right)} not"
        title = f"{LABELS[result.settings.odometry.method]}\n{title}"
        figure.text(centre, 0.99, title, ha="center", va="top", fontsize=12)
    for label, shade in shades.items():
        scene.plot([], [], color=shade, label=label)
    figure.legend(*scene.get_legend_handles_labels(), loc="lower center", ncols=3)
    return figure
