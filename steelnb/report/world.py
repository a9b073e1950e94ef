"""Notebook 01: the tower (Figure 3.1), the flights, and the drift of each noise over time."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.collections import PolyCollection

from steelnb import rng
from steelnb.batch import report_curve
from steelnb.images import GreyImage
from steelnb.noise import drifting, random_walk_rms_m
from steelnb.plots import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    KINDS,
    ORANGE,
    Figure,
    draw_bars,
    draw_lines,
    draw_paths,
    gather_legend,
    project_perspective,
    style,
)
from steelnb.settings import Noise
from steelnb.settings.report_plots import ReportPlot
from steelnb.simulation import FORWARD, TRACKING, Tower, Truth, photograph
from steelnb.simulation.sections import PLATE
from steelnb.types import Array, Flight, Trajectory

RATE_HZ = 125.0
ABOVE_DEG = 25.0
"""Elevation from which the tower is seen in Figure 3.1."""
SEEDS_DRAWN = 8
REPORT_DRIFT = {"random-walk": ("3.5", "vertical", "icp"), "constant-drift": ("3.6", "vertical", "icp")}
"""Noise → figure, flight and method of one of the plots that show its drift."""


def flight_table(flights: dict[str, tuple[Flight, Truth]]) -> pd.DataFrame:
    """Length, speed, height and tilt of each flight, and the returns of its sensor; a row a flight."""
    rows = []
    for name, (flight, truth) in flights.items():
        position, up = truth.trajectory.position, truth.trajectory.T_world_drone[:, 2, 2]
        tilt = np.arccos(np.clip(up, -1, 1))
        returns = np.array([np.isfinite(scan.points[..., 0]).sum() for scan in flight.scans])
        travelled = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
        rows.append(
            {
                "trajectory": name,
                "duration_s": truth.trajectory.stamp_s[-1],
                "length_m": travelled,
                "speed_mean_m_s": travelled / truth.trajectory.stamp_s[-1],
                "height_min_m": position[:, 2].min(),
                "height_max_m": position[:, 2].max(),
                "tilt_rms_deg": np.degrees(np.sqrt((tilt**2).mean())),
                "scans": len(flight.scans),
                "returns_median": float(np.median(returns)),
                "returns_min": int(returns.min()),
                "members_seen": int(truth.visibility.observed().sum()),
            }
        )
    return pd.DataFrame(rows)


def drift_curves(noise: str, seeds: Sequence[rng.Seed], duration_s: float) -> tuple[Array, Array]:
    """Drift of many seeds without flying: stamps ``(N,)`` at 125 Hz and errors ``(S, N)``.

    Drift does not depend on the flight, so a drone that stays where it is will do. Errors are of the position in
    metres or, where the noise has none, of the heading in radians.
    """
    settings = Noise.parse(noise)
    stamp = np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ
    still = Trajectory(stamp, np.tile(np.eye(4), (len(stamp), 1, 1)))
    errors = np.empty((len(seeds), len(stamp)))
    for k, seed in enumerate(seeds):
        T = drifting(still, settings, seed).T_world_drone
        heading = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
        errors[k] = np.abs(heading) if _turns_only(settings) else np.linalg.norm(T[:, :3, 3], axis=1)
    return stamp, errors


def expected_drift(noise: str, stamp_s: Array) -> Array:
    """Root mean square ``(N,)`` that the model of a noise gives: metres, or radians for a yaw noise."""
    settings = Noise.parse(noise)
    if _turns_only(settings):
        return np.asarray(settings.yaw_random_walk_rad * np.sqrt(RATE_HZ * stamp_s))
    return np.hypot(random_walk_rms_m(settings, stamp_s, RATE_HZ), settings.constant_drift_m * RATE_HZ * stamp_s)


def _turns_only(settings: Noise) -> bool:
    return settings.yaw_random_walk_rad > 0 and not (settings.random_walk_m or settings.constant_drift_m)


def drift_table(curves: dict[str, tuple[Array, Array]], every_s: float = 60.0) -> pd.DataFrame:
    """One row a noise and minute: the measured and the expected root mean square, and the share of seeds above 1."""
    rows = []
    for noise, (stamp, errors) in curves.items():
        unit, expected = "rad" if _turns_only(Noise.parse(noise)) else "m", expected_drift(noise, stamp)
        for time_s in np.arange(every_s, stamp[-1] + 1e-9, every_s):
            k = int(np.searchsorted(stamp, time_s - 1e-9))
            rms, above = np.sqrt((errors[:, k] ** 2).mean()), (errors[:, k] > 1).mean()
            rows.append((noise, time_s, unit, len(errors), rms, expected[k], above))
    return pd.DataFrame(rows, columns=["noise", "time_s", "unit", "seeds", "rms", "expected_rms", "share_above_1"])


def drift_metrics(drift: pd.DataFrame) -> dict[str, float]:
    """The measured values of `drift_table` in one flat map, ``<noise>.rms_<unit>_after_<time>_s``."""
    named = "{noise}.rms_{unit}_after_{time_s:.0f}_s"
    return {named.format_map(row): float(row["rms"]) for row in drift.to_dict("records")}


def drone_views(truth: Truth, seed: rng.Seed) -> dict[str, GreyImage]:
    """What the report's two cameras see in the middle of a flight, by what to call it."""
    views = {}
    for name, model in (("forward", FORWARD), ("tracking", TRACKING)):
        taken = photograph(truth.tower, truth.trajectory, model, seed)
        middle = len(taken) // 2
        if (image := taken.images[middle]) is not None:
            views[f"{name} camera, at {taken.stamp_s[middle]:.0f} s"] = image
    return views


