import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.core.types import Segments
from steelnb.hough.near_segments import within
from steelnb.hough.whole_structure import segment_structure
from steelnb.points import voxel_grid
from tests.hough.made import ends_off_m


def frame(seed, noise_m=0.01):
    """Voxel-filtered points of the twelve edges of a box of 3 m in a random pose, and the ends of the edges."""
    rng = np.random.default_rng(seed)
    corners = np.array(np.meshgrid([0, 3.0], [0, 3.0], [0, 3.0])).reshape(3, -1).T
    pairs = [(a, b) for a in corners for b in corners if np.abs(a - b).sum() == 3 and tuple(a) < tuple(b)]
    points = np.concatenate([a + rng.uniform(size=(700, 1)) * (b - a) for a, b in pairs])
    R, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.uniform(-50, 50, 3)
    points = points + rng.normal(scale=noise_m, size=points.shape)
    return voxel_grid(points @ R.T + shift, 0.05), np.array(pairs) @ R.T + shift


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_bars_of_a_frame_are_found_in_any_pose_and_order_of_points(seed):
    points, edges = frame(seed)
    found = segment_structure(points, 0.08)
    assert len(found) == 12
    assert ends_off_m(found, edges).max() < 0.25
    assert within(points, found, 0.08).mean() > 0.97
    again = segment_structure(points[np.random.default_rng(seed).permutation(len(points))], 0.08)
    np.testing.assert_allclose(again.start, found.start, atol=1e-9)


@pytest.mark.kernels
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), distance=st.floats(0.01, 2.0), bars=st.integers(0, 6))
def test_within_equals_its_slow_twin(seed, distance, bars):
    rng = np.random.default_rng(seed)
    points, start, end = rng.uniform(-2, 2, (200, 3)), *rng.uniform(-2, 2, (2, bars, 3))
    expected = np.zeros(200, dtype=bool)
    for a, b in zip(start, end, strict=True):
        t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        expected |= np.linalg.norm(points - a - t[:, None] * (b - a), axis=1) <= distance
    segments = Segments(start, end, np.full(bars, 10), np.full(bars, 0.01))
    np.testing.assert_array_equal(within(points, segments, distance), expected)
