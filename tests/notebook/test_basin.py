import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.notebook.basin import START, icp_steps
from steelnb.registration import register


def corner(seed=0, n=400):
    """Points on three walls of 2 m."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, 2, (n, 3))
    points[np.arange(n), random.integers(0, 3, n)] = 0.0
    return points


def test_the_steps_pair_centre_and_turn_as_the_report_says():
    target = corner()
    first, centred, turned, last = icp_steps(transform_points(START, target), target, 0.5).values()
    gap = np.linalg.norm(first.matched - first.source[first.paired], axis=1)
    others = np.linalg.norm(first.source[first.paired][:, None] - target, axis=2)
    np.testing.assert_allclose(gap, others.min(axis=1))
    assert gap.max() <= 0.5
    np.testing.assert_allclose(centred.source[first.paired].mean(axis=0), first.matched.mean(axis=0))
    assert np.ptp(centred.source - first.source, axis=0).max() < 1e-12, "a translation only"
    errors = [((step.source[first.paired] - first.matched) ** 2).sum() for step in (first, centred, turned)]
    assert errors[0] > errors[1] > errors[2]
    np.testing.assert_allclose(last.source, target, atol=1e-6)


def test_the_end_is_where_the_registration_of_the_package_ends():
    target, source = corner(), transform_points(START, corner())
    *_, last = icp_steps(source, target, 0.5, rounds=200).values()
    found = register(source, target, "icp", max_correspondence_m=0.5)
    np.testing.assert_allclose(transform_points(found.T_target_source, source), last.source, atol=1e-3)


def test_clouds_apart_have_no_pair():
    with pytest.raises(InputError, match=r"no pair within 0\.5 m"):
        icp_steps(corner() + 10, corner(), 0.5)
