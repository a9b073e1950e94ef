"""Figures of a recorded flight (notebook 09, `steelnb run`): a scan, the path, its errors, odometries compared."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from steelnb.report.style import BLUE, COLOURS, GREEN, LABELS, PINK, Figure, gather_legend, style, thinned
from steelnb.types import Array, Flight, Scan, Trajectory

AXES = {"x": BLUE, "y": PINK, "z": GREEN}
POINTS_MAX = 40_000


@style()
def figure_scan(scan: Scan, poses: Trajectory, truth: Trajectory | None, title: str) -> Figure:
    """Left: the ranges of a scan as the sensor sees it. Right: the recorded position over time, the true one dashed.

    A scan that is no image is drawn by direction. The dotted line is the time of the scan.
    """
    figure = Figure(figsize=(11, 4.2))
    seen, path = figure.subplots(1, 2, width_ratios=(1, 1.25))
    seen.set_title(f"a scan: {np.isfinite(scan.points).all(axis=-1).sum()} points")
    figure.colorbar(_draw_ranges(seen, scan.points), ax=seen, label="range (m)", shrink=0.9)
    begin_s = min(poses.stamp_s[0], scan.stamp_s)
    for axis, (name, colour) in enumerate(AXES.items()):
        path.plot(poses.stamp_s - begin_s, poses.position[:, axis], color=colour, label=name)
        if truth is not None:
            path.plot(truth.stamp_s - begin_s, truth.position[:, axis], "--", color=colour, linewidth=1.0)
    path.axvline(scan.stamp_s - begin_s, color=COLOURS["truth"], linestyle=":", label="time of the scan")
    path.set(xlabel="time (s)", ylabel="position (m)", title="poses as recorded")
    if truth is not None:
        path.plot([], [], "--", color=COLOURS["truth"], linewidth=1.0, label="truth")
    gather_legend(figure, "outside lower right", ncols=5)
    figure.suptitle(title, fontsize=12)
    return figure


def figure_middle_scan(flight: Flight, truth: Trajectory | None) -> Figure:
    """`figure_scan` of the first scan with a point in the second half of a flight, or of its last one."""
    later = flight.scans[len(flight) // 2 :]
    scan = next((scan for scan in later if scan.points.size), later[-1])
    return figure_scan(scan, flight.prior, truth, flight.name)


def _draw_ranges(panel: Axes, points: Array):  # type: ignore[no-untyped-def]
    """The ranges of a scan ``(H, W, 3)`` as an image, or of rays ``(N, 3)`` by azimuth and elevation."""
    if points.ndim == 3:
        panel.set(xlabel="column", ylabel="row")
        panel.grid(False)
        return panel.imshow(np.linalg.norm(points, axis=2), cmap="viridis_r", interpolation="nearest")
    points = thinned(points[np.isfinite(points).all(axis=1)], POINTS_MAX)
    range_m = np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(points[:, 2] / np.maximum(range_m, 1e-9)))
    panel.set(xlabel="to the left (°)", ylabel="upwards (°)")
    panel.invert_xaxis()
    return panel.scatter(azimuth, elevation, c=range_m, s=1.5, linewidths=0, cmap="viridis_r")


@style()
def figure_recorded_errors(stamp_s: Array, prior_m: Array, corrected_m: Array, method: str, title: str) -> Figure:
    """Distance to the truth over time, before and after correction; ``prior_m`` and ``corrected_m`` are ``(N,)``."""
    figure = Figure(figsize=(9, 4.2))
    panel = figure.add_subplot()
    time_s = stamp_s - stamp_s[0]
    named = (("drifting", prior_m, COLOURS["none"]), (LABELS[method], corrected_m, COLOURS[method]))
    for label, error, colour in named:
        rms = float(np.sqrt((error**2).mean()))
        panel.plot(time_s, error, color=colour, label=f"{label}: rms {rms:.3f} m, max {error.max():.3f} m")
    panel.set(xlabel="time (s)", ylabel="distance to the truth (m)", xlim=(0, max(time_s[-1], 1e-3)), title=title)
    panel.set_ylim(0, 1.25 * max(panel.get_ylim()[1], 1e-3))
    panel.legend(loc="upper left")
    return figure


@style()
def figure_recorded_trajectories(
    prior: Trajectory, corrected: Trajectory, truth: Trajectory | None, method: str, title: str
) -> Figure:
    """The path from above and from the side on which it is widest, at one scale, metres in the world frame."""
    named = [("drifting", prior, COLOURS["none"], 1.2), (LABELS[method], corrected, COLOURS[method], 1.3)]
    if truth is not None:
        named.insert(1, ("truth", truth, COLOURS["truth"], 3.6))  # wide: the corrected path lies on it
    everything = np.concatenate([path.position for _, path, _, _ in named])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.06 * max(float((high - low).max()), 0.1)
    low, high = low - margin, high + margin
    views = {"from above": [0, 1], "from the side": [int(np.argmax((high - low)[:2])), 2]}
    widths, heights = np.array([(high - low)[columns] for columns in views.values()]).T
    inches = min(9.4 / widths.sum(), 7.0 / heights.max())  # for a metre, in both panels
    figure = Figure(figsize=(max(inches * widths.sum(), 5.0) + 1.6, max(inches * heights.max(), 1.2) + 1.7))
    panels = figure.subplots(1, 2, width_ratios=widths.tolist())
    for panel, (name, columns) in zip(panels, views.items(), strict=True):
        across, up = columns
        for label, path, colour, width in named:
            panel.plot(path.position[:, across], path.position[:, up], color=colour, linewidth=width, label=label)
        panel.plot(*prior.position[0][columns], "o", color=COLOURS["truth"], markersize=5, label="start")
        panel.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal", title=name)
        panel.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
        for axis in (panel.xaxis, panel.yaxis):
            most = int(1.4 * inches * np.ptp(axis.get_view_interval()))
            axis.set_major_locator(MaxNLocator(max(1, min(8, most)), steps=[1, 2, 5, 10]))
    gather_legend(figure, ncols=4)
    figure.suptitle(title, fontsize=12)
    return figure


@style()
def figure_comparison(
    curves: Mapping[str, tuple[Array, Array]], times_ms: Mapping[str, Array], period_ms: float, what: str, title: str
) -> Figure:
    """Odometries side by side. Left: metres ``(N,)`` over stamps ``(N,)``. Right: milliseconds ``(K,)`` a scan of each.

    A dot is the median, a bar goes from it to the 95th percentile, a tick is the 99th; ``period_ms`` is the time from
    scan to scan, infinite for a lone one. ``drifting`` among ``curves`` are the recorded poses, other names methods.
    """
    figure = Figure(figsize=(11, 4.6))
    over_time, taken = figure.subplots(1, 2, width_ratios=(1.6, 1))
    begin_s = min(stamp_s[0] for stamp_s, _ in curves.values())
    for name, (stamp_s, distance_m) in curves.items():
        label, rms = LABELS.get(name, name), float(np.sqrt((distance_m**2).mean()))
        colour = COLOURS["none" if name == "drifting" else name]
        over_time.plot(stamp_s - begin_s, distance_m, color=colour, label=f"{label}: rms {rms:.3f} m")
    over_time.set(xlabel="time (s)", ylabel=what)
    over_time.set_ylim(0, 1.1 * max(over_time.get_ylim()[1], 1e-3))
    for row, (name, ms) in enumerate(times_ms.items()):
        median, p95, p99 = np.percentile(ms, [50, 95, 99])
        taken.plot([median, p95], [row, row], color=COLOURS[name], linewidth=9, solid_capstyle="butt")
        taken.plot(median, row, "o", color=COLOURS[name], markersize=12)
        taken.plot(p99, row, "|", color=COLOURS[name], markersize=18, markeredgewidth=3)
    if np.isfinite(period_ms):
        taken.axvline(period_ms, color=COLOURS["truth"], linestyle=":", label="time between two scans")
    taken.set(yticks=range(len(times_ms)), yticklabels=[LABELS[name] for name in times_ms])
    taken.set(xlabel="time a scan (ms): median, 95 %, 99 %", xscale="log", ylim=(len(times_ms) - 0.5, -0.5))
    taken.xaxis.set_major_formatter("{x:g}")
    gather_legend(figure, ncols=3)
    figure.suptitle(title, fontsize=12)
    return figure
