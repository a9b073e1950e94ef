import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.errors import DegenerateCloudError, SettingsError
from steelnb.registration import align, closed_form, make_target
from tests.registration.scenes import apart, motion, moved, room


@pytest.mark.parametrize("turn_deg", [0, 30, 179.9])
def test_it_finds_a_known_motion_and_scipys_rotation_under_noise(turn_deg):
    here, T_true = room(50, 1), motion(turn_deg, 3.0)
    np.testing.assert_allclose(closed_form(here, moved(here, T_true)), T_true, atol=1e-10)
    there = moved(here, T_true) + 0.1 * np.random.default_rng(2).normal(size=here.shape)
    rotation, _ = Rotation.align_vectors(there - there.mean(axis=0), here - here.mean(axis=0))
    result = closed_form(here, there)
    np.testing.assert_allclose(result[:3, :3], rotation.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(moved(here, result).mean(axis=0), there.mean(axis=0), atol=1e-12)


def test_it_is_where_the_iterative_solver_ends_with_the_same_pairs():
    here = room(300, 1)
    there = moved(here, motion(2, 0.05)) + 0.02 * np.random.default_rng(2).normal(size=here.shape)
    target = make_target(there, "point")
    result = align(here, target, "point", np.eye(6), np.eye(4), 0.5, None, "none", 1.0, 100, 1e-12, 1e-12)
    pairs = target.pairs(here, 0.5)
    pairs.update(result.T_target_source)
    kept = pairs.match >= 0
    assert np.less(apart(closed_form(here[kept], target.point[pairs.match[kept]]), result.T_target_source), 1e-8).all()


@pytest.mark.parametrize("seed", range(5))
def test_it_never_mirrors(seed):
    # Flat clouds under noise are where U Vᵀ turns into a reflection.
    rng = np.random.default_rng(seed)
    flat = rng.normal(size=(4, 3)) * [1, 1, 1e-3]
    result = closed_form(flat, flat * [1, 1, -1] + 1e-4 * rng.normal(size=(4, 3)))
    assert np.linalg.det(result[:3, :3]) == pytest.approx(1)
    assert np.abs(result[:3, :3] - np.eye(3)).max() < 0.01


def test_pairs_that_determine_nothing_are_refused():
    line = np.outer(np.arange(5.0), [1, 2, 3])
    with pytest.raises(DegenerateCloudError, match="one line"):
        closed_form(line, line)
    with pytest.raises(DegenerateCloudError, match="one line"):
        closed_form(np.ones((4, 3)), np.ones((4, 3)))
    with pytest.raises(DegenerateCloudError, match="2 pairs"):
        closed_form(np.eye(3)[:2], np.eye(3)[:2])
    with pytest.raises(SettingsError, match="paired"):
        closed_form(np.eye(3), np.zeros((4, 3)))
    with pytest.raises(SettingsError, match="finite"):
        closed_form(np.eye(3), np.full((3, 3), np.nan))
