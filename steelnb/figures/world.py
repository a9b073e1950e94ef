"""Figure 3.1, the tower, and the drift of each noise over time."""

from collections.abc import Mapping

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from steelnb.datatypes import Array, Trajectory
from steelnb.figures.style import COLOURS, Figure, frame_3d, style
from steelnb.simulation import Tower


def figure_tower(tower: Tower, flights: Mapping[str, Trajectory]) -> Figure:
    """The tower as the sensors see it, with the flights around it, and its members by class from two sides."""
    kinds = ("ring", "bracing", "arm", "leg")
    with style():
        figure = Figure(figsize=(11, 7))
        grid = figure.add_gridspec(1, 3, width_ratios=(1.25, 1, 0.55))
        scene = figure.add_subplot(grid[0], projection="3d", computed_zorder=False)
        colour = np.array([COLOURS[tower.members[m].kind] for m in tower.triangle_member])
        mesh = Poly3DCollection(tower.vertices[tower.triangles], facecolors=colour, edgecolors=colour, linewidths=0.15)
        scene.add_collection3d(mesh, autolim=False)
        for name, flight in flights.items():
            scene.plot(*flight.position.T, color=COLOURS[name], linewidth=1.1, label=f"{name} flight")
        frame_3d(scene, np.concatenate([tower.vertices, *(f.position for f in flights.values())]))
        scene.legend(loc="upper left", bbox_to_anchor=(-0.1, 1.0))
        axes = tower.axes
        for panel, (across, name) in enumerate(((0, "x"), (1, "y")), start=1):
            side = figure.add_subplot(grid[panel])
            for kind in kinds:
                chosen = [m for m, member in enumerate(tower.members) if member.kind == kind]
                lines = axes[chosen][:, :, [across, 2]]
                side.plot(*np.concatenate([lines, np.full((len(lines), 1, 2), np.nan)], axis=1).reshape(-1, 2).T,
                          color=COLOURS[kind], linewidth=1.2, label=f"{kind} ({len(chosen)})")  # fmt: skip
            side.set(aspect="equal", xlabel=f"{name} (m)", ylim=(-0.3, tower.settings.height_m + 0.5))
            side.set_title("front" if panel == 1 else "side")
            if panel == 1:
                side.set_ylabel("z (m)")
        figure.legend(*side.get_legend_handles_labels(), loc="outside lower right", ncols=4)
    return figure


def figure_drift(curves: Mapping[str, tuple[Array, Array]], analytic_m: Mapping[str, Array], claim: str) -> Figure:
    """Drift over time, a panel for each noise.

    ``curves`` maps a noise to stamps ``(N,)`` and errors ``(S, N)`` of many seeds, metres, or radians for a yaw noise;
    ``analytic_m`` to the expected RMS at those stamps. The report's claim (1 m after 3 min) is marked in the panel of
    the noise named ``claim``.
    """
    with style():
        figure = Figure(figsize=(11, 3.8))
        for k, (name, (stamp, errors)) in enumerate(curves.items()):
            panel = figure.add_subplot(1, len(curves), k + 1)
            yaw = name.startswith("yaw")
            scale = np.degrees(1.0) if yaw else 1.0
            minutes = stamp / 60
            thin = slice(None, None, max(1, len(stamp) // 500))
            panel.plot(minutes[thin], scale * errors[:8, thin].T, color="#999999", linewidth=0.7, alpha=0.8)
            panel.plot([], [], color="#999999", linewidth=0.9, label="single seeds")
            rms = scale * np.sqrt((errors**2).mean(axis=0))
            panel.plot(minutes[thin], rms[thin], color=COLOURS["average"], label=f"RMS of {len(errors)} seeds")
            panel.plot(minutes[thin], scale * analytic_m[name][thin], "--", color=COLOURS["truth"], label="expected")
            if name == claim:
                panel.plot(3, 1.0, "*", color=COLOURS["none"], markersize=13, label="report: about 1 m")
            panel.set(title=name, xlabel="time (min)", ylabel="heading error (°)" if yaw else "position error (m)")
            panel.set_ylim(bottom=0)
            panel.legend(loc="upper left", fontsize=9)
    return figure
