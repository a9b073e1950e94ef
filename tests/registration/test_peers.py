"""small_gicp and Open3D find the same pose with the same clouds, distance and stopping rule."""

import numpy as np
import open3d as o3d
import pytest

from steelnb.registration import register
from tests.registration.scenes import corner, motion, pose_error, transformed

T_START = motion(2, 0.06, seed=4)
TIGHT = {"rotation_epsilon_rad": 1e-6, "translation_epsilon_m": 1e-6}


def scan_pair():
    """Two noisy samples of the corner with 80 % overlap, in different poses."""
    here, there = corner(3000, 1, 0.01), corner(3000, 2, 0.01)
    return here[here[:, 0] < 3.2], transformed(there[there[:, 0] > 0.8], motion(3, 0.1))


@pytest.mark.parametrize(("method", "theirs"), [("icp", "ICP"), ("gicp", "GICP")])
def test_small_gicp_finds_the_same_pose(method, theirs):
    small_gicp = pytest.importorskip("small_gicp")
    here, there = scan_pair()
    source, target = small_gicp.PointCloud(here), small_gicp.PointCloud(there)
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_covariances(target, tree, 20)
    small_gicp.estimate_covariances(source, small_gicp.KdTree(source), 20)
    answer = small_gicp.align(
        target, source, tree, T_START, registration_type=theirs, max_correspondence_distance=0.5, max_iterations=100,
        rotation_epsilon=1e-6, translation_epsilon=1e-6,
    )  # fmt: skip
    ours = register(here, there, method, T_init=T_START, max_correspondence_m=0.5, iterations_max=100, **TIGHT)
    assert answer.converged
    assert ours.converged
    assert np.less(pose_error(ours.T_target_source, answer.T_target_source), (1e-3, 0.02)).all()
    assert ours.inliers == pytest.approx(answer.num_inliers, abs=3)


@pytest.mark.parametrize("method", ["icp", "plane", "gicp"])
def test_open3d_finds_the_same_pose(method):
    here, there = scan_pair()
    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (here, there))
    pipeline = o3d.pipelines.registration
    estimation = {
        "icp": pipeline.TransformationEstimationPointToPoint,
        "plane": pipeline.TransformationEstimationPointToPlane,
        "gicp": pipeline.TransformationEstimationForGeneralizedICP,
    }[method]()
    for cloud in (source, target):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))  # its GICP computes covariances from normals
    criteria = pipeline.ICPConvergenceCriteria(1e-9, 1e-9, 200)
    call = pipeline.registration_generalized_icp if method == "gicp" else pipeline.registration_icp
    answer = call(source, target, 0.5, T_START, estimation, criteria)
    ours = register(here, there, method, T_init=T_START, max_correspondence_m=0.5, iterations_max=200, **TIGHT)
    assert np.less(pose_error(ours.T_target_source, answer.transformation), (1e-3, 0.02)).all()
    assert ours.inliers == pytest.approx(answer.fitness * len(here), abs=3)
