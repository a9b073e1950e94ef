"""The style of all figures, with one table of colours and one of names."""

import io
import warnings
from functools import partial
from typing import Any

import matplotlib.figure
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine

# Okabe and Ito's palette (2008), safe for colour-blind readers, and further colours that are distinct from it.
BLACK, BLUE, SKY, GREEN, ORANGE, VERMILION, PINK = (
    "#000000", "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7"
)  # fmt: skip
INDIGO, MAGENTA, WINE, OLIVE = "#332288", "#9E2A8F", "#882255", "#999933"
GREY, LIGHT_GREY = "#777777", "#b8b8b8"
VERDICTS = {"right": BLUE, "wrong": ORANGE, "missed": BLACK, "undecided": GREY}
METHOD_LOOKS = {
    "none": ("no correction", VERMILION),
    "average": ("average (report's)", OLIVE),
    "least_squares": ("least squares", "#E0C400"),
    "report-segments": ("report's segment program", "#1F9000"),
    "icp": ("ICP", SKY),
    "report-icp": ("report's ICP program", "#14ADB8"),
    "icp-3dof": ("3-DoF ICP", GREEN),
    "report-icp-3dof": ("report's 3-DoF program", "#85C2AD"),
    "icp-4dof": ("4-DoF ICP", "#1C7A7A"),
    "gicp": ("GICP", PINK),
    "report-gicp": ("report's GICP program", "#8F85C2"),
    "gicp-4dof": ("4-DoF GICP", WINE),
    "loam": ("LOAM", "#775511"),
    "best": ("best", MAGENTA),
    "least_squares_yaw": ("least squares with yaw", "#BFA76A"),
    "faces": ("front faces", "#656CFF"),
    "smoothed": ("smoothed", "#661100"),
    "orb": ("ORB features", "#DD0044"),
    "deepvo": ("DeepVO", "#88DD44"),
    "kiss-icp": ("KISS-ICP", "#101018"),
    "small-gicp": ("small_gicp's VGICP", "#3C2A33"),
}
"""Odometries: segments are olive to yellow, the report's program for them green, ICP blue to green, GICP pink to wine,
LOAM brown, combinations violet, images red, learned lime, third-party nearly black."""
DETECTORS = {
    "hough": ("Hough", INDIGO),
    "ransac-lines": ("RANSAC lines", GREEN),
    "ransac-planes": ("RANSAC planes", GREY),
    "gmm": ("GMM", PINK),
    "dbscan": ("DBSCAN", OLIVE),
}
"""Segmentation methods. No figure shows them together with odometries."""
KINDS = {
    "leg": BLACK, "ring": BLUE, "bracing": SKY, "arm": VERMILION, "secondary": GREEN, "zigzag": WINE, "loops": ORANGE,
}  # fmt: skip
"""Members of the tower, and the flights around it."""
PLANNED = {"planned": BLUE, "up a face": GREEN, "wide loops": OLIVE}
"""Flights steered by a planner and those compared with them. No figure shows them together with odometries."""
COLOURS = {
    **VERDICTS, **{name: colour for name, (_, colour) in (METHOD_LOOKS | DETECTORS).items()}, **KINDS, **PLANNED,
    "vertical": WINE, "orbit": ORANGE, "orbit-3.3": ORANGE,  # the report's own, as `zigzag` and `loops`
    "draws": BLUE, "draw": ORANGE, "truth": BLACK, "report": GREY, "report-drift": GREY, "member": LIGHT_GREY,
    "points": "#c8c8c8", "surface": "#E8D5B5", "bars found": "#44AA99", "final": INDIGO, "incremental": SKY,
    "refused": "#dddddd",
}  # fmt: skip
"""One colour for each name in every figure; a figure takes its colours from here alone."""
LABELS = {name: label for name, (label, _) in (METHOD_LOOKS | DETECTORS).items()} | {
    "draws": "draws of the sensor's noise: median, 10 to 90 %", "draw": "one of them",
    "final": "all scans at once", "incremental": "scan by scan",
    "report": "the report's curve", "report-drift": "the report, no correction", "truth": "truth",
}  # fmt: skip
DASHES: Any = {name: (3, 1.5) if name == "none" else (1, 1) if name == "report-drift" else "" for name in COLOURS}
"""Dash patterns for seaborn: errors without correction are dashed."""
CURVES: dict[str, Any] = {
    "x": "time_s", "y": "error_m", "errorbar": None,
    "hue": "curve", "style": "curve", "palette": COLOURS, "dashes": DASHES,
}  # fmt: skip
"""How seaborn draws a table of `notebook.report.curves`."""
BANDS: dict[str, Any] = {
    "x": "sample", "y": "error_m", "estimator": "median", "errorbar": ("pi", 80),
    "hue": "curve", "palette": COLOURS,
    "size": "curve", "sizes": {"draws": 1.8, "draw": 1.0, "report": 2.0},
}  # fmt: skip
"""How seaborn draws a table of `notebook.report.draw_programs`."""
LOOK: Any = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.min_exponent": 5,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
}
"""Settings of matplotlib for all figures."""
DRIFT: Any = {"fc": COLOURS["none"], "ec": COLOURS["none"], "alpha": 0.25, "height": 0.84, "lw": 1}
"""Look of the range of errors without correction, behind the errors with it."""


