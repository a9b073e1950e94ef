"""One call for every format: the ending of the file decides, and nothing half-written stays."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steelnb.datatypes import Array
from steelnb.errors import EmptyStructureError, OutputError, SettingsError, UnsupportedFormatError
from steelnb.exports.document import write_json
from steelnb.exports.drawing import write_dxf
from steelnb.exports.ifc import write_ifc
from steelnb.exports.members import Colours, Extras, checked
from steelnb.exports.meshes import write_glb, write_ply
from steelnb.exports.network import write_graphml
from steelnb.exports.tables import write_csv
from steelnb.fusion.structure import Structure
from steelnb.recordings import new_folder


class Format(NamedTuple):
    """How a file is written; ``coloured``: shows a value by colour; ``drawn``: of no use without a bar."""

    write: Callable[[Structure, Path, Extras], None]
    holds: str
    coloured: bool = False
    drawn: bool = True


FORMATS = {
    ".json": Format(write_json, "everything; can be read back", drawn=False),
    ".csv": Format(write_csv, "two tables, <name>_bars.csv and <name>_joints.csv", drawn=False),
    ".dxf": Format(write_dxf, "lines on a layer for each class of member, and points for joints"),
    ".glb": Format(write_glb, "bars as prisms, coloured, each a node of its own", coloured=True),
    ".ply": Format(write_ply, "bars as prisms in one coloured mesh", coloured=True),
    ".graphml": Format(write_graphml, "joints, and the pieces of bars between them", drawn=False),
    ".ifc": Format(write_ifc, "IFC4 members with axis and body; needs steelnb[ifc]"),
}


def export_structure(
    structure: Structure,
    path: Path | str,
    *,
    overwrite: bool = False,
    about: Mapping[str, Any] | None = None,
    colour_m: Array | None = None,
    colour_name: str = "sigma_m",
    colour_max_m: float | None = None,
) -> tuple[Path, ...]:
    """Write a structure in the format that the ending of ``path`` names (see `FORMATS`), and give the files written.

    Every format is in metres and in the world frame with z up, and says so; glTF has y up, so there the root node
    turns it. ``about`` goes into JSON. GLB and PLY colour the bars by ``colour_m (B,)``, metres, NaN for not known
    (default: the structure's ``sigma_m``), called ``colour_name``, from 0 to ``colour_max_m`` (default: the 95th
    percentile); they name the scale, and are shifted where coordinates are too large for a viewer's single precision.

    The same structure gives the same bytes.

    Raises `UnsupportedFormatError`, `OutputError` (a file exists and ``overwrite`` is not set, or cannot be written),
    `NonFiniteError`, `StructureError`, `EmptyStructureError` (a drawing of no bars), `SettingsError` (colours that do
    not fit) and `MissingExtraError` (IFC without ifcopenshell). Nothing is written then.
    """
    path = Path(path)
    form = FORMATS.get(path.suffix.lower())
    if form is None:
        raise UnsupportedFormatError(f"{path}: ending {path.suffix!r}; expected one of {', '.join(FORMATS)}")
    checked(structure, path.name)
    if form.drawn and not len(structure):
        raise EmptyStructureError(f"{path}: the structure has no bars; expected at least one to draw")
    if colour_m is not None and not form.coloured:
        raise SettingsError(f"{path}: colours asked for; only {', '.join(_coloured())} files show them")
    value = structure.sigma_m if colour_m is None else np.asarray(colour_m, dtype=float)
    if value.shape != (len(structure),):
        raise SettingsError(f"colour_m has shape {value.shape}; expected one value for each of {len(structure)} bars")
    extras = Extras(Colours.of(value, colour_name, colour_max_m), about or {})
    with new_folder(path.parent) as folder:
        form.write(structure, folder / path.name, extras)
        written = tuple(path.parent / file.name for file in sorted(folder.iterdir()))
        for file in written:
            if file.is_dir() or (file.exists() and not overwrite):
                raise OutputError(f"{file}: exists already; expected a new file, or overwrite=True (--force)")
    return written


def _coloured() -> list[str]:
    return [suffix for suffix, form in FORMATS.items() if form.coloured]
