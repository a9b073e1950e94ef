"""Every format, opened and counted by a reader that had no part in writing it."""

import json
import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pandas as pd
import pytest
import trimesh

from steelnb.errors import (
    EmptyStructureError,
    MissingExtraError,
    NonFiniteError,
    OutputError,
    SettingsError,
    StructureError,
    UnsupportedFormatError,
)
from steelnb.exports import FORMATS, export_structure, orientation, read_structure
from steelnb.exports.members import Colours, rotations
from steelnb.fusion.structure import Structure
from tests.exports.made import UTM, frame, shifted, tower

os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
DRAWN = [suffix for suffix, form in FORMATS.items() if form.drawn]


@pytest.fixture(scope="module")
def full() -> Structure:
    return tower()


def written(structure: Structure, folder: Path, suffix: str, **options) -> Path:
    return export_structure(structure, folder / f"tower{suffix}", **options)[0]


def volume(structure: Structure) -> np.ndarray:
    width = np.where(np.isnan(structure.width_m), 2 * structure.segments.radius, structure.width_m)
    return structure.segments.length * np.maximum(width, 0.01) ** 2


# CSV, by pandas


def test_csv(full: Structure, tmp_path: Path) -> None:
    paths = export_structure(full, tmp_path / "tower.csv")
    assert [path.name for path in paths] == ["tower_bars.csv", "tower_joints.csv"]
    bars, joints = map(pd.read_csv, paths)
    assert (len(bars), len(joints)) == (len(full), len(full.joint))
    np.testing.assert_allclose(bars[["start_x_m", "start_y_m", "start_z_m"]], full.segments.start, atol=5.1e-7)
    np.testing.assert_allclose(bars[["end_x_m", "end_y_m", "end_z_m"]], full.segments.end, atol=5.1e-7)
    np.testing.assert_allclose(joints[["x_m", "y_m", "z_m"]], full.joint, atol=5.1e-7)
    assert bars["width_m"].isna().sum() == 1
    assert list(bars["group"]) == orientation(full.segments)
    ties = [(joint, int(bar)) for joint, row in enumerate(joints["bars"]) for bar in str(row).split()]
    assert ties == sorted(map(tuple, full.tie.tolist()))
    for table in (bars, joints):
        assert set(table["frame"]) == {"world: right-handed, z up"}


# DXF, by its group codes (the format's own text) and by ezdxf's audit


