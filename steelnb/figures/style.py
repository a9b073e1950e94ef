"""One look for all figures: colours that the colour-blind can tell apart, and text legible at half size."""

import io
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
import matplotlib.figure
import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from steelnb.datatypes import Array

# Okabe and Ito's palette (2008).
COLOURS = {
    "truth": "#000000",
    "none": "#D55E00",
    "average": "#0072B2",
    "least_squares": "#009E73",
    "report": "#777777",
    "leg": "#000000",
    "ring": "#0072B2",
    "bracing": "#009E73",
    "arm": "#D55E00",
    "vertical": "#CC79A7",
    "orbit": "#56B4E9",
    "icp": "#0072B2",
    "icp-3dof": "#56B4E9",
    "icp-3dof-dropped": "#882255",
    "icp-4dof": "#E69F00",
    "gicp": "#117733",
    "gicp-4dof": "#999933",
    "vgicp": "#AA4499",
    "best": "#CC79A7",
    "least_squares_yaw": "#44AA99",
    "combined": "#332288",
    "built": "#009E73",
    "true cloud": "#E69F00",
}
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
}


class Figure(matplotlib.figure.Figure):
    """A figure that notebooks show by itself: pyplot, whose state is global, is never needed."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=90)
        return file.getvalue()


@contextmanager
def style() -> Iterator[None]:
    """The settings that every figure is drawn with, whatever the user's matplotlibrc says."""
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


def draw_bars(axis, bars: Array, **look) -> None:  # type: ignore[no-untyped-def]
    """Draw bars ``(M, 2, 3)`` into a 3D axis."""
    axis.add_collection3d(Line3DCollection(bars, **look), autolim=False)


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
