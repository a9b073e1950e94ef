"""`Structure` → GLB (glTF 2.0) and PLY: bars as prisms of their width, joints as cubes.

Both are written here rather than by a library: the meshes are boxes, and the libraries' writers leave no place for the
unit, the frame and the scale of the colours.
"""

import itertools
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import steelnb
from steelnb.datatypes import Array
from steelnb.exports.members import FRAME, JOINT, UNIT, Extras, drawn_width, joint_size, origin_of, rotations
from steelnb.fusion.structure import Structure

CORNER = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
# Corners of each face, counter-clockwise from outside; corner 4x + 2y + z.
FACE = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
NORMAL = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])
Y_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
"""Quaternion (x, y, z, w) from z up to y up, which glTF has."""
FLOAT, SHORT, VERTICES, INDICES = 5126, 5123, 34962, 34963
"""Numbers that glTF has for types and for targets of buffers."""


def write_ply(structure: Structure, path: Path, extras: Extras) -> None:
    """Write one mesh: 8 vertices and 12 triangles a bar, then the same for each joint.

    Besides the colour, a vertex has the number of its ``bar`` (−1: of a joint) and the ``value_m`` that the colour
    shows. Comments state unit, frame, the shift and the scale of the colours.
    """
    origin, bars, joints = origin_of(structure), len(structure), len(structure.joint)
    s, width = structure.segments, drawn_width(structure)
    size = np.stack([s.length, width, width], axis=1)
    prism = np.einsum("bij,bkj->bki", rotations(s), CORNER * size[:, None]) + (s.middle - origin)[:, None]
    cube = (structure.joint - origin)[:, None] + CORNER * joint_size(structure)
    corners = np.concatenate([prism, cube]).reshape(-1, 3)
    vertex = np.zeros(len(corners), [*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue")),
                                     ("value_m", "<f4"), ("bar", "<i4")])  # fmt: skip
    colour = np.concatenate([extras.colours.rgb, np.tile(JOINT, (joints, 1))])
    for k, (axis, channel) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertex[axis] = corners[:, k]
        vertex[channel] = np.repeat(np.round(255 * colour[:, k]), 8)
    vertex["value_m"] = np.repeat(np.concatenate([extras.colours.value_m, np.full(joints, np.nan)]), 8)
    vertex["bar"] = np.repeat(np.concatenate([np.arange(bars), np.full(joints, -1)]), 8)
    triangle = FACE[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    face = np.zeros(12 * (bars + joints), [("corners", "u1"), ("vertex", "<i4", 3)])
    face["corners"] = 3
    face["vertex"] = (8 * np.arange(bars + joints)[:, None, None] + triangle).reshape(-1, 3)
    kinds = {"<f8": "double", "|u1": "uchar", "<f4": "float", "<i4": "int"}
    header = [
        "ply", "format binary_little_endian 1.0",
        *(f"comment {key}: {text}" for key, text in _about(structure, extras, origin).items()),
        f"element vertex {len(vertex)}",
        *(f"property {kinds[vertex.dtype[name].str]} {name}" for name in vertex.dtype.names or ()),
        f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode("ascii", "replace") + vertex.tobytes() + face.tobytes())


def write_glb(structure: Structure, path: Path, extras: Extras) -> None:
    """Write a scene: a node for each bar, named "bar 0" and so on with what is known of it, and one for each joint.

    All show the same box, stretched and turned, in a material for each colour, so that a file stays small. The root
    node turns z up to y up. The extras of the asset and of the scene state unit, frame, shift and scale of the colours.
    """
    s, width, about = structure.segments, drawn_width(structure), _about(structure, extras, origin_of(structure))
    quaternion = Rotation.from_matrix(rotations(s)).as_quat().tolist()
    middle = (s.middle - origin_of(structure)).tolist()
    material: dict[tuple[float, ...], int] = {}
    nodes: list[dict[str, Any]] = []
    for bar, colour in enumerate(extras.colours.rgb.tolist()):
        known = {
            "width_m": structure.width_m[bar], "sigma_m": structure.sigma_m[bar],
            extras.colours.name: extras.colours.value_m[bar],
        }  # fmt: skip
        nodes.append({
            "name": f"bar {bar}", "mesh": material.setdefault(tuple(colour), len(material)),
            "translation": middle[bar], "rotation": quaternion[bar], "scale": [s.length[bar], width[bar], width[bar]],
            "extras": {name: float(value) for name, value in known.items() if np.isfinite(value)}
            | {"length_m": float(s.length[bar]), "sightings": int(structure.sightings[bar])},
        })  # fmt: skip
    edge = [joint_size(structure)] * 3
    for joint, position in enumerate((structure.joint - origin_of(structure)).tolist()):
        mesh = material.setdefault(JOINT, len(material))
        tied = np.sort(structure.tie[structure.tie[:, 0] == joint, 1]).tolist()
        nodes.append({"name": f"joint {joint}", "mesh": mesh, "translation": position, "scale": edge,
                      "extras": {"bars": tied}})  # fmt: skip
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2}
    data, views, accessors = _box()
    scene = {
        "asset": {"version": "2.0", "generator": f"steelnb {steelnb.__version__}", "extras": about},
        "scene": 0,
        "scenes": [{"nodes": [len(nodes)], "extras": about}],
        "nodes": [*nodes, {"name": "structure", "rotation": Y_UP, "children": list(range(len(nodes)))}],
        "meshes": [{"primitives": [primitive | {"material": k}]} for k in material.values()],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": [*_linear(colour), 1.0], "metallicFactor": 0.0,
                                      "roughnessFactor": 0.8}} for colour in material
        ],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    text = json.dumps(scene, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _box() -> tuple[bytes, list[dict[str, Any]], list[dict[str, Any]]]:
    """A box of edge 1 around the origin as a buffer, its views and its accessors: 24 corners, since a corner has
    another normal on each of its three faces."""
    position = CORNER[FACE].reshape(-1, 3).astype("<f4")
    normal = np.repeat(NORMAL, 4, axis=0).astype("<f4")
    index = (4 * np.arange(6)[:, None] + [0, 1, 2, 0, 2, 3]).ravel().astype("<u2")
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    data = b""
    for array, target, kind in ((position, VERTICES, "VEC3"), (normal, VERTICES, "VEC3"), (index, INDICES, "SCALAR")):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target})
        number = SHORT if kind == "SCALAR" else FLOAT
        accessors.append({"bufferView": len(accessors), "componentType": number, "count": len(array), "type": kind})
        data += array.tobytes()
    accessors[0] |= {"min": [-0.5] * 3, "max": [0.5] * 3}
    return data, views, accessors


def _linear(colour: tuple[float, ...]) -> list[float]:
    """sRGB → the linear light that glTF's factors are in (IEC 61966-2-1)."""
    return [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]


def _about(structure: Structure, extras: Extras, origin: Array) -> dict[str, str]:
    shift = " ".join(f"{v:.1f}" for v in origin)
    bars, joints = len(structure), len(structure.joint)
    return {
        "unit": UNIT, "frame": FRAME, "origin": f"add {shift} to every coordinate", "colour": extras.colours.legend,
        "holds": f"{bars} bars as prisms and {joints} joints as cubes; how a section is turned is not estimated",
    }  # fmt: skip
