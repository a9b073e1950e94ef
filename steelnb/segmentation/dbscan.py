"""Bars by DBSCAN (Open3D): Ester et al., "A Density-Based Algorithm for Discovering Clusters", KDD 1996, 226–231."""

import os

import numpy as np

from steelnb.config import SegmentationSettings
from steelnb.datatypes import Array, Segments
from steelnb.errors import SettingsError
from steelnb.segmentation.bars import bars_of_groups, prepared, refine


def segment_by_dbscan(
    points: Array,
    settings: SegmentationSettings | None = None,
    seed: int = 0,
    dx: float | None = None,
    neighbours_min: int = 10,
) -> Segments:
    """Clusters of points with at least ``neighbours_min`` others within ``dx``, and the principal axis of each.

    ``dx`` is chosen from the points by default. Nothing here is random: ``seed`` is only there to be called like the
    other methods.
    """
    points, settings, dx = prepared(points, settings, dx)
    if neighbours_min < 1:
        raise SettingsError(f"neighbours_min = {neighbours_min}: expected at least 1")
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=dx, min_points=neighbours_min), dtype=np.int64)
    return refine(points, bars_of_groups(points, label, settings), dx, settings)
