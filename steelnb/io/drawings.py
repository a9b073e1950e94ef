"""`Structure` → files of other programs: CSV, DXF, GLB and IFC. All in metres, z up."""

import importlib
import uuid
from pathlib import Path
from typing import Any

import numpy as np

import steelnb
from steelnb.errors import needs
from steelnb.files import plain_name
from steelnb.fusion.structure import Structure
from steelnb.io.clouds import shift_of
from steelnb.io.segments import GROUPS, orientation
from steelnb.types import Array, Segments

UNIT = "metre"
FRAME = "world: right-handed, z up"
THINNEST_M = 0.01
UNKNOWN, JOINT = (0.6, 0.6, 0.6), (0.15, 0.15, 0.15)
"""Colours of bars whose sigma is not known, and of joints."""
LAYERS = dict(zip(GROUPS, (5, 30, 3), strict=True)) | {"joints": 1}
"""Layer → colour number of AutoCAD: blue, orange, green; red."""
CIRCLE = 33
"""Point style of AutoCAD: a dot would not be seen."""
T_YUP_ZUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""glTF has y up."""


def write_csv(structure: Structure, path: Path) -> None:
    """Write two tables beside ``path``, to a micrometre: ``<name>_bars.csv`` and ``<name>_joints.csv``.

    The numbers of the bars that a joint ties are one cell, apart by spaces.
    """
    import pandas as pd

    s = structure.segments
    ends = {f"{end}_{axis}_m": getattr(s, end)[:, k] for end in ("start", "end") for k, axis in enumerate("xyz")}
    bars = pd.DataFrame({
        "bar": np.arange(len(structure)), **ends, "length_m": s.length, "width_m": structure.width_m,
        "sigma_m": structure.sigma_m, "sightings": structure.sightings, "points": s.count, "radius_m": s.radius,
        "group": orientation(s), "frame": FRAME,
    })  # fmt: skip
    joints = pd.DataFrame({
        "joint": np.arange(len(structure.joint)),
        **{f"{axis}_m": structure.joint[:, k] for k, axis in enumerate("xyz")},
        "bars": [" ".join(map(str, tied)) for tied in _bars_of_joints(structure)], "frame": FRAME,
    })  # fmt: skip
    for name, table in (("bars", bars), ("joints", joints)):
        table.to_csv(path.with_name(f"{path.stem}_{name}.csv"), index=False, float_format="%.6f", lineterminator="\n")


def write_dxf(structure: Structure, path: Path) -> None:
    """Write a LINE for each bar, on the layer of its class, and a POINT for each joint, as DXF R2010.

    The header has metres as its unit; the drawing's properties state unit and frame. Extended data of application
    STEELNB hold the bar's number, sightings, width and sigma, metres, −1 where not known.
    """
    ezdxf = library("ezdxf")
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # no times: the same structure gives the same bytes
    try:
        drawing = ezdxf.new("R2010", units=ezdxf.units.M)
        _draw(structure, drawing)
        drawing.saveas(path)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _draw(structure: Structure, drawing: Any) -> None:
    drawing.header["$PDMODE"], drawing.header["$PDSIZE"] = CIRCLE, 0.1
    for name, text in (("unit", UNIT), ("frame", FRAME)):
        drawing.header.custom_vars.append(name, text)
    drawing.appids.add("STEELNB")
    for layer, colour in LAYERS.items():
        drawing.layers.add(layer, color=colour)
    space, s = drawing.modelspace(), structure.segments
    sizes = np.nan_to_num(np.stack([structure.width_m, structure.sigma_m], axis=1), nan=-1.0).tolist()
    for bar, (start, end, group) in enumerate(zip(s.start.tolist(), s.end.tolist(), orientation(s), strict=True)):
        line = space.add_line(start, end, dxfattribs={"layer": group})
        numbers = [(1071, bar), (1071, int(structure.sightings[bar])), *((1040, size) for size in sizes[bar])]
        line.set_xdata("STEELNB", numbers)
    for position in structure.joint.tolist():
        space.add_point(position, dxfattribs={"layer": "joints"})


def write_glb(structure: Structure, path: Path) -> None:
    """Write a scene: a node for each bar, named "bar 0" and so on with what is known of it, and one for each joint.

    All show the same box, stretched and turned, in a material for each colour, so that a file stays small. The root
    node turns z up to y up. The extras of the scene state unit, frame, shift and scale of the colours.
    """
    trimesh = library("trimesh")
    scene = trimesh.Scene(metadata=_about(structure))
    scene.graph.update(frame_to="structure", matrix=T_YUP_ZUP)
    T, colours = _boxes(structure)
    lengths, tied = structure.segments.length, _bars_of_joints(structure)
    for k, colour in enumerate(colours):
        name, bar = "#" + "".join(f"{round(255 * c):02x}" for c in colour), k < len(structure)
        if name not in scene.geometry:
            box = trimesh.creation.box()
            box.unmerge_vertices()  # a corner has another normal on each of its three faces
            box.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*_linear(colour), 1.0], metallicFactor=0.0, roughnessFactor=0.8))  # fmt: skip
            scene.geometry[name] = box
        joint = k - len(structure)
        extras = {"length_m": float(lengths[k])} | known_of_bar(structure, k) if bar else {"bars": tied[joint]}
        scene.graph.update(
            frame_to=f"bar {k}" if bar else f"joint {joint}", frame_from="structure", matrix=T[k], geometry=name,
            metadata=extras,
        )  # fmt: skip
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def write_ifc(structure: Structure, path: Path) -> None:
    """Write IFC4 with an IfcMember for each bar: its axis and a square section of its width, extruded along it, or a
    circle for a round tube.

    The unit is the metre; the site is placed at the origin of the shift where coordinates are large, and members are
    relative to it. The object type of a member is its class; its property set ``steelnb_estimate`` says how well it
    is known, and its joints by their numbers. Identifiers follow from the bars, so a file written again updates a
    model. A square section is what is known, not what is there: profiles are not estimated.
    """
    ifcopenshell, guid = library("ifcopenshell"), library("ifcopenshell.guid")
    model = ifcopenshell.file(schema="IFC4")
    header = model.header
    header.file_name.name, header.file_name.time_stamp = (
        plain_name(path),
        "1970-01-01T00:00:00",
    )  # the same bytes each time
    header.file_name.originating_system = f"steelnb {steelnb.__version__}"
    make = model.create_entity

    def identifier(*about: object) -> str:
        return str(guid.compress(uuid.uuid5(uuid.NAMESPACE_OID, repr(about)).hex))

    def point(at: Any) -> Any:
        return make("IfcCartesianPoint", np.asarray(at, dtype=float).tolist())

    def place(at: Any, *axes: Array) -> Any:
        return make("IfcAxis2Placement3D", point(at), *(make("IfcDirection", axis.tolist()) for axis in axes))

    segments, width, origin = structure.segments, drawn_width(structure), origin_of(structure)
    whole = (segments.start.tolist(), segments.end.tolist())  # models of two towers may be put together
    context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, place(np.zeros(3)))
    views = {
        name: make("IfcGeometricRepresentationSubContext", name, "Model", ParentContext=context, TargetView=view)
        for name, view in (("Axis", "GRAPH_VIEW"), ("Body", "MODEL_VIEW"))
    }
    units = make("IfcUnitAssignment", [make("IfcSIUnit", None, "LENGTHUNIT", None, "METRE")])
    project = make("IfcProject", identifier("project", whole), None, "Structure", f"Unit: {UNIT}. Frame: {FRAME}.",
                   RepresentationContexts=[context], UnitsInContext=units)  # fmt: skip
    site = make("IfcSite", identifier("site", whole), None, "Site", CompositionType="ELEMENT",
                ObjectPlacement=make("IfcLocalPlacement", None, place(origin)))  # fmt: skip
    make("IfcRelAggregates", identifier("project holds site", whole), RelatingObject=project, RelatedObjects=[site])

    start, end, turn = segments.start - origin, segments.end - origin, rotations(segments)
    members = []
    for bar, group in enumerate(orientation(segments)):
        key = (bar, *segments.start[bar].tolist(), *segments.end[bar].tolist())
        axis = make("IfcPolyline", [point(start[bar]), point(end[bar])])
        size = float(width[bar])
        section = make("IfcRectangleProfileDef", "AREA", None, None, size, size)
        if structure.tube is not None and structure.tube[bar]:
            section = make("IfcCircleProfileDef", "AREA", None, None, 0.5 * size)
        # Extruded along the z axis of its place, which is the bar's x; the section's x is the bar's y.
        solid = make("IfcExtrudedAreaSolid", section, place(start[bar], turn[bar][:, 0], turn[bar][:, 1]),
                     make("IfcDirection", [0.0, 0.0, 1.0]), float(segments.length[bar]))  # fmt: skip
        shapes = [make("IfcShapeRepresentation", views[name], name, kind, [item])
                  for name, kind, item in (("Axis", "Curve3D", axis), ("Body", "SweptSolid", solid))]  # fmt: skip
        member = make(
            "IfcMember", identifier("member", *key), None, f"bar {bar}", None, group,
            make("IfcLocalPlacement", site.ObjectPlacement, place(np.zeros(3))),
            make("IfcProductDefinitionShape", None, None, shapes), str(bar), "USERDEFINED",
        )  # fmt: skip
        joints = np.sort(structure.tie[structure.tie[:, 1] == bar, 0]).tolist()
        known = known_of_bar(structure, bar)
        lengths = {"Width": known.get("width_m"), "Sigma": known.get("sigma_m")}
        counts = {"Sightings": known["sightings"], "Points": int(segments.count[bar])}
        values = [
            *(("IfcLengthMeasure", name, value) for name, value in lengths.items() if value is not None),
            *(("IfcCountMeasure", name, value) for name, value in counts.items()),
            ("IfcText", "Joints", " ".join(map(str, joints))),
        ]
        single = [make("IfcPropertySingleValue", name, None, make(kind, value)) for kind, name, value in values]
        properties = make("IfcPropertySet", identifier("estimate", *key), None, "steelnb_estimate", None, single)
        make("IfcRelDefinesByProperties", identifier("has estimate", *key), RelatedObjects=[member],
             RelatingPropertyDefinition=properties)  # fmt: skip
        members.append(member)
    make("IfcRelContainedInSpatialStructure", identifier("site holds members", whole), RelatedElements=members,
         RelatingStructure=site)  # fmt: skip
    path.write_text(model.to_string(), encoding="utf-8")  # any name of a file will do


def drawn_width(structure: Structure) -> Array:
    """Width that each bar is drawn with ``(B,)``, metres: its own, or twice its radius where that is not known."""
    width = np.where(np.isfinite(structure.width_m), structure.width_m, 2 * structure.segments.radius)
    return np.maximum(width, THINNEST_M)


def rotations(segments: Segments) -> Array:
    """Rotations ``R_world_bar (B, 3, 3)``: x along the bar, y horizontal, z up as far as it can.

    How a section is turned about its axis is not estimated; for a vertical bar y is the world's y.
    """
    along = segments.direction
    side = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=1)
    size = np.linalg.norm(side, axis=1)
    side = np.where(size[:, None] > 1e-9, side / np.maximum(size, 1e-12)[:, None], [0.0, 1.0, 0.0])
    return np.stack([along, side, np.cross(along, side)], axis=2)


def _boxes(structure: Structure) -> tuple[Array, Array]:
    """``T_file_box (B + J, 4, 4)``, scale included, and sRGB ``(B + J, 3)`` of unit cubes: bars, then joints."""
    bars, joints, width = len(structure), len(structure.joint), drawn_width(structure)
    T = np.tile(np.eye(4), (bars + joints, 1, 1))
    T[:bars, :3, :3] = rotations(structure.segments) * np.stack([structure.segments.length, width, width], 1)[:, None]
    T[bars:, :3, :3] *= 1.5 * np.median(width)
    T[:, :3, 3] = np.concatenate([structure.segments.middle, structure.joint]) - origin_of(structure)
    return T, np.concatenate([_colours(structure), np.tile(JOINT, (joints, 1))])


def origin_of(structure: Structure) -> Array:
    """Shift of viewers' files ``(3,)``, metres: their single precision rounds UTM coordinates to 0.25 m."""
    return shift_of(structure.segments.middle.mean(axis=0))


