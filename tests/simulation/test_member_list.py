"""The report's tower against its published geometry, and towers from other lists of members."""

import itertools
import math

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.metrics.segments import seen_members
from steelnb.settings import CameraSettings, TofSettings, TowerSettings
from steelnb.simulation import Camera, build_tower, scan_flight
from steelnb.simulation.camera import SAMPLES
from steelnb.simulation.flight import HALF_BOX_M
from steelnb.simulation.member_list import COLUMNS, joints_of_members
from steelnb.simulation.mesh import GROUND, ON_PLATE
from steelnb.simulation.raycasting import cast_bundle, make_scene
from steelnb.simulation.tower import half_width
from tests.lattice import pieces_of

# Measured on pictures (scripts/report-tower); relative to the axis.
CENTRE = np.array([-0.041, -0.073, 0.0])
HALF_WIDTH_M = {0.0: 1.878, 2.93: 1.452, 5.99: 1.009, 8.04: 0.709, 8.955: 0.577, 12.0: 0.577, 15.9: 0.577}
BRACE_ENDS_M = (0.0, 5.04, 7.04, 8.955, 10.36, 11.77, 13.18, 14.59, 16.0)
CROSSINGS_M = (2.93, 5.99, 8.04, 9.67, 11.07, 12.46, 13.88, 15.28)
ARMS_M = {9.667: (8.955, 2.5, 9.725), 11.765: (11.069, 3.25, 11.805), 13.877: (13.177, 3.82, 13.9)}
"""Height of the top chord: that of the lower chord at the body, reach of the tip, height of the deck."""
CORNERS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
FACES = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
HEADER = ",".join(COLUMNS)
NEAR_M = 0.025
"""The measured numbers are good to 2 to 4 cm."""


@pytest.fixture(scope="module")
def tower():
    return build_tower(TowerSettings.preset("report"))


@pytest.fixture(scope="module")
def scene(tower):
    return make_scene(tower)


def width_at(z):
    return np.interp(z, list(HALF_WIDTH_M), list(HALF_WIDTH_M.values()))


def joint_at(tower, x, y, z, near=NEAR_M):
    """The joint at a position relative to the middle of the tower."""
    distance = np.linalg.norm(tower.joints - CENTRE - [x, y, z], axis=1)
    assert distance.min() <= near, (x, y, z, distance.min())
    return int(distance.argmin())


def through(tower, joint, kind):
    """The members of a kind on a joint, as the end points of their axes."""
    return [axis for axis, member in zip(tower.axes, tower.members, strict=True)
            if joint in member.joints and member.kind == kind]  # fmt: skip


def is_member(tower, start, end, kind, near=NEAR_M):
    axes = tower.axes[[member.kind == kind for member in tower.members]] - CENTRE
    both = np.stack([axes, axes[:, ::-1]])
    return (np.linalg.norm(both - [start, end], axis=3).max(axis=2) <= near).any()


def hit(scene, position, direction):
    """Range and member of the hit of a ray from a position relative to the middle of the tower."""
    ray = np.concatenate([CENTRE + position, direction]).astype(np.float32)
    found = cast_bundle(scene, ray[None])
    return float(found.range_m[0]), int(found.member[0])


def test_the_legs_have_the_measured_widths(tower):
    legs = tower.axes[[member.kind == "leg" for member in tower.members]] - CENTRE
    legs = np.array([sorted(leg.tolist(), key=lambda end: end[2]) for leg in legs])
    assert legs[..., 2].max() == pytest.approx(16.0, abs=0.01)
    for z, half in HALF_WIDTH_M.items():
        at = [start + (z - start[2]) / (end[2] - start[2]) * (end - start)
              for start, end in legs if start[2] <= z < end[2]]  # fmt: skip
        assert {tuple(np.sign(place[:2])) for place in at} == {tuple(corner) for corner in CORNERS}
        np.testing.assert_allclose(np.abs(np.array(at)[:, :2]), half, atol=0.0125)
        assert half_width(tower.settings, z) == pytest.approx(half, abs=0.0125)


def test_braces_end_on_the_legs_and_cross_at_a_strut_on_all_faces(tower):
    for z in BRACE_ENDS_M:
        for corner in CORNERS * width_at(z):
            joint = joint_at(tower, *corner, z)
            assert through(tower, joint, "leg")
            assert len(through(tower, joint, "bracing")) >= 2  # of the faces on both sides
    for z, face in itertools.product(CROSSINGS_M, FACES):
        joint = joint_at(tower, *face * width_at(z), z)
        height = tower.joints[joint, 2]
        ends = [end for axis in through(tower, joint, "bracing") for end in axis if abs(end[2] - height) > 0.05]
        side = np.array(ends) - tower.joints[joint]
        along = side[:, :2] @ face[::-1]
        quarters = {(int(np.sign(a)), int(np.sign(b))) for a, b in zip(along, side[:, 2], strict=True) if abs(a) > 0.3}
        assert quarters == {(1, 1), (1, -1), (-1, 1), (-1, -1)}, (z, face)
        struts = [axis for axis in through(tower, joint, "ring") if abs((axis[1] - axis[0])[:2] @ face) < NEAR_M]
        assert sum(np.linalg.norm(b - a) for a, b in struts) == pytest.approx(2 * width_at(z), abs=0.03)


