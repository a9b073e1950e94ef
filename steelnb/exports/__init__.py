"""`Structure` ↔ files: JSON both ways; CSV, DXF, GLB, PLY, GraphML and IFC for other programs. All in metres, z up."""

from steelnb.exports.document import read_structure
from steelnb.exports.files import FORMATS, export_structure
from steelnb.exports.members import GROUPS, orientation

__all__ = ["FORMATS", "GROUPS", "export_structure", "orientation", "read_structure"]
