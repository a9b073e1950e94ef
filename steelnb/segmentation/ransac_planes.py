"""Bars by RANSAC planes (Open3D), as the report tried them: the principal axis of each plane's points."""

import os

import numpy as np

from steelnb.config import SegmentationSettings
from steelnb.datatypes import Array, Segments
from steelnb.errors import SettingsError
from steelnb.rng import stream
from steelnb.segmentation.bars import bars_of_groups, prepared, refine


def segment_by_ransac_planes(
    points: Array,
    settings: SegmentationSettings | None = None,
    seed: int = 0,
    dx: float | None = None,
    trials: int = 500,
    planes_max: int = 30,
) -> Segments:
    """The plane with most points within ``dx``, its points taken out, again, up to ``planes_max`` times.

    ``trials`` are the planes tried each time. ``dx`` is chosen from the points by default.
    """
    points, settings, dx = prepared(points, settings, dx)
    if trials < 1 or planes_max < 1:
        raise SettingsError(f"trials = {trials}, planes_max = {planes_max}: expected at least 1 each")
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    import open3d

    open3d.utility.random.seed(int(stream(seed, "ransac-planes").integers(2**31)))
    label = np.full(len(points), -1, dtype=np.int64)
    for plane in range(planes_max):
        left = np.flatnonzero(label < 0)
        if len(left) < max(settings.points_min, 3):
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[left]))
        # A probability of 1 makes it try them all: how many there are then does not depend on threads.
        _, inside = cloud.segment_plane(dx, ransac_n=3, num_iterations=trials, probability=1.0)
        if len(inside) < settings.points_min:
            break
        label[left[np.asarray(inside)]] = plane
    return refine(points, bars_of_groups(points, label, settings), dx, settings)
