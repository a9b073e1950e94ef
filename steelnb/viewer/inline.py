"""A flight in a cell of a notebook: rerun's viewer while the notebook is open, Plotly's for good."""

from pathlib import Path
from typing import TYPE_CHECKING

from steelnb.figures import plotly_bundle
from steelnb.viewer.web import WebViewer, serve_behind

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

_servers: dict[Path, WebViewer] = {}
"""Of this kernel, for as long as it lives."""


def inline(rrd: Path | str, figure: "PlotlyFigure | None" = None, height_px: int = 620) -> None:
    """Display an .rrd file below the current cell, and under it a figure that stays when the notebook is closed.

    The viewer is a page of its own within the cell, from a server on 127.0.0.1 that ends with the kernel. Rerun's own
    widget would ask addresses of the internet for itself, and for its newest version. Raises `FileMissingError`.
    """
    import ipywidgets as widgets
    from IPython.display import display

    rrd = Path(rrd).absolute()
    if rrd not in _servers:
        _servers[rrd] = serve_behind(rrd)
    page = f'<iframe src="{_servers[rrd].address}" title="flight" width="100%" height="{height_px}" frameborder="0">'
    display(widgets.HTML(f"{page}</iframe>", layout=widgets.Layout(width="100%", height=f"{height_px + 8}px")))
    if figure is not None:
        display(plotly_bundle(figure, "the flight in space"), raw=True)
