"""Standard deviations of a structure's bars and joints from the axes of a smoothed flight."""

import numpy as np
import pytest
from steelnb.report.recording_files import with_sigma

from steelnb.fusion.structure import Structure
from steelnb.types import Estimate, Trajectory
from tests.fusion.made import bars_of

ENDS = [[-1, 0, 0], [1, 0, 0]], [[0, -1, 0], [0, 1, 0]], [[0, 0, 0], [0, 0, 2]], [[0, 0.05, 0], [0, 0.05, 2]]


def built(tie: list[list[int]]) -> Structure:
    n = len(ENDS)
    joints = max(joint for joint, _ in tie) + 1
    return Structure(
        bars_of(*ENDS), np.full(n, 0.1), np.full(n, 9), np.full(n, 0.004), np.zeros((joints, 3)), np.array(tie)
    )


def smoothed(sigma_m: float, bars: int) -> Estimate:
    """Axes of the first bars, each with the same σ all along, and poses with 3 mm an axis."""
    path = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    return Estimate(
        prior=path, corrected=path, points=np.zeros((0, 3)), segments=bars_of(*ENDS[:bars]), matches=np.zeros(3, int),
        reason=("",) * 3, seconds={}, update_s=np.zeros(3), pose_covariance=np.tile(9e-6 * np.eye(6), (3, 1, 1)),
        axis_covariance=np.tile(np.diag([sigma_m**2, sigma_m**2, 1e-16, 1e-16]), (bars, 1, 1)),
    )  # fmt: skip


def test_a_joint_of_three_bars_across_has_their_sigma_and_what_they_may_have_in_common():
    found = with_sigma(built([[0, 0], [0, 1], [0, 2]]), smoothed(0.002, 4))
    np.testing.assert_allclose(found.sigma_m, 0.002, rtol=1e-6)
    np.testing.assert_allclose(found.joint_sigma_m, [0.002 * 1.5**0.5], rtol=1e-6)  # as of three errors alike


def test_a_bar_on_no_axis_has_the_sigma_of_its_fit_and_of_the_poses():
    found = with_sigma(built([[0, 1], [0, 2]]), smoothed(0.002, 2))
    np.testing.assert_allclose(found.sigma_m, [0.002, 0.002, 0.005, 0.005], rtol=1e-6)
    assert found.joint_sigma_m[0] > 0.005


def test_a_joint_of_parallel_bars_has_none():
    found = with_sigma(built([[0, 0], [0, 1], [1, 2], [1, 3]]), smoothed(0.002, 4))
    assert np.isfinite(found.joint_sigma_m[0])
    assert np.isnan(found.joint_sigma_m[1])


def test_without_covariances_the_structure_stays():
    estimate = smoothed(0.002, 4)
    structure = built([[0, 0], [0, 1]])
    object.__setattr__(estimate, "axis_covariance", None)
    assert with_sigma(structure, estimate) is structure
    assert structure.joint_sigma_m is None


@pytest.mark.parametrize("along_m", [0.0, 0.5])
def test_sigma_is_that_where_the_bar_is(along_m):
    """A bar whose middle is off that of the axis: the error of the direction counts there."""
    estimate = smoothed(0.002, 4)
    object.__setattr__(estimate, "axis_covariance", np.tile(np.diag([4e-6, 4e-6, 1e-4, 1e-4]), (4, 1, 1)))
    ends = [np.add(ENDS[0], [along_m, 0, 0]).tolist(), *ENDS[1:]]
    structure = built([[0, 0], [0, 1]])
    object.__setattr__(structure, "segments", bars_of(*ends))
    assert with_sigma(structure, estimate).sigma_m[0] == pytest.approx(np.hypot(0.002, 0.01 * along_m))
