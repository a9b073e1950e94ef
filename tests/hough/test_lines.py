import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import config
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.hough import detect_lines, detect_segments, directions, transform
from steelnb.hough.dx import default_dx
from steelnb.hough.lines import MAX_CELLS
from tests import naive

JIT = not config.DISABLE_JIT


def lattice(seed, lines, points, noise_m, clutter=0):
    """Points on random lines in a box of 2 m, and clutter between them."""
    rng = np.random.default_rng(seed)
    pieces = [
        rng.uniform(-1, 1, 3) + np.outer(rng.uniform(-1, 1, points), d / np.linalg.norm(d))
        for d in rng.normal(size=(lines, 3))
    ]
    cloud = np.concatenate(pieces) + rng.normal(scale=noise_m, size=(lines * points, 3))
    return np.concatenate([cloud, rng.uniform(-1, 1, (clutter, 3))])


@pytest.mark.parametrize("granularity", range(7))
def test_directions_cover_the_half_sphere_once(granularity):
    d = directions(granularity)
    assert len(d) == 5 * 4**granularity + 1
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-7)
    assert (d[:, 2] >= 0).all()
    if granularity <= 4:
        apart = np.abs(d @ d.T) - 2 * np.eye(len(d))
        assert apart.max() < 1 - 1e-6  # no two the same, and none the opposite of another
        # Twice the spacing of so many directions on a half sphere, for any direction there is.
        probe = np.random.default_rng(0).normal(size=(500, 3))
        probe /= np.linalg.norm(probe, axis=1)[:, None]
        assert np.arccos(np.clip(np.abs(probe @ d.T).max(axis=1), 0, 1)).max() < 2 * np.sqrt(2 * np.pi / len(d)) / 2


@pytest.mark.kernels
@pytest.mark.parametrize("seed", range(4 if JIT else 1))
@pytest.mark.parametrize("dx", [0.05, 0.15])
def test_lines_are_those_of_the_full_vote_volume(seed, dx):
    points = lattice(seed, lines=4, points=20, noise_m=0.01, clutter=15)
    expected = naive.hough_lines(points, dx, min_votes=3, granularity=2)
    found = detect_lines(points, dx, min_votes=3, granularity=2)
    assert len(found) == len(expected) >= 3
    for k, (anchor, direction, members) in enumerate(expected):
        np.testing.assert_array_equal(np.flatnonzero(found.label == k), members)
        np.testing.assert_allclose(found.anchor[k], anchor, atol=1e-9)
        assert abs(found.direction[k] @ direction) > 1 - 1e-12


@pytest.mark.kernels
@pytest.mark.parametrize("dx", [0.06, 0.3])
def test_a_vote_goes_to_the_first_of_the_strongest_cells(dx):
    # Both ways to search the image: over its cells, and over the points where these are fewer.
    cloud = np.round(lattice(3, lines=2, points=60, noise_m=0.02), 1)
    high = (cloud.max(axis=0) - cloud.min(axis=0)) / 2
    cloud = cloud - cloud.min(axis=0) - high
    half = np.linalg.norm(high)
    columns = int(2 * half / dx + 0.5)
    image, index = np.zeros((columns + 4) ** 2 + transform.BLOCK, np.int32), np.empty(len(cloud), np.int32)
    for b in directions(1):
        found = transform.vote(*np.ascontiguousarray(cloud.T), *b, high, half, 1 / dx, columns, image, index)
        counts = np.bincount(index, minlength=columns**2)[: columns**2]
        assert found == (counts.max(), counts.argmax())


def test_lines_are_those_of_the_published_program():
    # Answers of hough3dlines 1.2 (IPOL 2017), printed to six digits, on clouds made by the same call as here.
    for case in json.loads((Path(__file__).parent / "reference_lines.json").read_text()):
        points = np.round(lattice(**case["cloud"]), 6)
        found = detect_lines(points, case["dx"], case["min_votes"])
        expected = np.array(case["lines"])
        np.testing.assert_array_equal(found.count, expected[:, 6])
        np.testing.assert_allclose(found.anchor, expected[:, :3], atol=1e-6)
        cosine = np.abs((found.direction * expected[:, 3:6]).sum(axis=1)) / np.linalg.norm(expected[:, 3:6], axis=1)
        assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 1e-4


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), shift=st.tuples(*[st.floats(-50, 50)] * 3))
def test_neither_the_order_of_the_points_nor_a_shift_changes_the_lines(seed, shift):
    points = lattice(seed, lines=4, points=40, noise_m=0.01, clutter=30)
    order = np.random.default_rng(seed).permutation(len(points))
    found, other = detect_lines(points, 0.1, 10), detect_lines(points[order] + shift, 0.1, 10)
    np.testing.assert_array_equal(other.label, found.label[order])
    np.testing.assert_allclose(other.anchor - shift, found.anchor, atol=1e-9)
    np.testing.assert_allclose(other.direction, found.direction, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), times=st.integers(2, 6))
def test_points_given_several_times_give_the_same_lines_with_as_many_more_votes(seed, times):
    points = lattice(seed, lines=4, points=40, noise_m=0.01, clutter=30)
    found, other = detect_lines(points, 0.1, 10), detect_lines(np.tile(points, (times, 1)), 0.1, 10 * times)
    np.testing.assert_array_equal(other.count, times * found.count)
    np.testing.assert_array_equal(other.label.reshape(times, -1), np.tile(found.label, (times, 1)))
    np.testing.assert_allclose(other.anchor, found.anchor, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), skip_weak=st.booleans())