def groups_of(path: Path) -> list[tuple[int, str]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [(int(code), value.strip()) for code, value in zip(lines[0::2], lines[1::2], strict=True)]


def entities(path: Path) -> list[dict[int, str]]:
    """The entities of a DXF file, each as code → first value, read from nothing but pairs of lines."""
    found: list[dict[int, str]] = []
    inside = False
    for code, value in groups_of(path):
        if (code, value) == (2, "ENTITIES"):
            inside = True
        elif (code, value) == (0, "ENDSEC"):
            inside = False
        elif inside and code == 0:
            found.append({0: value})
        elif inside and found:
            found[-1].setdefault(code, value)
    return found


def test_dxf(full: Structure, tmp_path: Path) -> None:
    import ezdxf

    path = written(full, tmp_path, ".dxf")
    lines = [entity for entity in entities(path) if entity[0] == "LINE"]
    points = [entity for entity in entities(path) if entity[0] == "POINT"]
    assert (len(lines), len(points)) == (len(full), len(full.joint))
    assert [line[8] for line in lines] == orientation(full.segments)
    assert {point[8] for point in points} == {"joints"}
    ends = np.array([[float(line[code]) for code in (10, 20, 30, 11, 21, 31)] for line in lines])
    np.testing.assert_allclose(ends, np.hstack([full.segments.start, full.segments.end]), atol=1e-9)
    pairs = groups_of(path)
    assert pairs[pairs.index((9, "$INSUNITS")) + 1] == (70, "6")  # 6 is metres
    assert (1, "world: right-handed, z up") in pairs
    audit = ezdxf.readfile(path).audit()
    assert (audit.errors, audit.fixes) == ([], [])


# GLB, by trimesh, by Open3D, and by the chunks of the file itself


def chunks(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_glb_by_trimesh(full: Structure, tmp_path: Path) -> None:
    path = written(full, tmp_path, ".glb")
    scene = trimesh.load_scene(path)
    names = list(scene.graph.nodes_geometry)
    bars = [name for name in names if name.startswith("bar ")]
    assert (len(bars), len(names) - len(bars)) == (len(full), len(full.joint))
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # T_world_file
    for name in bars:
        bar = int(name.split()[1])
        T_file_box, mesh = scene.graph[name]
        box = scene.geometry[mesh].copy().apply_transform(y_up @ T_file_box)
        box.merge_vertices(merge_norm=True)  # a corner is there three times, for the normals of its faces
        assert box.is_watertight
        assert box.is_winding_consistent
        # A positive volume: the faces look outwards.
        assert box.volume == pytest.approx(volume(full)[bar], rel=1e-5)
        np.testing.assert_allclose(box.center_mass, full.segments.middle[bar], atol=1e-5)
        along = (box.vertices - full.segments.middle[bar]) @ full.segments.direction[bar]
        assert np.ptp(along) == pytest.approx(full.segments.length[bar], rel=1e-5)


def test_glb_by_open3d(full: Structure, tmp_path: Path) -> None:
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(written(full, tmp_path, ".glb")))
    boxes = len(full) + len(full.joint)
    assert len(mesh.triangles) == 12 * boxes
    # Open3D reads each node where the root puts it: z up in the world is y up in the file.
    high = np.asarray(mesh.vertices)[:, 1].max()
    assert high == pytest.approx(full.segments.end[:, 2].max(), abs=0.1)


def test_glb_states_unit_frame_and_scale(full: Structure, tmp_path: Path) -> None:
    error = np.linspace(0, 0.1, len(full))
    scene, data = chunks(written(full, tmp_path, ".glb", colour_m=error, colour_name="offset_m", colour_max_m=0.05))
    for about in (scene["asset"]["extras"], scene["scenes"][0]["extras"]):
        assert about["unit"] == "metre"
        assert about["frame"] == "world: right-handed, z up"
        assert about["colour"].startswith("offset_m: viridis, dark at 0 to yellow at 0.05 m and above")
    assert scene["nodes"][7]["extras"]["offset_m"] == error[7]
    assert len(data) >= sum(view["byteLength"] for view in scene["bufferViews"])
    mesh_of = [scene["nodes"][bar]["mesh"] for bar in (0, len(full) - 1)]
    dark, bright = (scene["materials"][scene["meshes"][mesh]["primitives"][0]["material"]] for mesh in mesh_of)
    # The ends of viridis are #440154 and #fde725; glTF has them in linear light.
    for material, colour in ((dark, "440154"), (bright, "fde725")):
        linear = np.array(material["pbrMetallicRoughness"]["baseColorFactor"][:3])
        shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_allclose(np.round(255 * shown), list(bytes.fromhex(colour)), atol=1)


# PLY, by Open3D and by trimesh


@pytest.mark.parametrize("structure", [frame(), tower()])
def test_ply(structure: Structure, tmp_path: Path) -> None:
    import open3d

    path = written(structure, tmp_path, ".ply")
    boxes = len(structure) + len(structure.joint)
    read = open3d.io.read_triangle_mesh(str(path))
    assert (len(read.vertices), len(read.triangles)) == (8 * boxes, 12 * boxes)
    assert read.has_vertex_colors()
    assert read.is_edge_manifold()
    mesh = trimesh.load_mesh(path, process=False)
    parts = mesh.vertices.reshape(-1, 8, 3)
    np.testing.assert_allclose(parts[: len(structure)].mean(axis=1), structure.segments.middle, atol=1e-6)
    cubes = parts[len(structure) :]
    np.testing.assert_allclose(cubes.mean(axis=1), structure.joint, atol=1e-6)
    cube = np.ptp(cubes[0], axis=0).prod()
    assert mesh.volume == pytest.approx(volume(structure).sum() + cube * len(structure.joint), rel=1e-5)
    header = path.read_bytes().split(b"end_header")[0].decode("ascii")
    assert "comment unit: metre" in header
    assert "comment frame: world: right-handed, z up" in header
    assert "comment colour: sigma_m: viridis" in header


def test_ply_colours_bars_by_what_is_known(tmp_path: Path) -> None:
    mesh = trimesh.load_mesh(written(frame(), tmp_path, ".ply", colour_max_m=0.004), process=False)
    colours = np.asarray(mesh.visual.vertex_colors)[::8, :3]
    assert colours[1].tolist() == list(bytes.fromhex("fde725"))  # sigma 4 mm is the top of the scale
    assert colours[2].tolist() == [153, 153, 153]  # not known
    assert colours[3].tolist() == [38, 38, 38]  # the first joint


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_large_coordinates_are_shifted_for_viewers(suffix: str, tmp_path: Path) -> None:
    path = written(shifted(frame(), UTM), tmp_path, suffix)
    assert b"origin: add 299100.0 2801400.0 1900.0" in path.read_bytes().replace(b'"origin":"', b"origin: ")
    mesh = trimesh.load_scene(path).to_mesh()
    assert np.abs(mesh.bounds).max() < 10


# GraphML, by networkx


def test_graphml(full: Structure, tmp_path: Path) -> None:
    graph = nx.read_graphml(written(full, tmp_path, ".graphml"), node_type=int)
    expected = full.graph()
    assert graph.number_of_nodes() == len(full.joint)
    assert {frozenset(edge) for edge in graph.edges} == {frozenset(edge) for edge in expected.edges}
    for joint, at in graph.nodes(data=True):
        assert [at["x_m"], at["y_m"], at["z_m"]] == full.joint[joint].tolist()
    for a, b, piece in graph.edges(data=True):
        assert piece["length_m"] == pytest.approx(np.linalg.norm(full.joint[a] - full.joint[b]))
        assert piece["sightings"] == full.sightings[piece["bar"]]
        assert ("width_m" in piece) == bool(np.isfinite(full.width_m[piece["bar"]]))
    assert graph.graph["unit"] == "metre"
    assert graph.graph["frame"] == "world: right-handed, z up"


def test_graphml_says_what_it_cannot_hold(tmp_path: Path) -> None:
    lone = replace(frame(), tie=frame().tie[:4])  # the beam and the strut are left with one joint each
    graph = nx.read_graphml(written(lone, tmp_path, ".graphml"))
    assert (graph.graph["bars"], graph.graph["bars_without_edge"]) == (3, 2)


# IFC, by ifcopenshell's validation, by its geometry kernel, and by the lines of the file


@pytest.fixture
def ifc():
    return pytest.importorskip("ifcopenshell", reason="the extra steelnb[ifc] is not installed")


def test_ifc_is_valid_and_holds_every_member(ifc, full: Structure, tmp_path: Path) -> None:
    import ifcopenshell.util.element
    import ifcopenshell.util.unit
    import ifcopenshell.validate

    path = written(full, tmp_path, ".ifc")
    assert path.read_text().count("=IFCMEMBER(") == len(full)
    model = ifc.open(str(path))
    log = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(model, log, express_rules=True)
    assert log.statements == []
    assert model.schema == "IFC4"
    assert ifcopenshell.util.unit.calculate_unit_scale(model) == 1.0  # metres
    assert "world: right-handed, z up" in model.by_type("IfcProject")[0].Description
    members = model.by_type("IfcMember")
    assert [member.ObjectType for member in members] == orientation(full.segments)
    assert len({member.GlobalId for member in members}) == len(full)
    for bar, member in enumerate(members):
        axis = next(r for r in member.Representation.Representations if r.RepresentationIdentifier == "Axis")
        ends = [list(point.Coordinates) for point in axis.Items[0].Points]
        np.testing.assert_allclose(ends, [full.segments.start[bar], full.segments.end[bar]], atol=1e-9)
    known = ifcopenshell.util.element.get_psets(members[0])["steelnb_estimate"]
    assert known["Width"] == full.width_m[0]
    assert known["Sightings"] == full.sightings[0]
    assert known["Joints"].split() == [str(j) for j, bar in full.tie.tolist() if bar == 0]
    assert "Width" not in ifcopenshell.util.element.get_psets(members[3])["steelnb_estimate"]


@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
def test_ifc_bodies_lie_on_the_bars(ifc, origin: np.ndarray, tmp_path: Path) -> None:
    import ifcopenshell.geom

    structure = shifted(frame(), origin)
    model = ifc.open(str(written(structure, tmp_path, ".ifc")))
    settings = ifcopenshell.geom.settings()
    for bar, member in enumerate(model.by_type("IfcMember")):
        shape = ifcopenshell.geom.create_shape(settings, member)
        T_world_member = np.array(shape.transformation.matrix).reshape(4, 4, order="F")
        vertices = np.array(shape.geometry.verts).reshape(-1, 3) @ T_world_member[:3, :3].T + T_world_member[:3, 3]
        mesh = trimesh.Trimesh(vertices - origin, np.array(shape.geometry.faces).reshape(-1, 3))
        assert abs(mesh.volume) == pytest.approx(volume(structure)[bar], rel=1e-6)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), structure.segments.middle[bar] - origin, atol=1e-6)


