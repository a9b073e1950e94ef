"""What a recording holds, before anything is done with it: one scan, and the poses as recorded."""

import numpy as np

from steelnb.datatypes import Array, Scan, Trajectory
from steelnb.figures.style import COLOURS, Figure, style

AXES = {"x": COLOURS["none"], "y": COLOURS["least_squares"], "z": COLOURS["average"]}
POINTS_MAX = 40_000


def figure_scan(scan: Scan, poses: Trajectory, truth: Trajectory | None, title: str) -> Figure:
    """Left: the ranges of a scan as the sensor sees it. Right: the recorded position over time, the true one dashed.

    A scan that is no image is drawn by direction. The dotted line is the time of the scan.
    """
    with style():
        figure = Figure(figsize=(11, 4.2))
        seen, path = figure.subplots(1, 2, width_ratios=(1, 1.25))
        seen.set_title(f"a scan: {np.isfinite(scan.points).all(axis=-1).sum()} points")
        colours = _draw_image(seen, scan.points) if scan.points.ndim == 3 else _draw_rays(seen, scan.points)
        figure.colorbar(colours, ax=seen, label="range (m)", shrink=0.9)
        begin_s = min(poses.stamp_s[0], scan.stamp_s)
        for axis, (name, colour) in enumerate(AXES.items()):
            path.plot(poses.stamp_s - begin_s, poses.position[:, axis], color=colour, label=name)
            if truth is not None:
                path.plot(truth.stamp_s - begin_s, truth.position[:, axis], "--", color=colour, linewidth=1.0)
        path.axvline(scan.stamp_s - begin_s, color=COLOURS["report"], linestyle=":")
        path.set(xlabel="time (s)", ylabel="position (m)", title="poses as recorded")
        if truth is not None:
            path.plot([], [], "--", color=COLOURS["report"], label="truth")
        figure.legend(*path.get_legend_handles_labels(), loc="outside lower right", ncols=4)
        figure.suptitle(title, fontsize=12)
    return figure


def _draw_image(panel, points: Array):  # type: ignore[no-untyped-def]
    panel.set(xlabel="column", ylabel="row")
    panel.grid(False)
    return panel.imshow(np.linalg.norm(points, axis=2), cmap="viridis_r", interpolation="nearest")


def _draw_rays(panel, points: Array):  # type: ignore[no-untyped-def]
    points = points[np.isfinite(points).all(axis=1)]
    points = points[np.linspace(0, len(points) - 1, min(len(points), POINTS_MAX)).astype(int)]
    range_m = np.linalg.norm(points, axis=1)
    azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / np.maximum(range_m, 1e-9))
    panel.set(xlabel="to the left (°)", ylabel="upwards (°)")
    panel.invert_xaxis()
    return panel.scatter(*np.degrees([azimuth, elevation]), c=range_m, s=1.5, linewidths=0, cmap="viridis_r")
