import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import config

from steelnb.core.errors import InputError
from steelnb.hough import detect_lines, detect_segments, directions
from steelnb.hough.lines import MAX_CELLS, default_dx
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


@pytest.mark.parametrize("granularity", [0, 1, 4, 5])
def test_directions_cover_the_half_sphere_once(granularity):
    d = directions(granularity)
    assert len(d) == 5 * 4**granularity + 1
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-7)
    assert (d[:, 2] >= 0).all()
    if granularity <= 4:
        cosine = np.abs(d @ d.T) - 2 * np.eye(len(d))
        assert cosine.max() < 1 - 1e-6  # no two equal or opposite
        # Every direction has a neighbour within the spacing of so many directions on a half sphere.
        probe = np.random.default_rng(0).normal(size=(500, 3))
        probe /= np.linalg.norm(probe, axis=1)[:, None]
        assert np.arccos(np.clip(np.abs(probe @ d.T).max(axis=1), 0, 1)).max() < 2 * np.sqrt(2 * np.pi / len(d)) / 2


@pytest.mark.kernels
@pytest.mark.parametrize("seed", range(2 if JIT else 1))
@pytest.mark.parametrize("dx", [0.05, 0.15])
def test_lines_equal_those_of_a_full_vote_volume(seed, dx):
    points = lattice(seed, lines=4, points=20, noise_m=0.01, clutter=15)
    expected = naive.hough_lines(points, dx, min_votes=3, granularity=2)
    found = detect_lines(points, dx, min_votes=3, granularity=2)
    assert len(found) == len(expected) >= 3
    for k, (anchor, direction, members) in enumerate(expected):
        np.testing.assert_array_equal(np.flatnonzero(found.label == k), members)
        np.testing.assert_allclose(found.anchor[k], anchor, atol=1e-9)
        assert abs(found.direction[k] @ direction) > 1 - 1e-12


def test_lines_equal_those_of_the_published_program():
    # Output of hough3dlines 1.2 (IPOL 2017), printed to six digits, on clouds of the same `lattice` calls.
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
def test_lines_do_not_depend_on_the_order_of_the_points_or_on_a_shift(seed, shift):
    points = lattice(seed, lines=4, points=40, noise_m=0.01, clutter=30)
    order = np.random.default_rng(seed).permutation(len(points))
    found, other = detect_lines(points, 0.1, 10), detect_lines(points[order] + shift, 0.1, 10)
    np.testing.assert_array_equal(other.label, found.label[order])
    np.testing.assert_allclose(other.anchor - shift, found.anchor, atol=1e-9)
    np.testing.assert_allclose(other.direction, found.direction, atol=1e-9)


def test_skip_weak_finds_a_line_behind_a_weak_one():
    # The ball has 44 votes in one cell, more than any cell of the noisy bar of 60 points, but below min_votes.
    rng = np.random.default_rng(1)
    bar = np.outer(rng.uniform(-0.5, 0.5, 60), [0, 0, 1]) + rng.normal(scale=0.015, size=(60, 3)) + [1.5, 0, 0]
    ball = rng.normal(scale=0.001, size=(44, 3)) - [1.5, 0, 0]
    points = np.concatenate([bar, ball])
    assert len(detect_lines(points, 0.05, min_votes=52)) == 0
    skipped = detect_lines(points, 0.05, min_votes=52, skip_weak=True)
    assert len(skipped) == 1
    assert abs(skipped.direction[0, 2]) > 0.999


@pytest.mark.parametrize(
    ("points", "arguments", "message"),
    [
        (np.zeros((0, 3)), {}, "two distinct"),
        (np.ones((5, 3)), {}, "two distinct"),
        (np.diag([1, 2, np.nan]), {}, "not finite"),
        (np.eye(3), {"dx": 0.0}, "dx"),
        (np.eye(3), {"dx": 5.0}, "dx"),
        (np.eye(3), {"min_votes": 1}, "min_votes"),
    ],
)
def test_invalid_input_is_named_in_the_error(points, arguments, message):
    for find in [detect_lines] if arguments else [detect_lines, detect_segments, default_dx]:
        with pytest.raises(InputError, match=message):
            find(points, **arguments)


def test_the_smallest_dx_named_by_the_error_is_accepted():
    points = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(InputError, match="vote image") as refusal:
        detect_lines(points, 1e-300)
    dx = float(str(refusal.value).split("at least ")[1].split(" m")[0])
    detect_lines(points, dx, granularity=0)
    half = np.linalg.norm(np.ptp(points, axis=0)) / 2
    assert 0.98 * MAX_CELLS < (2 * half / dx) ** 2 <= MAX_CELLS
    with pytest.raises(InputError, match="vote image"):
        detect_lines(points, 0.98 * dx)


def test_a_point_past_the_last_column_is_dropped():
    # The ends of this cloud are on the border of the image, so rounding decides whether they are inside.
    points = np.outer([-1.0, 0.0, 0.01, 1.0], [1, 0, 0])
    for columns in range(3, 60):
        for offset in (-1e-15, 0.0, 1e-15):
            assert len(detect_lines(points, 2 / (columns + 0.5 + offset), granularity=1)) == 1