def test_ifc_without_its_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'steelnb\[ifc\]'"):
        export_structure(frame(), tmp_path / "a.ifc")
    assert list(tmp_path.iterdir()) == []


# All of them


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_same_structure_gives_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    if suffix == ".ifc":
        pytest.importorskip("ifcopenshell", reason="the extra steelnb[ifc] is not installed")
    for name in ("one", "two"):
        export_structure(frame(), tmp_path / name / f"tower{suffix}")
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.parametrize("suffix", [".step", "", ".JSN"])
def test_an_unknown_ending_names_the_known(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedFormatError) as caught:
        export_structure(frame(), tmp_path / f"a{suffix}")
    assert all(known in str(caught.value) for known in FORMATS)
    assert "\n" not in str(caught.value)


def test_endings_are_known_in_any_case(tmp_path: Path) -> None:
    assert len(read_structure(export_structure(frame(), tmp_path / "A.JSON")[0])) == 3


@pytest.mark.parametrize("suffix", [".json", ".csv", ".ply"])
def test_a_file_is_overwritten_only_when_asked(suffix: str, tmp_path: Path) -> None:
    first = export_structure(frame(), tmp_path / f"a{suffix}")
    before = {path: path.read_bytes() for path in first}
    with pytest.raises(OutputError, match="exists already"):
        export_structure(tower(), tmp_path / f"a{suffix}")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    export_structure(tower(), tmp_path / f"a{suffix}", overwrite=True)
    assert sorted(tmp_path.iterdir()) == sorted(first)
    assert all(path.read_bytes() != before[path] for path in first)


