import numpy as np
import pytest

from steelnb.hough import alternatives
from steelnb.hough.alternatives import FINDERS, find_bars_by
from tests.hough.made import ends_off_m, strip

BARS = np.array([([0, 0, 0], [0, 0, 2]), ([1, 0, 0.2], [1.5, 1, 1.4]), ([-1, 0.5, 0], [-1, 1.9, 0.3])], dtype=float)
OPTIONS = {"gmm": {"components": [2, 3, 6], "sample": 900}}
EXACT = [name for name in FINDERS if name != "ransac-planes"]


def cloud(bars=BARS, points=300, noise_m=0.01, clutter=0, seed=0):
    rng = np.random.default_rng(seed)
    pieces = [strip(*bar, points, noise_m, seed=rng) for bar in bars]
    return np.concatenate([*pieces, rng.uniform(-1, 2, (clutter, 3))])


@pytest.mark.parametrize("method", EXACT)
def test_separate_bars_and_their_ends_are_found(method):
    found = find_bars_by(method, cloud(), dx=0.05, **OPTIONS.get(method, {}))
    assert len(found) == 3
    assert ends_off_m(found, BARS).max() < 0.04
    assert (found.count >= 290).all()
    np.testing.assert_allclose(found.radius, 0.01 * np.sqrt(2), rtol=0.15)


@pytest.mark.parametrize("method", ["hough", "ransac-lines"])
def test_clutter_makes_no_bar(method):
    found = find_bars_by(method, cloud(clutter=150), dx=0.05)
    assert len(found) == 3
    assert len(find_bars_by(method, np.random.default_rng(1).uniform(-1, 1, (300, 3)), dx=0.05)) == 0


def test_bars_that_share_a_plane_or_cross_are_told_apart_by_lines_and_a_plane_holds_one():
    parallel = cloud(np.array([([x, 0, 0], [x, 0, 2]) for x in (0, 0.5, 1, 1.5)], dtype=float))
    cross = cloud(np.array([([-1, 0, 0], [1, 0, 0]), ([0, 0, -1], [0, 0, 1])], dtype=float), points=1500)
    for method in ("hough", "ransac-lines"):
        assert len(find_bars_by(method, parallel, dx=0.05)) == 4
        assert len(find_bars_by(method, cross, dx=0.05)) == 2
    assert len(find_bars_by("ransac-planes", cloud(BARS[:1]), dx=0.05)) == 1


@pytest.mark.parametrize("method", FINDERS)
def test_a_seed_gives_the_same_bars(method):
    points = cloud(clutter=100)
    before = points.copy()
    once, again = (find_bars_by(method, points, seed=3, **OPTIONS.get(method, {})) for _ in range(2))
    for name in ("start", "end", "count", "radius"):
        np.testing.assert_array_equal(getattr(once, name), getattr(again, name))
    np.testing.assert_array_equal(points, before)


def test_gmm_selects_the_number_of_components():
    points = cloud(noise_m=0.02)
    picked = find_bars_by("gmm", points, components=[3, 40], sample=900)
    np.testing.assert_array_equal(picked.start, find_bars_by("gmm", points, components=[3], sample=900).start)


@pytest.mark.parametrize("method", EXACT)
def test_short_bars_and_bars_of_few_points_are_dropped(method, monkeypatch):
    options = {"dx": 0.05, **OPTIONS.get(method, {})}
    assert len(find_bars_by(method, cloud(), points_min=400, **options)) == 0
    monkeypatch.setattr(alternatives, "LENGTH_MIN_M", 1.45)
    assert len(find_bars_by(method, cloud(), **options)) == 2