class Figure(matplotlib.figure.Figure):
    """A figure that notebooks display without pyplot and its global state."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=90)
        return file.getvalue()


def use() -> None:
    """Set the style of all later figures, regardless of the user's matplotlibrc, and the seed of their jitter."""
    warnings.filterwarnings("ignore", "The figure layout has changed to tight")  # seaborn's grids do so
    np.random.seed(0)  # noqa: NPY002 (of seaborn's dots)
    matplotlib.style.use(["default", LOOK])
    if "inline" in (backend := matplotlib.get_backend()):
        from matplotlib import pyplot

        pyplot.switch_backend(backend)
        pyplot.uninstall_repl_displayhook()  # it draws each figure of a cell, before the cell shows and draws it


style = partial(matplotlib.style.context, ["default", LOOK])
"""``@style()`` decorates a function that draws one figure in this style."""


def drawable(text: str) -> str:
    """A text from outside, such as the name of a file, with � for each sign that the font lacks. Draw it with
    ``parse_math=False``."""
    font = get_font(findfont(FontProperties()))
    return "".join(sign if font.get_char_index(ord(sign)) else "\N{REPLACEMENT CHARACTER}" for sign in text)


def gather_legend(figure: matplotlib.figure.Figure, loc: str = "outside lower center", **more: Any) -> None:
    """Replace seaborn's legends by one legend of the figure, with the labels of all its panels, each once. Methods are
    named as in `LABELS`."""
    found = [zip(*panel.get_legend_handles_labels(), strict=True) for panel in figure.axes]
    handles: dict[Any, Any] = {LABELS.get(label, label): handle for pairs in found for handle, label in pairs}
    for legend in [*figure.legends, *filter(None, (panel.get_legend() for panel in figure.axes))]:
        legend.remove()
    if not isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):  # seaborn's grids have set another one
        figure.set_layout_engine("constrained")
    options: dict[str, Any] = {"loc": loc, **more}
    figure.legend(list(handles.values()), list(handles), **options)


def log_axis(panel: Axes, axis: str, low: float, with_0: bool) -> None:
    """Make an ``axis``, x or y, logarithmic. For values that are 0, ``with_0``, it is linear below about ``low``."""
    linear = {"linthresh": 10.0 ** np.round(np.log10(low)), "linscale": 0.5}  # ends at a tick
    scale: dict[str, Any] = {"value": "symlog", **linear} if with_0 else {"value": "log"}
    getattr(panel, f"set_{axis}scale")(**scale)


def gather_bar(figure: matplotlib.figure.Figure, label: str, highest: float) -> None:
    """Replace seaborn's legends by one bar of the colours ``viridis`` from 0 to ``highest``. Its arrow says that all
    larger values have the last colour."""
    for legend in figure.legends[:]:
        legend.remove()
    figure.set_layout_engine("compressed")
    figure.colorbar(ScalarMappable(Normalize(0, highest), "viridis"), ax=figure.axes, extend="max", label=label)
