import itertools

import numpy as np
import pytest

from steelnb.settings import TowerSettings
from steelnb.simulation import build_tower
from steelnb.simulation.tower import half_width
from tests.lattice import pieces_of


@pytest.fixture(scope="module")
def tower():
    return build_tower()


def test_the_report_tower_has_the_report_s_size(tower):
    assert tower.joints[:, 2].max() == 16.0
    assert tower.joints[:, 2].min() == 0.0
    assert np.abs(tower.joints[:, 0]).max() == pytest.approx(3.8)
    assert {member.kind for member in tower.members} == {"leg", "ring", "bracing", "arm"}


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


@pytest.mark.parametrize("section", ["angle", "round"])
@pytest.mark.parametrize("name", ["tapered", "report"])
def test_members_are_straight_closed_prisms_with_the_area_of_their_sections(name, section):
    """A rod has the area of its circle. The heel of an angle, or the middle of a rod, is on the axis."""
    tower = build_tower(TowerSettings.preset(name).replace(section=section))
    corner = tower.vertices[tower.triangles]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    for m, (member, (start, end)) in enumerate(zip(tower.members, tower.axes, strict=True)):
        mine, axis, (width, thickness) = tower.triangle_member == m, end - start, member.section_m
        points = tower.joints[list(member.joints)]
        along = (points - start) @ axis / (axis @ axis)
        assert (np.diff(along) > 0).all()
        np.testing.assert_allclose(start + along[:, None] * axis, points, atol=1e-3)
        # Every edge of a closed surface belongs to two triangles, once in each direction.
        edges = {(a, b) for t in tower.triangles[mine] for a, b in itertools.pairwise([*t, t[0]])}
        assert len(edges) == 3 * mine.sum()
        assert {(b, a) for a, b in edges} == edges
        area = (2 * width - thickness) * thickness if section == "angle" else np.pi * thickness**2
        assert abs(volume[mine].sum()) == pytest.approx(area * np.linalg.norm(axis), rel=1e-6)
        away = np.linalg.norm(np.cross(corner[mine].reshape(-1, 3) - start, axis / np.linalg.norm(axis)), axis=1)
        if section == "round":
            assert thickness == width / 2
            np.testing.assert_allclose(away, thickness, rtol=0.015 if width >= 0.08 else 0.055)
        else:
            assert away.min() < 1e-9
            assert away.max() == pytest.approx(np.hypot(width, thickness))
        if member.kind == "leg":
            inwards = -points.mean(axis=0)[:2]
            assert np.array(member.flange_a)[:2] @ inwards > 0
            assert np.array(member.flange_b)[:2] @ inwards > 0


def test_other_towers_can_be_built():
    profile_m = ((0.0, 4.0), (18.0, 1.7), (30.0, 1.0))
    tower = build_tower(TowerSettings(profile_m=profile_m, arms_m=((20.0, 5.0), (25.0, 4.0))))
    assert pieces_of(tower)[1] == 1
    assert tower.joints[:, 2].max() == 30.0
    assert half_width(tower.settings, 18.0) == pytest.approx(0.85)
