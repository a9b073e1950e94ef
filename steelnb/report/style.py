"""The style of all figures, with one table of colours and one of names, and drawing helpers shared by them."""

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from steelnb.types import Array, Segments

# Okabe and Ito's palette (2008), which the colour-blind can tell apart.
BLACK, BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE = (
    "#000000", "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7"
)  # fmt: skip
GREY, LIGHT_GREY = "#777777", "#b8b8b8"
COLOURS = {
    "truth": BLACK, "drifting": VERMILION, "corrected": BLUE, "report": GREY, "built": GREEN, "true cloud": ORANGE,
    "leg": BLACK, "ring": BLUE, "bracing": GREEN, "arm": VERMILION, "vertical": PURPLE, "orbit": SKY,
    "none": VERMILION, "average": BLUE, "least_squares": GREEN, "least_squares_yaw": "#44AA99", "icp": BLUE,
    "icp-3dof": SKY, "icp-3dof-dropped": "#882255", "icp-4dof": ORANGE, "gicp": "#117733", "gicp-4dof": "#999933",
    "vgicp": "#AA4499", "best": PURPLE, "combined": "#332288", "smoothed": BLACK,
    "hough": VERMILION, "hough-once": "#882255", "hough-blocks": PURPLE, "ransac-lines": BLUE,
    "ransac-lines-uniform": SKY, "ransac-planes": GREY, "gmm": GREEN, "dbscan": ORANGE,
    "final": BLUE, "incremental": ORANGE,
}  # fmt: skip
LABELS = {
    "none": "no correction",
    "average": "average (report's)",
    "least_squares": "least squares",
    "icp": "ICP",
    "icp-3dof": "3-DoF ICP",
    "icp-3dof-dropped": "3-DoF ICP, rotation dropped",
    "icp-4dof": "4-DoF ICP",
    "gicp": "GICP",
    "gicp-4dof": "4-DoF GICP",
    "vgicp": "VGICP",
    "best": "best",
    "least_squares_yaw": "least squares with yaw",
    "combined": "combined",
    "smoothed": "smoothed",
}


class Figure(matplotlib.figure.Figure):
    """A figure that notebooks show by itself: pyplot, whose state is global, is never needed."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=90)
        return file.getvalue()


@contextmanager
def style() -> Iterator[None]:
    """Settings that every figure is drawn with, whatever the user's matplotlibrc says; ``@style()`` as a decorator."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(
            {
                "font.size": 11,
                "axes.titlesize": 12,
                "axes.grid": True,
                "grid.alpha": 0.3,
                "axes.spines.top": False,
                "axes.spines.right": False,
                "legend.frameon": False,
                "lines.linewidth": 1.6,
                "figure.facecolor": "white",
                "figure.constrained_layout.use": True,
            }
        )
        yield


def draw_legend(
    figure: matplotlib.figure.Figure,
    keys: Mapping[str, Mapping[str, Any]],
    loc: str = "outside lower center",
    **more: Any,
) -> None:
    """A legend of the figure from label → properties of a line, or of a patch where they have a ``facecolor``."""
    handles = [
        Patch(label=label, **look) if "facecolor" in look else Line2D([], [], label=label, **look)
        for label, look in keys.items()
    ]
    options: dict[str, Any] = {"loc": loc, "ncols": len(keys), **more}
    figure.legend(handles=handles, **options)


def draw_lines(panel: Axes, lines: Array, **look: Any) -> None:
    """Draw straight lines ``(M, 2, 2)`` into a panel; ``look`` are properties of a `LineCollection`."""
    panel.add_collection(LineCollection(list(lines), **{"capstyle": "round", **look}))


def draw_sample(
    panel: Axes,
    place: float,
    values: Array,
    colour: str,
    marker: str = "o",
    middle: Callable[[Array], Any] = np.mean,
    limits: tuple[float, float] = (-np.inf, np.inf),
    width: float = 0.3,
    across: bool = False,
    **look: Any,
) -> float:
    """Draw values ``(N,)`` as dots side by side around ``place`` on the other axis, and their middle, which is given
    back, as a black bar of a ``width``; upright columns, or with ``across`` rows. Dots stay within ``limits``."""
    spread = place + 0.45 * width * np.sin(2.4 * np.arange(len(values)))  # the golden angle: no two dots coincide
    centre, side = float(middle(values)), [place - 0.55 * width, place + 0.55 * width]
    turn = -1 if across else 1
    panel.plot(*(spread, np.clip(values, *limits))[::turn], marker, color=colour, **look)
    panel.plot(*(side, [centre, centre])[::turn], color=BLACK, linewidth=2.0)
    return centre


def draw_bars(axis, bars: Array, **look) -> None:  # type: ignore[no-untyped-def]
    """Draw bars ``(M, 2, 3)`` into a 3D axis."""
    axis.add_collection3d(Line3DCollection(bars, **look), autolim=False)


def end_points(segments: Segments) -> Array:
    """Both ends of each segment ``(M, 2, 3)``."""
    return np.stack([segments.start, segments.end], axis=1)


def thinned(points: Array, count: int) -> Array:
    """At most ``count`` of the points ``(N, 3)``, evenly over their order."""
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)]


def frame_3d(axis, points: Array, azimuth_deg: float = -60, zoom: float = 1.25) -> None:  # type: ignore[no-untyped-def]
    """Equal scales around ``points (N, 3)``, seen from 12° above without perspective; a tick every 4 m."""
    low, high = np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))
    axis.set_proj_type("ortho")
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low, zoom=zoom)
    axis.view_init(12, azimuth_deg)
    for name, sides in zip("xyz", zip(low, high, strict=True), strict=True):
        first = sides[0] if name != "y" else sides[0] + 1  # the first of y would lie on the last of x
        getattr(axis, f"set_{name}ticks")(np.arange(4 * np.ceil(first / 4), sides[1] + 0.1, 4))
        getattr(axis, f"set_{name}label")(f"{name} (m)", labelpad=-2 if name != "z" else -4)
        getattr(axis, f"{name}axis").set_pane_color((1, 1, 1, 0))
        axis.tick_params(axis=name, pad=-2)


def project_perspective(points: Array, cloud: Array) -> Array:
    """Points ``(…, 3)`` → ``(…, 2)`` in metres: a pinhole camera 10° above and 2.2 diagonals away from the middle of
    ``cloud``, where it is to scale.

    Not matplotlib's 3D axes, which draw into a square and hide bars behind points.
    """
    azimuth, elevation = np.radians([-55.0, 10.0])
    to_camera = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    away = points - (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    distance = 2.2 * np.linalg.norm(np.ptp(cloud, axis=0))
    flat = away @ np.stack([right, np.cross(to_camera, right)], axis=1)
    return np.asarray(flat * (distance / (distance - away @ to_camera))[..., None])
