"""Every format of a structure, opened and counted by a reader that had no part in writing it."""

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
import trimesh
from steelnb.io.segments import orientation

from steelnb.errors import InputError, MissingExtraError, OutputError
from steelnb.fusion.structure import Structure
from steelnb.io.structures import DRAWN, FORMATS, write_structure
from tests.io.made import UTM, frame, shifted, tower

FRAME = "world: right-handed, z up"
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""T_world_file of GLB."""


@pytest.fixture(scope="module")
def full() -> Structure:
    return tower()


def written(structure: Structure, folder: Path, suffix: str) -> Path:
    return write_structure(structure, folder / f"tower{suffix}")[0]


def volume(structure: Structure) -> np.ndarray:
    width = np.where(np.isnan(structure.width_m), 2 * structure.segments.radius, structure.width_m)
    return structure.segments.length * np.maximum(width, 0.01) ** 2


def test_csv(full: Structure, tmp_path: Path) -> None:
    paths = write_structure(full, tmp_path / "tower.csv")
    assert [path.name for path in paths] == ["tower_bars.csv", "tower_joints.csv"]
    bars, joints = map(pd.read_csv, paths)
    np.testing.assert_allclose(bars[["start_x_m", "start_y_m", "start_z_m"]], full.segments.start, atol=5.1e-7)
    np.testing.assert_allclose(bars[["end_x_m", "end_y_m", "end_z_m"]], full.segments.end, atol=5.1e-7)
    np.testing.assert_allclose(joints[["x_m", "y_m", "z_m"]], full.joint, atol=5.1e-7)
    assert bars["width_m"].isna().sum() == 1
    assert list(bars["group"]) == orientation(full.segments)
    ties = [(joint, int(bar)) for joint, row in enumerate(joints["bars"]) for bar in str(row).split()]
    assert ties == sorted(map(tuple, full.tie.tolist()))
    assert {*bars["frame"], *joints["frame"]} == {FRAME}


def test_dxf(full: Structure, tmp_path: Path) -> None:
    import ezdxf

    drawing = ezdxf.readfile(written(full, tmp_path, ".dxf"))
    lines, points = (list(drawing.modelspace().query(kind)) for kind in ("LINE", "POINT"))
    assert [line.dxf.layer for line in lines] == orientation(full.segments)
    ends = [[*line.dxf.start, *line.dxf.end] for line in lines]
    np.testing.assert_allclose(ends, np.hstack([full.segments.start, full.segments.end]), atol=1e-9)
    np.testing.assert_allclose([list(point.dxf.location) for point in points], full.joint, atol=1e-9)
    assert {point.dxf.layer for point in points} == {"joints"}
    known = [[value for _, value in line.get_xdata("STEELNB")] for line in lines]
    assert [numbers[:2] for numbers in known] == [[bar, n] for bar, n in enumerate(full.sightings.tolist())]
    assert (known[0][2], known[3][2]) == (full.width_m[0], -1.0)
    assert drawing.units == ezdxf.units.M
    assert ("frame", FRAME) in drawing.header.custom_vars.properties
    audit = drawing.audit()
    assert (audit.errors, audit.fixes) == ([], [])


def test_glb(full: Structure, tmp_path: Path) -> None:
    scene = trimesh.load_scene(written(full, tmp_path, ".glb"))
    names = list(scene.graph.nodes_geometry)
    bars = [name for name in names if name.startswith("bar ")]
    assert (len(bars), len(names) - len(bars)) == (len(full), len(full.joint))
    for name in names:
        T_file_box, mesh = scene.graph[name]
        box, k = scene.geometry[mesh].copy().apply_transform(Y_UP @ T_file_box), int(name.split()[1])
        box.merge_vertices(merge_norm=True)  # a corner is there three times, for the normals of its faces
        assert box.is_watertight
        assert box.is_winding_consistent
        middle = full.segments.middle[k] if name in bars else full.joint[k]
        np.testing.assert_allclose(box.center_mass, middle, atol=1e-6)
        if name in bars:
            assert box.volume == pytest.approx(volume(full)[k], rel=1e-5)  # positive: the faces look outwards
            along = (box.vertices - full.segments.middle[k]) @ full.segments.direction[k]
            assert np.ptp(along) == pytest.approx(full.segments.length[k], rel=1e-6)
    about = scene.metadata
    assert (about["unit"], about["frame"]) == ("metre", FRAME)
    assert about["colour"].startswith("sigma_m: viridis, dark at 0 to yellow at 0.0")
    known = scene.graph.transforms.edge_data["structure", "bar 7"]["metadata"]
    assert (known["sigma_m"], known["sightings"]) == (full.sigma_m[7], full.sightings[7])
    # glTF has colours in linear light.
    top, bar = np.quantile(full.sigma_m, 0.95), int(np.argmax(full.sigma_m < 0.002))
    linear = np.array(scene.geometry[scene.graph[f"bar {bar}"][1]].visual.material.baseColorFactor[:3]) / 255
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, matplotlib.colormaps["viridis"](full.sigma_m[bar] / top)[:3], atol=0.02)


def test_large_coordinates_are_shifted_for_viewers(tmp_path: Path) -> None:
    path = written(shifted(frame(), UTM), tmp_path, ".glb")
    assert b'"origin":"add 299100.0 2801400.0 1900.0' in path.read_bytes()
    assert np.abs(trimesh.load_scene(path).to_mesh().bounds).max() < 10


def test_ifc_is_valid_and_holds_every_member(full: Structure, tmp_path: Path) -> None:
    ifc = pytest.importorskip("ifcopenshell", reason="the extra steelnb[io] is not installed")
    import ifcopenshell.util.element
    import ifcopenshell.util.unit
    import ifcopenshell.validate

    model = ifc.open(str(written(full, tmp_path, ".ifc")))
    log = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(model, log, express_rules=True)
    assert log.statements == []
    assert ifcopenshell.util.unit.calculate_unit_scale(model) == 1.0  # metres
    assert FRAME in model.by_type("IfcProject")[0].Description
    members = model.by_type("IfcMember")
    assert [member.ObjectType for member in members] == orientation(full.segments)
    assert len({member.GlobalId for member in members}) == len(full)
    for bar, member in enumerate(members):
        axis = next(r for r in member.Representation.Representations if r.RepresentationIdentifier == "Axis")
        ends = [list(point.Coordinates) for point in axis.Items[0].Points]
        np.testing.assert_allclose(ends, [full.segments.start[bar], full.segments.end[bar]], atol=1e-9)
    known = ifcopenshell.util.element.get_psets(members[0])["steelnb_estimate"]
    assert (known["Width"], known["Sightings"]) == (full.width_m[0], full.sightings[0])
    assert known["Joints"].split() == [str(j) for j, bar in full.tie.tolist() if bar == 0]
    assert "Width" not in ifcopenshell.util.element.get_psets(members[3])["steelnb_estimate"]


def test_ifc_draws_a_tube_as_a_circle(tmp_path: Path) -> None:
    ifc = pytest.importorskip("ifcopenshell", reason="the extra steelnb[io] is not installed")
    model = ifc.open(str(written(replace(frame(), tube=np.array([False, True, False])), tmp_path, ".ifc")))
    sections = [solid.SweptArea for solid in model.by_type("IfcExtrudedAreaSolid")]
    assert [section.is_a("IfcCircleProfileDef") for section in sections] == [False, True, False]
    assert sections[1].Radius == frame().width_m[1] / 2


@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
def test_ifc_bodies_lie_on_the_bars(origin: np.ndarray, tmp_path: Path) -> None:
    ifc = pytest.importorskip("ifcopenshell", reason="the extra steelnb[io] is not installed")
    import ifcopenshell.geom

    structure = shifted(frame(), origin)
    model = ifc.open(str(written(structure, tmp_path, ".ifc")))
    for bar, member in enumerate(model.by_type("IfcMember")):
        shape = ifcopenshell.geom.create_shape(ifcopenshell.geom.settings(), member)
        T_world_member = np.array(shape.transformation.matrix).reshape(4, 4, order="F")
        vertices = np.array(shape.geometry.verts).reshape(-1, 3) @ T_world_member[:3, :3].T + T_world_member[:3, 3]
        mesh = trimesh.Trimesh(vertices - origin, np.array(shape.geometry.faces).reshape(-1, 3))
        assert abs(mesh.volume) == pytest.approx(volume(structure)[bar], rel=1e-6)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), structure.segments.middle[bar] - origin, atol=1e-6)


# All of them


@pytest.mark.parametrize(("suffix", "library"), [(".ifc", "ifcopenshell"), (".dxf", "ezdxf"), (".glb", "trimesh")])
def test_a_missing_library_names_the_extra(
    suffix: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtraError, match=rf"{library} is not installed: pip install 'steelnb\[io\]'"):
        write_structure(frame(), tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_same_structure_gives_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_structure(frame(), tmp_path / name / f"tower{suffix}")
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.parametrize("suffix", ["", ".JSN"])
def test_an_unknown_ending_names_the_known(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=", ".join(FORMATS)):
        write_structure(frame(), tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".json", ".csv", ".glb"])
def test_a_file_is_overwritten_only_when_asked(suffix: str, tmp_path: Path) -> None:
    first = write_structure(frame(), tmp_path / f"a{suffix}")
    before = {path: path.read_bytes() for path in first}
    with pytest.raises(OutputError, match="exists already"):
        write_structure(tower(), tmp_path / f"a{suffix}")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    write_structure(tower(), tmp_path / f"a{suffix}", overwrite=True)
    assert sorted(tmp_path.iterdir()) == sorted(first)
    assert all(path.read_bytes() != before[path] for path in first)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_structure_without_bars_or_with_faults(suffix: str, tmp_path: Path) -> None:
    whole, joint = frame(), frame().joint
    joint[1, 2] = np.nan
    for change, error, words in (
        ({"joint": joint}, InputError, r"joints\[1\]\.position_m\[2\] = nan"),
        ({"sigma_m": np.array([np.inf, 0, 0])}, InputError, r"bars\[0\]\.sigma_m = inf"),
        ({"width_m": np.array([-1.0, 0, 0])}, InputError, r"bars\[0\]\.width_m = -1"),
        ({"tie": np.array([[0, 7]])}, InputError, "tie 0 is of joint 0 and bar 7"),
        ({"width_m": np.zeros(2)}, InputError, "width_m has 2 rows for 3 bars"),
    ):
        with pytest.raises(error, match=words):
            write_structure(replace(whole, **change), tmp_path / f"a{suffix}")
    if suffix in DRAWN:
        with pytest.raises(InputError, match="no bars"):
            write_structure(Structure.empty(), tmp_path / f"a{suffix}")
        assert list(tmp_path.iterdir()) == []
    else:
        assert write_structure(Structure.empty(), tmp_path / f"a{suffix}")
