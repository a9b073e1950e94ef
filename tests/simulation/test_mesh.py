"""A mesh in place of a list's members: seen and touched as the members' own, and refused where it cannot be theirs."""

import re

import numpy as np
import pytest
import trimesh

from steelnb.core.errors import CollisionError, InputError
from steelnb.settings import CameraSettings, FlightSettings, TofSettings, TowerSettings
from steelnb.simulation import Camera, build_tower, flight, fly
from steelnb.simulation.camera import SAMPLES
from steelnb.simulation.mesh import ON_PLATE
from steelnb.simulation.raycasting import cast_rays, make_scene, rays
from tests.lattice import mesh_of

REPORT = TowerSettings.preset("report")
LISTED = build_tower(REPORT)
CAMERA = TofSettings.preset("report")
POSES = np.tile(np.eye(4), (3, 1, 1))
POSES[:, :3, 3] = (-3.0, 0.3, 1.0), (-2.5, -0.4, 6.0), (-3.0, 0.2, 13.0)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    mesh = mesh_of(LISTED)
    mesh.export(folder / "pole.stl")
    mesh.export(folder / "pole.ply")
    (folder / "text.stl").write_text(trimesh.exchange.stl.export_stl_ascii(mesh))
    return folder


@pytest.mark.parametrize("name", ["pole.stl", "text.stl", "pole.ply"])
def test_scans_see_a_file_of_the_list_s_own_mesh_as_the_list(saved, name):
    tower = build_tower(REPORT.replace(mesh=saved / name))
    ray = rays(CAMERA)
    expected, member = cast_rays(make_scene(LISTED), POSES, ray)
    seen, owner = cast_rays(make_scene(tower), POSES, ray)
    assert 0.2 < np.isfinite(expected).mean() < 1
    np.testing.assert_allclose(seen, expected, atol=1e-3)
    on_bars = member >= 0
    assert (owner[on_bars] == member[on_bars]).mean() > 0.8  # at joints, another member may be nearer
    assert tower.members == LISTED.members
    np.testing.assert_array_equal(tower.axes, LISTED.axes)


def test_what_belongs_to_no_member_is_a_plate_and_slivers_are_left_out(tmp_path):
    wall = trimesh.creation.box((0.2, 3.0, 2.0), trimesh.transformations.translation_matrix((3.0, 0, 1.0)))
    sliver = trimesh.Trimesh([(0, 0, 1), (1, 0, 1), (0.5, 1e-6, 1)], [(0, 1, 2)], process=False)
    trimesh.util.concatenate([mesh_of(LISTED), wall, sliver]).export(tmp_path / "a.stl")
    tower = build_tower(REPORT.replace(mesh=str(tmp_path / "a.stl")))
    assert len(tower.triangles) == len(LISTED.triangles) + 12
    assert (tower.triangle_member[-12:] == ON_PLATE).all()
    beside = np.eye(4)[None]
    beside[0, :3, 3] = 2.0, 0.0, 1.0
    range_m, member = cast_rays(make_scene(tower), beside, rays(CAMERA))
    assert (member == ON_PLATE).mean() > 0.5
    assert range_m[member == ON_PLATE].min() == pytest.approx(0.9, abs=0.01)
    image = Camera(tower, CameraSettings(columns=64, rows=48)).render(np.tile(POSES[0], (SAMPLES, 1, 1)))
    assert image.std() > 0


def test_a_mesh_larger_than_pybullet_holds_is_touched_in_all_its_parts(saved, monkeypatch):
    tower = build_tower(REPORT.replace(mesh=str(saved / "pole.stl")))
    into = FlightSettings.preset("zigzag", 30.0).replace(standoff_m=-0.05)
    with pytest.raises(CollisionError) as whole:
        fly(tower, into, 1)
    monkeypatch.setattr(flight, "VERTICES_MAX", 900)
    parts = list(flight.mesh_parts(tower.vertices, tower.triangles))
    assert max(len(vertices) for vertices, _ in parts) <= 900
    corner = np.concatenate([vertices[triangles] for vertices, triangles in parts])
    np.testing.assert_array_equal(corner, tower.vertices[tower.triangles])
    with pytest.raises(CollisionError, match=re.escape(str(whole.value))):
        fly(tower, into, 1)


def test_a_changed_file_is_another_tower(tmp_path):
    settings = REPORT.replace(mesh=str(tmp_path / "a.stl"))
    mesh_of(LISTED).export(tmp_path / "a.stl")
    first = build_tower(settings)
    assert build_tower(settings) is first
    mesh = mesh_of(LISTED)
    mesh.apply_translation((0.1, 0, 0))
    mesh.export(tmp_path / "a.stl")
    np.testing.assert_allclose(
        build_tower(settings).vertices.min(axis=0) - first.vertices.min(axis=0), [0.1, 0, 0], atol=1e-6
    )


def test_meshes_that_cannot_be_the_tower_are_refused(tmp_path):
    def refused(name: str, message: str) -> None:
        with pytest.raises(InputError, match=message):
            build_tower(REPORT.replace(mesh=str(tmp_path / name)))

    mesh = mesh_of(LISTED)
    whole = trimesh.exchange.stl.export_stl(mesh)
    (tmp_path / "half.stl").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.stl").write_bytes(b"")
    (tmp_path / "words.stl").write_bytes(b"a letter\n" * 30)
    trimesh.PointCloud(LISTED.vertices).export(tmp_path / "points.ply")
    ply = trimesh.exchange.ply.export_ply(mesh)
    (tmp_path / "half.ply").write_bytes(ply[: len(ply) // 2])
    (tmp_path / "pole.obj").write_text("v 0 0 0\n")
    for name in ("half.stl", "empty.stl", "words.stl", "points.ply"):
        refused(name, f"{name}: (no triangles; expected|not) an STL or PLY file of triangles")
    refused("half.ply", "half.ply: not an STL or PLY file of triangles: PLY is unexpected length")
    refused("pole.obj", "pole.obj': expected FILE.stl or FILE.ply")
    refused("none.stl", "none.stl: does not exist; expected a mesh")
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "mm.stl")
    refused(
        "mm.stl", r"mm.stl: from \(-3\d{3}.* the members are from \(-3.* expected a mesh in metres, world frame, z up"
    )
    turned = mesh_of(LISTED)
    turned.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    turned.export(tmp_path / "y_up.stl")
    refused("y_up.stl", "expected a mesh in metres, world frame, z up")
    flat = trimesh.Trimesh(LISTED.vertices, np.repeat(LISTED.triangles[:, :1], 3, axis=1), process=False)
    flat.export(tmp_path / "flat.stl")
    refused("flat.stl", "flat.stl: no triangles; expected an STL or PLY file of triangles")
    broken = bytearray(whole)
    broken[96:100] = b"\xff\xff\xff\x7f"  # NaN
    (tmp_path / "nan.stl").write_bytes(broken)
    refused("nan.stl", "corners that are not finite")
    with pytest.raises(InputError, match=r"mesh = 'pole\.stl': expected members too, the list of the bars in it"):
        TowerSettings(mesh="pole.stl")