def test_hip_diagonals_rings_and_arms_are_where_the_pictures_show_them(tower):
    middle = np.array([0.0, 0.0, 2.93])
    for k, corner in enumerate(CORNERS):
        assert is_member(tower, [*corner * 1.878, 0.0], middle, "bracing")
        assert is_member(tower, middle, [*-corner * width_at(5.037), 5.037], "bracing")
        assert not is_member(tower, [*corner * width_at(5.037), 5.037], (0, 0, 5.986), "bracing"), "none higher"
        for z in (8.955, 15.996):
            assert is_member(tower, [*corner * width_at(z), z], [*CORNERS[k - 1] * width_at(z), z], "ring")
        for top, (low, tip, _) in ARMS_M.items():
            x, y = corner * (tip, 0.09)
            assert is_member(tower, [*corner * 0.577, top], (x, 0, top), "arm", near=0.03)
            assert is_member(tower, [*corner * 0.577, low], (x, y, top - 0.05), "arm", near=0.03)


def test_walkways_of_half_a_metre_lie_on_the_arms(tower, scene):
    for z, (_, tip, deck) in ARMS_M.items():
        for x, y in itertools.product((-0.9, -0.4, 0.4, 0.9), (-0.2, 0.0, 0.2)):
            down, member = hit(scene, (x * tip, y, deck + 0.3), (0, 0, -1))
            assert (down, member) == (pytest.approx(0.3, abs=0.04), ON_PLATE), (x, y, z)
        beside, member = hit(scene, (0.3 * tip, 0.35, deck + 0.1), (0, 0, -1))
        assert member != ON_PLATE or beside > 1.0, "not the triangle between the chords"
    assert hit(scene, (2.0, 0.5, 12.2), (0, 0, -1)) == (pytest.approx(0.4, abs=0.06), ON_PLATE)  # a balcony
    top = hit(scene, (1.1, 0.2, 16.5), (0, 0, -1)), hit(scene, (0.3, 0.4, 16.5), (0, 0, -1))
    assert top == ((pytest.approx(0.47, abs=0.06), ON_PLATE),) * 2


def test_the_floor_is_a_plate_of_six_metres_and_nothing_lies_beyond(scene):
    for x, y in ((2.9, 2.9), (-2.9, 2.9), (2.9, -2.9), (0.3, 0.5)):
        assert hit(scene, (x - CENTRE[0], y - CENTRE[1], 0.5), (0, 0, -1)) == (pytest.approx(0.5), GROUND)
    for x, y in ((4, 4), (3.1, 0), (0, -3.1)):
        assert hit(scene, (x, y, 0.5), (0, 0, -1)) == (math.inf, GROUND)


def test_the_published_flights_have_a_clear_path(scene):
    """Corners of both flights, x, y, z; above the ground, from which they start."""
    corners = [(0.5, 2.5, 0.3), (0.5, 2.5, 4.0), (0.5, 2.0, 6.0)]
    corners += [(x, 1.5, z) for z in (9.0, 12.0, 15.0) for x in (0.5, 1.0, -1.5, -0.5, 0.5)]
    corners += [(-0.5, 1.5, 15.0), (-0.5, 1.5, 9.0), (-0.5, 2.0, 6.0), (-0.5, 2.5, 0.3)]
    around = [(x, y, z) for z in (0.6, 2.0, 4.0, 6.0, 8.0) for x, y in (*CORNERS * 2.5, CORNERS[0] * 2.5)]
    for way in (np.array(corners), np.array(corners) * [1, -1, 1], np.array(around)):
        points = np.concatenate([np.linspace(a, b, 60) for a, b in itertools.pairwise(way)]).astype(np.float32)
        distance = scene.mesh.compute_distance(points).numpy()
        assert distance.min() > math.hypot(*HALF_BOX_M), points[distance.argmin()]


def test_the_tower_is_one_piece(tower):
    pieces, parts = pieces_of(tower)
    assert parts == 1
    loose = [tower.joints[joint] for joint, degree in enumerate(np.bincount(pieces.ravel())) if degree < 2]
    assert len(loose) == 4  # the brackets below the corners of the platform
    assert min(end[2] for end in loose) > 15.9


def test_members_in_a_face_have_one_flange_in_it_and_one_inwards(tower):
    for axis, member in zip(tower.axes - CENTRE, tower.members, strict=True):
        face = FACES[np.argmax(FACES @ axis.mean(axis=0)[:2])]
        if member.kind != "leg" and np.abs(axis[:, :2] @ face - width_at(axis[:, 2])).max() < 0.02:
            assert np.array(member.flange_b)[:2] @ face < -0.9
            assert abs(np.array(member.flange_a)[:2] @ face) < 0.2


def listed(tmp_path, *rows):
    path = tmp_path / "mine.csv"
    path.write_text("\n".join(["# mine", HEADER, *rows]) + "\n")
    return TowerSettings(members=str(path))