def _sigma_top_m(structure: Structure) -> float:
    """Top of the colour scale: the 95th percentile, since one stray value would leave all others in one colour."""
    finite = structure.sigma_m[np.isfinite(structure.sigma_m)]
    return max(float(np.quantile(finite, 0.95)), 1e-3) if len(finite) else 1.0


def _colours(structure: Structure) -> Array:
    """sRGB ``(B, 3)`` from 0 to 1, by sigma."""
    import matplotlib

    known = ~np.isnan(structure.sigma_m)
    level = np.clip(np.where(known, structure.sigma_m, 0.0) / _sigma_top_m(structure), 0, 1)
    return np.where(known[:, None], np.asarray(matplotlib.colormaps["viridis"](level))[:, :3], UNKNOWN)


def _linear(colour: Array) -> list[float]:
    """sRGB → the linear light of glTF's factors (IEC 61966-2-1)."""
    return [float(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4) for c in colour]


def _about(structure: Structure) -> dict[str, str]:
    shift = " ".join(f"{v:.1f}" for v in origin_of(structure))
    bars, joints, top_m = len(structure), len(structure.joint), _sigma_top_m(structure)
    return {
        "unit": UNIT, "frame": FRAME, "origin": f"add {shift} to every coordinate",
        "colour": f"sigma_m: viridis, dark at 0 to yellow at {top_m:.4g} m and above; grey: not known",
        "holds": f"{bars} bars as prisms and {joints} joints as cubes; how a section is turned is not estimated",
    }  # fmt: skip


def known_of_bar(structure: Structure, bar: int) -> dict[str, Any]:
    """Width, sigma and sightings of a bar, without those that are not known."""
    sizes = {"width_m": float(structure.width_m[bar]), "sigma_m": float(structure.sigma_m[bar])}
    known = {name: value for name, value in sizes.items() if not np.isnan(value)}
    return known | {"sightings": int(structure.sightings[bar])}


def _bars_of_joints(structure: Structure) -> list[list[int]]:
    ties = structure.tie
    return [np.sort(ties[ties[:, 0] == joint, 1]).tolist() for joint in range(len(structure.joint))]


def library(name: str) -> Any:
    """A library of the extra ``io``; raises `MissingExtraError` without it."""
    with needs("io"):
        return importlib.import_module(name)
