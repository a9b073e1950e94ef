"""The picture of `steelnb structure A B`: both structures, with what is missing, extra and moved in colour."""

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from steelnb.datatypes import Array, Segments
from steelnb.figures.segments import seen, upright_box
from steelnb.figures.style import Figure, style
from steelnb.fusion.compare import Comparison
from steelnb.fusion.structure import Structure

# Okabe and Ito's palette (2008).
COLOURS = {"same": "#b0b0b0", "missing": "#D55E00", "extra": "#0072B2", "moved": "#009E73"}
HEIGHT_IN = 7.0


def figure_comparison(a: Structure, b: Structure, found: Comparison, title: str) -> Figure:
    """Front, side and perspective at one scale. Bars are lines, joints rings; of what has moved, A's place is dashed.

    The front is the widest view, as in `figure_segments`; lengths are metres from the middle and the lowest end.
    """
    both = np.concatenate([_ends(s.segments).reshape(-1, 3) for s in (a, b)])
    turn = upright_box(both)
    low, high = (both @ turn.T).min(axis=0), (both @ turn.T).max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    corners = both @ turn.T - shift
    moved, moved_joint = found.bar_moved, found.joint_moved | found.joint_retied
    # Nothing that has changed may lie below what has not.
    layers = [
        ("same", "-", b, found.bar[~moved, 1], found.joint[~moved_joint, 1]),
        ("moved", "--", a, found.bar[moved, 0], found.joint[[]][:, 0]),
        ("moved", "-", b, found.bar[moved, 1], found.joint[moved_joint, 1]),
        ("missing", "-", a, found.bar_missing, found.joint_missing),
        ("extra", "-", b, found.bar_extra, found.joint_extra),
    ]
    flat = {"front": [0, 2], "side": [1, 2]}

    def view(points: Array, name: str) -> Array:
        near = points @ turn.T - shift
        return seen(near, corners) if name == "perspective" else near[:, flat[name]]

    names = (*flat, "perspective")
    sizes = [np.maximum(np.ptp(view(both, name), axis=0), 0.5) for name in names]
    with style():
        tallest, total = max(size[1] for size in sizes), sum(size[0] for size in sizes)
        width = float(np.clip(HEIGHT_IN / tallest * total + 3.0, 8.0, 16.0))
        figure = Figure(figsize=(width, HEIGHT_IN + 1.2))
        panels = figure.subplots(1, 3, width_ratios=[size[0] for size in sizes])
        for panel, name in zip(panels, names, strict=True):
            for kind, dash, structure, bars, joints in layers:
                ends = view(_ends(structure.segments)[bars].reshape(-1, 3), name).reshape(-1, 2, 2)
                thick = 1.0 if kind == "same" else 2.2 if dash == "-" else 1.2
                panel.add_collection(
                    LineCollection(list(ends), colors=COLOURS[kind], linewidths=thick, linestyles=dash)
                )
                at = view(structure.joint[joints], name)
                if kind != "same":
                    panel.plot(at[:, 0], at[:, 1], "o", mfc="none", mec=COLOURS[kind], mew=1.3, ms=7)
            panel.autoscale_view()
            panel.set(aspect="equal", title=name)
            panel.margins(0.05)
            if name == "perspective":
                panel.set_axis_off()
                continue
            panel.set_xlabel("across (m)" if name == "front" else "along (m)")
            if name == "front":
                panel.set_ylabel("height (m)")
        keys = [Line2D([], [], color=colour, lw=2.5) for colour in COLOURS.values()]
        bars_of = (len(found.bar) - int(moved.sum()), len(found.bar_missing), len(found.bar_extra), int(moved.sum()))
        joints_of = (len(found.joint) - int(moved_joint.sum()), len(found.joint_missing), len(found.joint_extra),
                     int(moved_joint.sum()))  # fmt: skip
        labels = [f"{kind}: {bars} bars, {joints} joints"
                  for kind, bars, joints in zip(COLOURS, bars_of, joints_of, strict=True)]  # fmt: skip
        figure.legend(keys, labels, loc="outside lower center", ncols=4 if width > 11 else 2)
        figure.suptitle(title, fontsize=12)
    return figure


def _ends(segments: Segments) -> Array:
    return np.stack([segments.start, segments.end], axis=1)
