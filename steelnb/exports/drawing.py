"""`Structure` → DXF (R2010), for CAD."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from steelnb.exports.members import FRAME, GROUPS, UNIT, Extras, orientation
from steelnb.fusion.structure import Structure

if TYPE_CHECKING:
    from ezdxf.document import Drawing

APP = "STEELNB"
LAYERS = dict(zip(GROUPS, (5, 30, 3), strict=True)) | {"joints": 1}
"""Layer → colour number of AutoCAD: blue, orange, green; red."""
CIRCLE = 33
"""Point style of AutoCAD: a dot would not be seen."""


def write_dxf(structure: Structure, path: Path, extras: Extras) -> None:
    """Write a LINE for each bar, on the layer of its class, and a POINT for each joint.

    The header has metres as its unit; the drawing's properties state unit and frame. Extended data of application
    STEELNB hold the bar's number, sightings, width and sigma, metres, −1 where not known.
    """
    with _without_times():
        _drawn(structure).saveas(path)


def _drawn(structure: Structure) -> "Drawing":
    import ezdxf

    document = ezdxf.new("R2010", units=ezdxf.units.M)
    document.header["$PDMODE"], document.header["$PDSIZE"] = CIRCLE, 0.1
    for name, text in (("unit", UNIT), ("frame", FRAME)):
        document.header.custom_vars.append(name, text)
    document.appids.add(APP)
    for layer, colour in LAYERS.items():
        document.layers.add(layer, color=colour)
    space = document.modelspace()
    segments = structure.segments
    ends = zip(segments.start.tolist(), segments.end.tolist(), orientation(segments), strict=True)
    for bar, (start, end, group) in enumerate(ends):
        line = space.add_line(start, end, dxfattribs={"layer": group})
        sizes = [value if value == value else -1.0 for value in (structure.width_m[bar], structure.sigma_m[bar])]
        line.set_xdata(APP, [(1071, bar), (1071, int(structure.sightings[bar])), *((1040, v) for v in sizes)])
    for position in structure.joint.tolist():
        space.add_point(position, dxfattribs={"layer": "joints"})
    return document


@contextlib.contextmanager
def _without_times() -> Iterator[None]:
    """No times and no random identifiers in what ezdxf writes: the same structure gives the same bytes."""
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
