"""Flights in rerun's viewers: written as .rrd files, shown in a window, in a browser, in a notebook."""

from steelnb.viewer.inline import inline
from steelnb.viewer.log import Log

__all__ = ["Log", "inline"]