def test_a_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(structure, path, extras):
        path.write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setitem(FORMATS, ".json", FORMATS[".json"]._replace(write=fail))
    with pytest.raises(KeyboardInterrupt):
        export_structure(frame(), tmp_path / "new" / "a.json")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_no_bars(suffix: str, tmp_path: Path) -> None:
    if suffix in DRAWN:
        with pytest.raises(EmptyStructureError, match="no bars"):
            export_structure(Structure.empty(), tmp_path / f"a{suffix}")
        assert list(tmp_path.iterdir()) == []
    else:
        assert export_structure(Structure.empty(), tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_broken_structure_is_not_written(suffix: str, tmp_path: Path) -> None:
    whole = frame()
    joint = whole.joint.copy()
    joint[1, 2] = np.nan
    with pytest.raises(NonFiniteError, match="joint 1"):
        export_structure(replace(whole, joint=joint), tmp_path / f"a{suffix}")
    with pytest.raises(NonFiniteError, match="sigma_m of bar 0 = inf"):
        export_structure(replace(whole, sigma_m=np.array([np.inf, 0, 0])), tmp_path / f"a{suffix}")
    with pytest.raises(StructureError, match="tie 0 is of joint 0 and bar 7"):
        export_structure(replace(whole, tie=np.array([[0, 7]])), tmp_path / f"a{suffix}")
    with pytest.raises(StructureError, match="rows for"):
        export_structure(replace(whole, width_m=np.zeros(2)), tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_colours_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"only \.glb, \.ply"):
        export_structure(frame(), tmp_path / "a.dxf", colour_m=np.zeros(3))
    with pytest.raises(SettingsError, match="one value for each of 3"):
        export_structure(frame(), tmp_path / "a.glb", colour_m=np.zeros(4))
    with pytest.raises(SettingsError, match="0 or more"):
        export_structure(frame(), tmp_path / "a.glb", colour_m=np.array([0, -1.0, 2]))
    with pytest.raises(SettingsError, match="colour_max_m = 0"):
        export_structure(frame(), tmp_path / "a.glb", colour_max_m=0)


def test_a_scale_that_nobody_gave() -> None:
    assert Colours.of(np.full(3, np.nan), "x", None).rgb.tolist() == [[0.6, 0.6, 0.6]] * 3
    assert Colours.of(np.zeros(2), "x", None).max_m == 1e-3
    assert Colours.of(np.arange(101) / 100, "x", None).max_m == pytest.approx(0.95)


def test_rotations_are_rotations_along_the_bars(full: Structure) -> None:
    for structure in (full, frame()):
        turn = rotations(structure.segments)
        np.testing.assert_allclose(
            turn @ turn.transpose(0, 2, 1), np.tile(np.eye(3), (len(structure), 1, 1)), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(turn), 1)
        np.testing.assert_allclose(turn[:, :, 0], structure.segments.direction)
        np.testing.assert_allclose(turn[:, 2, 1], 0, atol=1e-12)  # y is horizontal
