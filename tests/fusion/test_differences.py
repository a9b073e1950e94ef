"""Differences of made-up structures whose differences are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.fusion import Structure
from steelnb.fusion.differences import compare_structures as compare
from steelnb.fusion.differences import deviation
from steelnb.settings import Tolerance
from steelnb.types import Segments
from tests.fusion.made import changed, ladder, random_bars, rigid
from tests.fusion.made import structure_of_bars as made

EXACT = Tolerance(offset_m=0.0, angle_deg=0.0, end_m=0.0, joint_m=0.0)


def shuffled(structure: Structure, seed: int) -> tuple[Structure, np.ndarray, np.ndarray]:
    """The same structure with bars and joints in another order and every other bar the other way round; and where
    each bar and each joint went."""
    rng, s = np.random.default_rng(seed), structure.segments
    bar, joint = rng.permutation(len(structure)), rng.permutation(len(structure.joint))
    turned = rng.random(len(bar))[:, None] < 0.5
    start, end = s.start[bar], s.end[bar]
    segments = Segments(np.where(turned, end, start), np.where(turned, start, end), s.count[bar], s.radius[bar])
    bar_to, joint_to = np.argsort(bar), np.argsort(joint)
    tie = np.stack([joint_to[structure.tie[:, 0]], bar_to[structure.tie[:, 1]]], axis=1)
    each = {name: getattr(structure, name)[bar] for name in ("width_m", "sightings", "sigma_m")}
    other = Structure(segments=segments, joint=structure.joint[joint], tie=rng.permutation(tie), **each)
    return other, bar_to, joint_to


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_neither_order_nor_sense_matters(seed: int) -> None:
    other, bar_to, joint_to = shuffled(ladder(), seed)
    found = compare(ladder(), other, EXACT)
    assert found.equal
    np.testing.assert_array_equal(found.bar, np.column_stack([np.arange(8), bar_to]))
    np.testing.assert_array_equal(found.joint, np.column_stack([np.arange(12), joint_to]))
    np.testing.assert_allclose(found.deviation.end_m, 0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_deviations_do_not_depend_on_the_frame_nor_on_the_sense_of_bars(seed: int) -> None:
    a = random_bars(seed, 8)
    noise = np.random.default_rng(seed).normal(scale=0.05, size=(2, 8, 3))
    b = Segments(a.start + noise[0], a.end + noise[1], a.count, a.radius)
    off, T = deviation(a, b), rigid(seed)
    swapped = Segments(b.end, b.start, b.count, b.radius)
    for other in (deviation(a.transformed(T), b.transformed(T)), deviation(a, swapped)):
        for name, value in vars(off).items():
            np.testing.assert_allclose(getattr(other, name), value, atol=1e-6)
    largest = np.linalg.norm(noise, axis=2).max(axis=0)
    np.testing.assert_allclose(off.end_m, largest)  # the ends are paired as they were made
    assert (off.offset_m <= largest + 1e-9).all()


@pytest.mark.parametrize("seed", range(3))
def test_what_was_done_is_found(seed: int) -> None:
    """Rung 3 is gone, a brace is new, rung 5 is 5 cm to the side, a post has lost 20 cm, a joint is 4 cm higher."""
    whole = changed(changed(ladder(), 5, (0, 0.05, 0), (0, 0.05, 0)), 1, end=(0, 0, -0.2))
    joint = whole.joint.copy()
    joint[4] += [0, 0, 0.04]
    s = whole.segments
    bars = np.delete(np.stack([s.start, s.end], axis=1), 3, axis=0)
    bars = np.concatenate([bars, [[[0, 0, 0], [1, 0, 0.5]]]])
    tie = whole.tie[whole.tie[:, 1] != 3]
    tie[:, 1] -= tie[:, 1] > 3
    other, bar_to, joint_to = shuffled(made(bars, joint, tie), seed)
    found = compare(ladder(), other)
    assert not found.equal
    assert found.bar_missing.tolist() == [3]
    assert found.bar_extra.tolist() == [bar_to[7]]
    moved = dict(zip(found.bar[found.bar_moved, 0].tolist(), np.flatnonzero(found.bar_moved), strict=True))
    assert set(moved) == {1, 5}
    assert found.deviation.offset_m[moved[5]] == pytest.approx(0.05)
    assert found.deviation.end_m[moved[5]] == pytest.approx(0.05)
    assert found.deviation.angle_deg[moved[5]] == pytest.approx(0, abs=1e-6)
    assert found.deviation.offset_m[moved[1]] == pytest.approx(0, abs=1e-12)
    assert found.deviation.end_m[moved[1]] == pytest.approx(0.2)
    assert found.joint[found.joint_moved].tolist() == [[4, joint_to[4]]]
    assert found.joint_distance_m[found.joint_moved] == pytest.approx(0.04)
    # The missing rung is in no pair, so that its joints are not tied otherwise.
    assert not found.joint_retied.any()
    assert len(found.joint_missing) == len(found.joint_extra) == 0


def test_a_joint_that_ties_another_bar() -> None:
    tie = ladder().tie.copy()
    tie[1] = [0, 3]  # the first joint ties the second rung now
    found = compare(ladder(), replace(ladder(), tie=tie))
    assert np.flatnonzero(found.joint_retied).tolist() == [0]
    assert not found.equal


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_missing_and_extra_change_places_when_the_structures_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    keep = [np.flatnonzero(rng.random(8) < 0.7) for _ in range(2)]
    s = ladder().segments
    axes = np.stack([s.start, s.end], axis=1)
    a, b = (made(axes[some], axes[some, 0], np.column_stack([np.arange(len(some))] * 2)) for some in keep)
    there, back = compare(a, b), compare(b, a)
    assert keep[0][there.bar_missing].tolist() == np.setdiff1d(*keep).tolist()
    assert keep[1][there.bar_extra].tolist() == np.setdiff1d(*keep[::-1]).tolist()
    assert there.bar_missing.tolist() == back.bar_extra.tolist()
    assert there.joint_missing.tolist() == back.joint_extra.tolist()
    assert there.equal == (keep[0].tolist() == keep[1].tolist())


def test_deviation_of_a_turned_bar() -> None:
    """A bar of 2 m, turned by 3° about its middle and 7 cm to the side; then the same with its ends swapped."""
    angle = np.radians(3)
    reach = np.array([np.cos(angle), np.sin(angle), 0])
    side = np.array([0, 0, 0.07])
    for sign in (1, -1):
        off = deviation(
            made([[[-1, 0, 0], [1, 0, 0]]]).segments, made([[side - sign * reach, side + sign * reach]]).segments
        )
        assert off.angle_deg == pytest.approx(3)
        assert off.offset_m == pytest.approx(0.07)
        assert off.end_m == pytest.approx(np.hypot(2 * np.sin(angle / 2), 0.07))
        assert off.overlap == pytest.approx(np.cos(angle))


def test_the_offset_is_taken_where_both_are() -> None:
    """A bar that leans away by 2° beyond the end of the other one: where they lie side by side, they are 1 cm apart."""
    slope = np.tan(np.radians(2))
    a = made([[[0, 0, 0], [2, 0, 0]]]).segments
    b = made([[[0, 0.01 - slope, 0], [4, 0.01 + 3 * slope, 0]]]).segments
    off = deviation(a, b)
    assert off.offset_m == pytest.approx(0.01)
    assert off.overlap == pytest.approx(0.5, abs=1e-3)


def test_an_exact_match_is_not_given_up_for_two_poor_ones() -> None:
    """Parallel bars at 0 and 20 cm, then at 20 and 40 cm: the one at 20 cm is there in both."""
    a, b = (made([[[0, y, 0], [3, y, 0]] for y in ys]) for ys in ((0.0, 0.2), (0.2, 0.4)))
    found = compare(a, b)
    assert found.bar.tolist() == [[1, 0]]
    assert (found.bar_missing.tolist(), found.bar_extra.tolist()) == ([0], [1])


def test_beyond_the_limits_a_bar_and_a_joint_is_another_one() -> None:
    bar = [[0, 0, 0], [2, 0, 0]]
    for offset, pairs in ((0.29, 1), (0.31, 0)):
        found = compare(made([bar]), made([np.add(bar, [0, offset, 0])]))
        assert (len(found.bar), len(found.bar_missing), len(found.bar_extra)) == (pairs, 1 - pairs, 1 - pairs)
        found = compare(made([bar], [[0, 0, 0]], [[0, 0]]), made([bar], [[0, 0, offset]], [[0, 0]]))
        assert (len(found.joint), len(found.joint_missing), len(found.joint_extra)) == (pairs, 1 - pairs, 1 - pairs)
    for share, pairs in ((0.52, 1), (0.48, 0)):  # half of the longer
        assert len(compare(made([bar]), made([[[0, 0, 0], [2 * share, 0, 0]]])).bar) == pairs
    for angle, pairs in ((9.5, 1), (10.5, 0)):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        assert len(compare(made([bar]), made([[[1 - c, -s, 0], [1 + c, s, 0]]])).bar) == pairs


@pytest.mark.parametrize(
    ("step", "tolerance"),
    [
        ({"start": (0, 0.011, 0), "end": (0, 0.011, 0)}, {"offset_m": 0.012}),
        ({"start": (0.031, 0, 0)}, {"end_m": 0.032}),
        ({"start": (0, 0.0095, 0), "end": (0, -0.0095, 0)}, {"angle_deg": 1.2}),
    ],
)
def test_each_tolerance_decides_by_itself(step: dict, tolerance: dict) -> None:
    a = made([[[0, 0, 0], [1, 0, 0]]])
    b = changed(a, 0, **step)
    assert not compare(a, b).equal
    assert compare(a, b, Tolerance(**tolerance)).equal


def test_large_coordinates_lose_nothing() -> None:
    far = np.array([299100.0, 2801400.0, 1900.0])
    s = ladder().segments
    away = made(np.stack([s.start + far, s.end + far], axis=1), ladder().joint + far, ladder().tie)
    found = compare(away, changed(away, 4, (0, 0.02, 0), (0, 0.02, 0)))
    assert found.deviation.offset_m[4] == pytest.approx(0.02, abs=1e-8)
    assert np.flatnonzero(found.bar_moved).tolist() == [4]


def test_an_empty_structure_misses_all() -> None:
    assert compare(Structure.empty(), Structure.empty()).equal
    found = compare(Structure.empty(), ladder())
    assert (len(found.bar), len(found.bar_extra), len(found.joint_extra)) == (0, 8, 12)
