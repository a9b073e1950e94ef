"""`Structure` → IFC4, for building information models. Needs ifcopenshell, which is the extra ``steelnb[ifc]``."""

import uuid
from pathlib import Path
from typing import Any

import numpy as np

import steelnb
from steelnb.errors import MissingExtraError
from steelnb.exports.members import FRAME, UNIT, Extras, drawn_width, orientation, origin_of, rotations
from steelnb.fusion.structure import Structure


def write_ifc(structure: Structure, path: Path, extras: Extras) -> None:
    """Write an IfcMember for each bar, with an axis (two points) and a body (a square section of its width, extruded).

    The unit is the metre; the site is placed at the origin of the shift where coordinates are large, and members are
    relative to it. The object type of a member is its class; its property set ``steelnb_estimate`` says how well it
    is known, and its joints by their numbers. Identifiers follow from the bars, so a file written again updates a
    model. A square section is what is known, not what is there: profiles are not estimated.
    """
    try:
        import ifcopenshell
        import ifcopenshell.guid
    except ImportError:
        raise MissingExtraError(f"{path.name}: IFC needs ifcopenshell: pip install 'steelnb[ifc]'") from None
    model = ifcopenshell.file(schema="IFC4")
    header = model.header
    header.file_name.name, header.file_name.time_stamp = path.name, "1970-01-01T00:00:00"  # the same bytes each time
    header.file_name.originating_system = f"steelnb {steelnb.__version__}"
    make = model.create_entity

    def identifier(*about: object) -> str:
        return str(ifcopenshell.guid.compress(uuid.uuid5(uuid.NAMESPACE_OID, repr(about)).hex))

    def point(at: Any) -> Any:
        return make("IfcCartesianPoint", [float(v) for v in at])

    def direction(along: Any) -> Any:
        return make("IfcDirection", [float(v) for v in along])

    def placed(at: Any, within: Any = None) -> Any:
        return make("IfcLocalPlacement", within, make("IfcAxis2Placement3D", point(at)))

    segments, width, origin = structure.segments, drawn_width(structure), origin_of(structure)
    whole = (segments.start.tolist(), segments.end.tolist())  # models of two towers may be put together
    context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5,
                   make("IfcAxis2Placement3D", point((0, 0, 0))))  # fmt: skip
    shown = {
        name: make("IfcGeometricRepresentationSubContext", name, "Model", ParentContext=context,
                   TargetView=view)
        for name, view in (("Axis", "GRAPH_VIEW"), ("Body", "MODEL_VIEW"))
    }  # fmt: skip
    units = make("IfcUnitAssignment", [make("IfcSIUnit", None, "LENGTHUNIT", None, "METRE")])
    project = make("IfcProject", identifier("project", whole), None, "Structure", f"Unit: {UNIT}. Frame: {FRAME}.",
                   RepresentationContexts=[context], UnitsInContext=units)  # fmt: skip
    site = make(
        "IfcSite", identifier("site", whole), None, "Site", ObjectPlacement=placed(origin), CompositionType="ELEMENT"
    )
    make("IfcRelAggregates", identifier("project holds site", whole), RelatingObject=project, RelatedObjects=[site])

    start, turn = segments.start - origin, rotations(segments)
    members = []
    for bar, group in enumerate(orientation(segments)):
        end = segments.end[bar] - origin
        axis = make("IfcPolyline", [point(start[bar]), point(end)])
        section = make("IfcRectangleProfileDef", "AREA", None, None, float(width[bar]), float(width[bar]))
        # Extruded along the z axis of its place: the bar's x; the section's x is the bar's y.
        place = make("IfcAxis2Placement3D", point(start[bar]), direction(turn[bar][:, 0]), direction(turn[bar][:, 1]))
        solid = make("IfcExtrudedAreaSolid", section, place, direction((0, 0, 1)), float(segments.length[bar]))
        shapes = [make("IfcShapeRepresentation", shown[name], name, kind, [item])
                  for name, kind, item in (("Axis", "Curve3D", axis), ("Body", "SweptSolid", solid))]  # fmt: skip
        key = (bar, *segments.start[bar].tolist(), *segments.end[bar].tolist())
        member = make(
            "IfcMember", identifier("member", *key), None, f"bar {bar}", None, group,
            placed((0, 0, 0), site.ObjectPlacement), make("IfcProductDefinitionShape", None, None, shapes), str(bar),
            "USERDEFINED",
        )  # fmt: skip
        joints = np.sort(structure.tie[structure.tie[:, 1] == bar, 0]).tolist()
        known = {
            "Width": ("IfcLengthMeasure", structure.width_m[bar]),
            "Sigma": ("IfcLengthMeasure", structure.sigma_m[bar]),
            "Sightings": ("IfcCountMeasure", structure.sightings[bar]),
            "Points": ("IfcCountMeasure", segments.count[bar]),
            "Joints": ("IfcText", " ".join(map(str, joints))),
        }  # fmt: skip
        values = [make("IfcPropertySingleValue", name, None, make(kind, value if kind == "IfcText" else value.item()))
                  for name, (kind, value) in known.items() if value == value]  # fmt: skip
        about = make("IfcPropertySet", identifier("estimate", *key), None, "steelnb_estimate", None, values)
        make("IfcRelDefinesByProperties", identifier("has estimate", *key), RelatedObjects=[member],
             RelatingPropertyDefinition=about)  # fmt: skip
        members.append(member)
    make("IfcRelContainedInSpatialStructure", identifier("site holds members", whole), RelatedElements=members,
         RelatingStructure=site)  # fmt: skip
    model.write(str(path))
