"""NEES and coverage of made-up errors whose covariances are known, and the conventions of errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb.errors import InputError
from steelnb.fusion.sections import frames
from steelnb.metrics import axis_errors, coverage, nees, pose_errors
from steelnb.types import Trajectory
from tests.fusion.made import bars_of, rigid


def test_errors_of_the_stated_covariance_have_nees_of_their_dimension():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20_000, 4, 4))
    covariance = root @ root.transpose(0, 2, 1)
    error = (root @ rng.normal(size=(20_000, 4, 1)))[:, :, 0]
    squared = nees(error, covariance)
    assert squared.mean() == pytest.approx(4.0, rel=0.03)
    assert coverage(squared, 4) == pytest.approx(0.95, abs=0.006)
    assert coverage(squared * 4, 4) < 0.6  # half the standard deviation stated
    assert coverage(squared, 4, 0.5) == pytest.approx(0.5, abs=0.015)


def test_a_covariance_without_an_inverse_is_refused():
    covariance = np.tile(np.eye(3), (2, 1, 1))
    covariance[1, 2, 2] = 0.0
    with pytest.raises(InputError, match=r"error 1 is not positive definite along 1\.00 component 2"):
        nees(np.ones((2, 3)), covariance)


@pytest.mark.parametrize("shape", [(2, 3), (2, 4, 4), (3, 3, 3)])
def test_shapes_that_do_not_fit_are_refused(shape):
    with pytest.raises(InputError, match=r"expected \(N, D, D\)"):
        nees(np.ones((2, 3)), np.ones(shape))


def test_pose_errors_bring_the_estimate_to_the_truth():
    found = np.stack([rigid(seed) for seed in range(5)])
    delta = 0.1 * np.random.default_rng(1).normal(size=(5, 6))
    true = found.copy()
    true[:, :3, 3] += delta[:, :3]
    true[:, :3, :3] = Rotation.from_rotvec(delta[:, 3:]).as_matrix() @ found[:, :3, :3]
    stamp_s = np.arange(5.0)
    np.testing.assert_allclose(pose_errors(Trajectory(stamp_s, found), Trajectory(stamp_s, true)), delta, atol=1e-9)


@pytest.mark.parametrize("swapped", [False, True])
def test_axis_errors_are_place_and_slope_in_the_segment_s_frame(swapped):
    segments = bars_of([[1, 2, 3], [2, 4, 5]])
    across, u = frames(segments.direction)[0], segments.direction[0]
    middle, tilted = segments.middle[0] + [0.01, -0.02] @ across, u + [0.03, 0.04] @ across
    axis = np.array([middle - 2 * tilted, middle + 5 * tilted])
    found = axis_errors(segments, axis[None, ::-1] if swapped else axis[None])
    np.testing.assert_allclose(found, [[0.01, -0.02, 0.03, 0.04]], atol=1e-12)