@style()
def figure_tower(
    tower: Tower, flights: Mapping[str, Trajectory], views: Mapping[str, GreyImage] | None = None
) -> Figure:
    """The tower with the flights around it, from above the front right as in the report, and its members by class from
    two sides; beside them ``views`` from the drone, if there are any."""
    views, ratios = views or {}, [1.25, 1, 0.55] + [1.2] * bool(views)
    figure = Figure(figsize=(15.5 if views else 11, 7.2))
    grid = figure.add_gridspec(max(len(views), 1), len(ratios), width_ratios=ratios)
    scene, *sides = (figure.add_subplot(grid[:, column]) for column in range(3))
    for row, (name, image) in enumerate(views.items()):
        view = figure.add_subplot(grid[row, 3])
        view.imshow(image, cmap="gray", vmin=0, vmax=255)
        view.set(title=name, xticks=[], yticks=[])
    plates = tower.vertices[tower.triangles[tower.triangle_member == PLATE]]
    flat = project_perspective(plates, tower.vertices, ABOVE_DEG)
    scene.add_collection(PolyCollection(list(flat), fc=COLOURS["member"], ec=COLOURS["member"], lw=0.5, alpha=0.6))
    kinds = np.array([member.kind for member in tower.members])
    for kind in (name for name in reversed(KINDS) if name in kinds):
        bars = tower.axes[kinds == kind]
        look = {"colors": COLOURS[kind], "linewidths": {"leg": 2.2, "secondary": 0.8}.get(kind, 1.2)}
        draw_bars(scene, bars, tower.vertices, ABOVE_DEG, **look)
        for across, side in enumerate(sides):
            draw_lines(side, bars[:, :, [across, 2]], label=f"{kind} ({len(bars)})", **look)
    paths = {name: flight.position for name, flight in flights.items()}
    draw_paths(scene, paths, tower.vertices, {name: f"{name} flight" for name in flights}, ABOVE_DEG)
    for across, side in enumerate(sides):
        reach = np.abs(tower.axes[..., across]).max() + 0.3
        side.set(xlim=(-reach, reach), ylim=(-0.3, tower.joints[:, 2].max() + 0.5), aspect="equal")
        side.set(xlabel=f"{'xy'[across]} (m)", ylabel="z (m)", title=("front", "side")[across])
    gather_legend(figure, ncols=3)
    figure.suptitle(f"{', '.join(flights)} flight around the tower, no noise")
    return figure


@style()
def figure_drift(
    curves: Mapping[str, tuple[Array, Array]], own: Mapping[str, tuple[Array, Array]], claim: str
) -> Figure:
    """Drift over time, a panel for each noise.

    ``curves`` maps a noise to its `drift_curves`; the dashed line is their `expected_drift`. ``own`` are those of the
    report's own seed, beside the drift that its `REPORT_DRIFT` shows. The report's claim (1 m after 3 min) is marked in
    the panel of the noise named ``claim``.
    """
    figure = Figure(figsize=(11, 4.4))
    for k, (name, (stamp, errors)) in enumerate(curves.items()):
        panel = figure.add_subplot(1, len(curves), k + 1)
        yaw = name.startswith("yaw")
        scale = np.degrees(1.0) if yaw else 1.0
        minutes = stamp / 60
        thin = slice(None, None, max(1, len(stamp) // 500))
        panel.plot(minutes[thin], scale * errors[:SEEDS_DRAWN, thin].T, color=GREY, linewidth=0.7, alpha=0.8)
        panel.plot([], [], color=GREY, linewidth=0.9, label=f"{len(errors[:SEEDS_DRAWN])} single seeds")
        rms = scale * np.sqrt((errors**2).mean(axis=0))
        panel.plot(minutes[thin], rms[thin], color=BLUE, label=f"RMS of {len(errors)} seeds")
        panel.plot(
            minutes[thin], scale * expected_drift(name, stamp[thin]), "--", color=COLOURS["truth"], label="expected"
        )
        seconds, error = own[name]
        panel.plot(seconds[thin] / 60, scale * error[0, thin], color=ORANGE, label="the report's seed")
        if name in REPORT_DRIFT:
            seconds, drift = report_curve(ReportPlot.find(*REPORT_DRIFT[name]), "drift")
            label = f"the report's Figure {REPORT_DRIFT[name][0]}"
            panel.plot(seconds / 60, drift, ":", color=BLACK, label=label)
            panel.set_xlim(0, minutes[-1])
        if name == claim:
            panel.plot(3, 1.0, "*", color=COLOURS["report"], ms=16, mec="white", zorder=5, label="report: about 1 m")
        panel.set(title=name, xlabel="time (min)", ylabel="heading error (°)" if yaw else "position error (m)")
        panel.set_ylim(bottom=0)
        panel.legend(loc="upper left", fontsize=9)
    figure.suptitle("Drift alone, which depends on no flight and no sensor")
    return figure