def test_lines_partition_the_points(seed, skip_weak):
    points = lattice(seed, lines=5, points=30, noise_m=0.01, clutter=30)
    found = detect_lines(points, 0.1, min_votes=10, skip_weak=skip_weak)
    np.testing.assert_array_equal(np.bincount(found.label + 1, minlength=len(found) + 1)[1:], found.count)
    assert (found.count >= 10).all()
    for k in range(len(found)):
        np.testing.assert_allclose(found.anchor[k], points[found.label == k].mean(axis=0), atol=1e-9)


def test_skipping_weak_lines_finds_what_stopping_misses():
    # A ball of 44 points has all its votes in one cell, more than the noisy bar of 60, and is too weak a line itself.
    rng = np.random.default_rng(1)
    bar = np.outer(rng.uniform(-0.5, 0.5, 60), [0, 0, 1]) + rng.normal(scale=0.015, size=(60, 3)) + [1.5, 0, 0]
    ball = rng.normal(scale=0.001, size=(44, 3)) - [1.5, 0, 0]
    points = np.concatenate([bar, ball])
    assert len(detect_lines(points, 0.05, min_votes=52)) == 0
    skipped = detect_lines(points, 0.05, min_votes=52, skip_weak=True)
    assert len(skipped) == 1
    assert abs(skipped.direction[0, 2]) > 0.999


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000), clutter=st.integers(0, 200), turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-50, 50)] * 3),
)  # fmt: skip
def test_clutter_hides_no_line_of_enough_points_wherever_it_lies(seed, clutter, turn, shift):
    # Lines a metre apart: 200 even points in 8 m³ leave about one within dx of any of them.
    rng, R = np.random.default_rng(seed), Rotation.from_rotvec(turn).as_matrix()
    at, along = np.array([[-0.8, 0, 0], [0.8, 0, -0.5], [0, 0.9, 0]]), np.eye(3)[[2, 1, 0]]
    lines = [a + np.outer(rng.uniform(-1, 1, 80), u) for a, u in zip(at, along, strict=True)]
    points = np.concatenate([*lines, rng.uniform(-1, 1, (clutter, 3))]) + rng.normal(
        scale=0.005, size=(240 + clutter, 3)
    )
    found = detect_lines(points @ R.T + shift, 0.05, min_votes=50)
    assert len(found) == 3
    direction, anchor = found.direction @ R, (found.anchor - shift) @ R
    for a, u in zip(at, along, strict=True):
        k = np.abs(direction @ u).argmax()
        assert abs(direction[k] @ u) > np.cos(np.radians(1.5))
        assert np.linalg.norm(np.cross(anchor[k] - a, u)) < 0.02


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99), n=st.integers(2, 50), value=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_a_value_that_is_not_finite_is_refused_wherever_it_stands(seed, n, value):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points[rng.integers(n), rng.integers(3)] = value
    for find in (detect_lines, detect_segments, default_dx):
        with pytest.raises(InputError, match=f"1 of {n} points not finite"):
            find(points)


@pytest.mark.parametrize(
    ("points", "arguments", "error", "says"),
    [
        (np.zeros((0, 3)), {}, InputError, "0 points"),
        (np.zeros((1, 3)), {}, InputError, "1 point"),
        (np.ones((5, 3)), {}, InputError, "identical"),
        (np.zeros((5, 2)), {}, InputError, "shape"),
        (np.eye(3), {"dx": 0.0}, InputError, "dx = 0"),
        (np.eye(3), {"dx": -1.0}, InputError, "dx = -1"),
        (np.eye(3), {"dx": 5.0}, InputError, "diagonal"),
        (np.eye(3), {"dx": np.nan}, InputError, "dx = nan"),
        (np.eye(3), {"granularity": -1}, InputError, "granularity = -1"),
        (np.eye(3), {"dx": 1e-5}, InputError, "would fit"),
        (np.eye(3), {"granularity": 7}, InputError, "granularity = 7"),
        (np.eye(3), {"min_votes": 1}, InputError, "min_votes = 1"),
        (np.eye(3), {"max_lines": 0}, InputError, "max_lines = 0"),
    ],
)
def test_bad_input_says_what_was_wrong(points, arguments, error, says):
    for find in [detect_lines] if arguments else [detect_lines, detect_segments, default_dx]:
        with pytest.raises(error, match=says):
            find(points, **arguments)


def test_the_dx_that_would_fit_fits():
    points = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(InputError, match="would fit") as refusal:
        detect_lines(points, 1e-300)
    dx = float(str(refusal.value).split("a dx of ")[1].split(" m")[0])
    detect_lines(points, dx, granularity=0)
    half = np.linalg.norm(np.ptp(points, axis=0)) / 2
    assert 0.98 * MAX_CELLS < (2 * half / dx) ** 2 <= MAX_CELLS
    with pytest.raises(InputError, match="would fit"):
        detect_lines(points, 0.98 * dx)


def test_a_point_past_the_last_column_is_dropped():
    # The ends of this cloud lie on the border of the image, where rounding decides whether they are in it.
    points = np.outer([-1.0, 0.0, 0.01, 1.0], [1, 0, 0])
    for columns in range(3, 60):
        for offset in (-1e-15, 0.0, 1e-15):
            assert len(detect_lines(points, 2 / (columns + 0.5 + offset), granularity=1)) == 1
