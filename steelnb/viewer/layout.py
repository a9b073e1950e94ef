"""What rerun's viewers show of a flight: where each view is, and its colours, which are those of the figures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from steelnb.figures.scene import CLOUD, TRACKS
from steelnb.figures.style import COLOURS

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

__all__ = ["BARS", "CLOUD", "SCAN", "TIMELINE", "TRACKS", "WIDTHS", "layout", "rgb"]

TIMELINE = "stamp"
BARS = COLOURS["least_squares"]
SCAN = COLOURS["icp-4dof"]
WIDTHS = {"true": 2.0, "drifting": 3.0, "corrected": 5.0}
"""Of the trajectories in pixels: the corrected one lies on the true one where all is well, and both are seen."""
WHITE = (255, 255, 255)
PAPER_GRID = (228, 228, 228)
NAMES = {
    "error": "distance to the truth (m)",
    "matches": "pairs that corrected the pose",
    "camera": "camera",
    "range": "scan, near is bright",
}


def layout(views: Sequence[str]) -> "Blueprint":
    """The flight in space at the left; at its right, one above the other, those of `NAMES` that there are.

    The trajectories are shown up to the time chosen, everything else as it last was.
    """
    import rerun.blueprint as rrb

    so_far = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    space = rrb.Spatial3DView(
        origin="world",
        name="flight",
        background=WHITE,
        line_grid=rrb.LineGrid3D(visible=True, color=PAPER_GRID),
        overrides={f"world/{name}": so_far for name in TRACKS},  # type: ignore[dict-item]
    )
    kinds = {"camera": rrb.Spatial2DView, "range": rrb.Spatial2DView}
    sides = [kinds.get(name, rrb.TimeSeriesView)(origin=name, name=NAMES[name]) for name in NAMES if name in views]
    whole = rrb.Horizontal(space, rrb.Vertical(*sides), column_shares=[2, 1]) if sides else space
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three bytes."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