def test_joints_lie_where_members_end_and_cross_but_not_where_they_pass():
    ends = np.array([
        [(0, 0, 0), (0, 0, 2)], [(-1, 0.01, 1), (1, 0.01, 1)],  # cross, 1 cm apart
        [(0, 0, 2), (2, 0, 2)], [(1, 0, 1.995), (1, 0, 0)],  # share an end; ends on another
        [(-1, 0.05, 0.5), (1, 0.05, 0.5)],  # passes at 5 cm
    ], dtype=float)  # fmt: skip
    joints, along = joints_of_members(ends)
    assert [len(on) for on in along] == [3, 3, 3, 3, 2]
    np.testing.assert_allclose(joints[along[0][1]], (0, 0.005, 1))
    assert along[0][-1] == along[2][0]
    np.testing.assert_allclose(joints[along[2][1]], (1, 0, 1.995))
    assert len(joints) == 10


def test_plates_of_a_list_return_light_and_are_no_members(tmp_path):
    """A wall of 2 × 2 m before one leg: returns, light between surfaces and grey levels, but of no member."""
    settings = listed(tmp_path, "leg,2,0,0,2,0,3,,,", "plate,1.5,-1,0,1.5,1,0,1.5,-1,2", "triangle,3,0,0,3,1,0,3,0,2")
    tower = build_tower(settings)
    assert (tower.triangle_member == ON_PLATE).sum() == 3
    assert half_width(settings, 1.0) == 0.0
    T = np.eye(4)
    T[2, 3] = 1.0
    flight = Trajectory(np.arange(51) / 125, np.tile(T, (51, 1, 1)))
    tof = TofSettings(
        columns=24, rows=24, fov_horizontal_rad=1.0, fov_vertical_rad=1.0, sigma_floor_m=0.0, mount_m=(0, 0, 0)
    )
    plain, visibility = scan_flight(tower, flight, tof, 1)
    points = plain[0].points.reshape(-1, 3)
    np.testing.assert_allclose(points[:, 0], 1.5, rtol=1e-5)
    assert visibility.returns.sum() == 0
    faulty = tof.replace(faults=("multipath",))
    np.testing.assert_allclose(scan_flight(tower, flight, faulty, 1)[0].range_m, plain.range_m, rtol=0.05)
    member = np.full(len(points), ON_PLATE)
    assert not seen_members(tower.axes, points, member).visibility.returns.any()
    camera = CameraSettings(columns=80, rows=80, fov_horizontal_rad=0.8, fov_vertical_rad=0.8)
    grey = Camera(tower, camera).render(np.tile(T, (SAMPLES, 1, 1)))
    assert min(grey.std(axis=0).min(), grey.std(axis=1).min()) > 1.0  # no stripes


def test_a_member_may_have_its_own_width(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text(f"{HEADER},width\nleg,0,0,0,0,0,1,,,,0.08\nring,0,0,1,1,0,1,,,,\nplate,0,0,0,1,0,0,0,1,0,\n")
    settings = TowerSettings(members=str(path), sections_m={"leg": (0.1, 0.01), "ring": (0.06, 0.005)})
    assert [member.section_m for member in build_tower(settings).members] == [(0.08, 0.008), (0.06, 0.005)]
    assert build_tower(settings.replace(section="round")).members[0].section_m == (0.08, 0.04)


@pytest.mark.parametrize(
    "text",
    [
        "", "kind,x,y\nleg,0,0\n", HEADER + "\n", f"{HEADER}\nleg,0,0,0,0,0,x,,,\n", f"{HEADER}\nleg,0,0,0,0,0\n",
        f"{HEADER}\nleg,0,0,0,0,0,nan,,,\n", f"{HEADER}\nmast,0,0,0,0,0,1,,,\n", f"{HEADER}\nleg,0,0,0,0,0,0,,,\n",
        f"{HEADER}\nleg,0,0,0,0,0,1,2,,\n", f"{HEADER}\nplate,0,0,0,0,0,1,,,\n",
        f"{HEADER}\nleg,0,0,0,0,0,1\xff".encode("latin-1"), f"{HEADER},width\nleg,0,0,0,0,0,1,,,,0\n",
        f"{HEADER},width\nleg,0,0,0,0,0,1,,,,wide\n", f"{HEADER}\nleg,0,0,0,0,0,1,,,,0.1\n",
        f"{HEADER},width\nplate,0,0,0,1,0,0,0,1,0,0.1\n",
    ],
)  # fmt: skip
def test_a_list_that_cannot_be_read_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "mine.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as refused:
        build_tower(TowerSettings(members=str(path)))
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_list_and_dimensions_beside_a_list_are_refused(tmp_path):
    for members in ("eiffel", str(tmp_path / "none.csv")):
        with pytest.raises(InputError, match="report-tower"):
            build_tower(TowerSettings(members=members))
    with pytest.raises(InputError, match=r"profile_m = .*20\.0"):
        TowerSettings.preset("report").replace(profile_m=((0.0, 4.0), (9.0, 1.7), (20.0, 1.0)))
    with pytest.raises(InputError, match="mine"):
        half_width(listed(tmp_path, "arm,0,0,0,0,0,1,,,"), 1.0)
