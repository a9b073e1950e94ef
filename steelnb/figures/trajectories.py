"""Figures 3.2 and 3.3: trajectories in space, and the position error over the scans."""

from collections.abc import Sequence

import numpy as np

from steelnb.experiment import Result
from steelnb.figures.report import REPORT_SEGMENT_ODOMETRY
from steelnb.figures.style import COLOURS, LABELS, Figure, draw_bars, frame_3d, style
from steelnb.metrics import position_error_m


def figure_segment_odometry(results: Sequence[Result]) -> Figure:
    """A row for each noise: the trajectories (left), the distance to the truth with and without correction (right).

    ``results`` hold one flight under any noises, each with the correction ``none`` among others. The dashed line and
    the grey band are the report's usual and largest corrected error.
    """
    noises = list(dict.fromkeys(result.settings.noise_name for result in results))
    flight = results[0].settings.flight.trajectory
    report = REPORT_SEGMENT_ODOMETRY[flight]
    with style():
        figure = Figure(figsize=(11, 4.6 * len(noises)))
        grid = figure.add_gridspec(len(noises), 2, width_ratios=(1, 1.7))
        for row, noise in enumerate(noises):
            of_noise = [result for result in results if result.settings.noise_name == noise]
            best = of_noise[-1]
            scene = figure.add_subplot(grid[row, 0], projection="3d")
            truth = best.truth.trajectory
            draw_bars(scene, best.truth.tower.axes, colors="#bbbbbb", linewidths=0.4)
            scene.plot(*best.prior.position.T, color=COLOURS["none"], linewidth=1.0, label="Noisy")
            scene.plot(*truth.position.T, color=COLOURS["truth"], linewidth=1.4, label="Truth")
            adjusted = COLOURS[best.settings.odometry.method]
            scene.plot(*best.corrected.position.T, color=adjusted, linewidth=1.0, label="Adjust")
            frame_3d(
                scene, np.concatenate([best.truth.tower.vertices, truth.position, best.prior.position]), -50, zoom=1.1
            )
            scene.legend(loc="upper left", bbox_to_anchor=(-0.15, 1.0), fontsize=10)

            curve = figure.add_subplot(grid[row, 1])
            for result in of_noise:
                method = result.settings.odometry.method
                error = position_error_m(result.corrected, truth)
                label = f"{LABELS[method]}: mean {error.mean():.3f} m, max {error.max():.3f} m"
                curve.plot(error, color=COLOURS[method], label=label)
            curve.axhline(report["mean_m"], color=COLOURS["report"], linestyle="--", linewidth=1.2)
            curve.axhspan(0, report["max_m"], color=COLOURS["report"], alpha=0.12, linewidth=0,
                          label=f"report: about {report['mean_m']} m, max {report['max_m']} m")  # fmt: skip
            curve.set(
                xlabel="ToF scan (5 Hz)", ylabel="distance to the truth (m)", ylim=(0, 1.45 * curve.get_ylim()[1])
            )
            curve.set_xlim(0, len(best.corrected) - 1)
            curve.set_title(f"{flight} flight, {noise}, sensor {best.settings.sensor}, seed {best.settings.seed}")
            curve.legend(loc="upper left", fontsize=10)
    return figure
