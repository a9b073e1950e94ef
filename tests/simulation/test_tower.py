import numpy as np
import pytest

from steelnb.settings import TowerSettings
from steelnb.simulation import build_tower
from steelnb.simulation.tower import half_width
from tests.lattice import build_tubes, pieces_of


@pytest.fixture(scope="module")
def tower():
    return build_tower()


def test_the_report_tower_has_the_report_s_size(tower):
    assert tower.joints[:, 2].max() == 16.0
    assert tower.joints[:, 2].min() == 0.0
    assert np.abs(tower.joints[:, 0]).max() == pytest.approx(3.8)
    assert {member.kind for member in tower.members} == {"leg", "ring", "bracing", "arm"}


def test_joints_lie_on_the_axes_of_their_members(tower):
    for member in tower.members:
        points = tower.joints[list(member.joints)]
        axis = points[-1] - points[0]
        along = (points - points[0]) @ axis / (axis @ axis)
        assert (np.diff(along) > 0).all()
        np.testing.assert_allclose(points[0] + along[:, None] * axis, points, atol=1e-6)


def test_the_tower_is_one_piece_without_loose_ends(tower):
    pieces, parts = pieces_of(tower)
    assert parts == 1
    feet = {j for j, p in enumerate(tower.joints) if p[2] == 0}
    assert len(feet) == 4
    assert all(degree >= 2 for j, degree in enumerate(np.bincount(pieces.ravel())) if j not in feet)
    assert len(pieces) == sum(len(m.joints) - 1 for m in tower.members)


def test_the_tower_is_symmetric_about_both_vertical_planes(tower):
    known = {tuple(np.round(p, 4) + 0.0) for p in tower.joints}
    for mirror in ([-1, 1, 1], [1, -1, 1]):
        assert {tuple(np.round(p * mirror, 4) + 0.0) for p in tower.joints} == known


def test_the_mesh_is_closed_and_has_the_volume_of_its_sections(tower):
    # Every edge of a closed surface belongs to two triangles, once in each direction.
    t = tower.triangles
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges}
    assert len(forward) == len(edges)
    assert {(b, a) for a, b in forward} == forward
    corner = tower.vertices[t]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    for m in (0, 50, 120, len(tower.members) - 1):
        width, thickness = tower.members[m].section_m
        length = np.linalg.norm(tower.axes[m, 1] - tower.axes[m, 0])
        expected = (2 * width - thickness) * thickness * length
        assert abs(volume[tower.triangle_member == m].sum()) == pytest.approx(expected, rel=1e-6)


def test_the_heel_of_each_section_lies_on_the_axis_and_legs_open_inwards(tower):
    for m, member in enumerate(tower.members):
        corners = tower.vertices[tower.triangles[tower.triangle_member == m].ravel()]
        for end in tower.axes[m]:
            assert np.linalg.norm(corners - end, axis=1).min() < 1e-9
        if member.kind == "leg":
            inside = corners.mean(axis=0) - tower.axes[m].mean(axis=0)
            assert inside[:2] @ tower.axes[m].mean(axis=0)[:2] < 0


def test_other_towers_can_be_built():
    tower = build_tower(TowerSettings(height_m=30.0, waist_height_m=18.0, arms_m=((20.0, 5.0), (25.0, 4.0))))
    assert pieces_of(tower)[1] == 1
    assert tower.joints[:, 2].max() == 30.0
    assert half_width(tower.settings, 18.0) == pytest.approx(0.85)


def test_tubes_lie_around_their_axes_and_have_the_area_of_the_circle():
    axes = np.array([[[0.0, 0, 0], [0, 0, 2]], [[1, 0, 1], [2, 1, 2]]])
    tubes = build_tubes(axes, 0.05)
    np.testing.assert_array_equal(tubes.axes, axes)
    corner = tubes.vertices[tubes.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    for m, (start, end) in enumerate(axes):
        mine, length = tubes.triangle_member == m, np.linalg.norm(end - start)
        away = corner[mine].mean(axis=1) - start
        outward = away - (away @ (end - start))[:, None] * (end - start) / length**2
        assert (np.einsum("ij,ij->i", normal[mine], outward) > 0).all()
        # Each wall and the axis span a triangular prism, of half the wall's area times its distance to the axis.
        doubled = np.einsum("ij,ij->i", normal[mine], corner[mine, 0] - start)  # a normal is as long as twice the area
        assert 0.5 * 0.5 * doubled.sum() == pytest.approx(np.pi * 0.05**2 * length, rel=1e-9)
