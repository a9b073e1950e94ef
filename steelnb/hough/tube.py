"""Radius of the tube that holds a bar's points, from the spacing of a cloud's points and the width of its bars."""

import math

import numpy as np
from scipy.spatial import cKDTree

from steelnb.points import voxel_grid
from steelnb.types import Array

MIN_VOTES = 8
"""Fewest voxel-filtered points of a bar."""
STRAIGHT = 0.7
STRAIGHT_THINNED = 0.5
"""What 30 % of the spheres in a cloud of bars reach of 1 − the ratio of standard deviations across and along, and then
in a thinned one. In noise, in a plane and on a ball they reach 0.2 to 0.32."""


def point_spacing(points: Array) -> float:
    """Median distance of a point of ``(N, 3)`` to its fourth neighbour, metres.

    The fourth: along a bar a point has two neighbours on either side, so this is two steps. Unlike the distance to
    the nearest, it hardly depends on whether points are spread evenly or at random, nor on near-duplicates.
    """
    asked = points[np.linspace(0, len(points) - 1, min(len(points), 5000)).astype(int)]
    distance = cKDTree(points).query(asked, k=min(5, len(points)))[0][:, -1]
    return float(np.median(distance))


def tube_radius(points: Array, thinned: bool = False) -> float:
    """The dx of a cloud ``(N, 3)``, metres: the larger of its point spacing and the width of its bars.

    Not less than the spacing (`point_spacing`), for then a tube would hold too few points to show a line. Not less
    than the width, for then each bar would come out as several. The width is twice the root mean square distance of
    points to the axis of their own surroundings, in spheres of the smallest radius at which surroundings look
    straight: 30 % of the spheres have a standard deviation across that is less than 30 % of that along. Where no
    radius up to a tenth of the cloud's diagonal does that, bars are too close together to be told apart before they
    are found, and the spacing decides. The spacing of a ``thinned`` cloud is that of its voxels, and tells nothing of
    its bars: there the radius at which surroundings look straightest decides, if they do to some degree.
    """
    spacing = point_spacing(points)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    radius, straightest, across = 2 * spacing, STRAIGHT_THINNED, 0.0
    while radius <= diagonal / 10:
        thin = voxel_grid(points, radius / 8)  # enough points for a sphere, few enough to be quick
        centres = thin[np.linspace(0, len(thin) - 1, min(len(thin), 500)).astype(int)]
        spheres = [thin[index] for index in cKDTree(thin).query_ball_point(centres, radius) if len(index) >= 8]
        if len(spheres) >= len(centres) / 2:
            variance = np.linalg.eigvalsh([np.cov(sphere.T) for sphere in spheres]).clip(0)
            straightness = 1 - np.sqrt(variance[:, 1] / variance[:, 2])
            bound = np.quantile(straightness, 0.7)
            if bound >= straightest:
                width = float(np.median(2 * np.sqrt(variance[:, 0] + variance[:, 1])[straightness >= bound]))
                if bound >= STRAIGHT:
                    return max(spacing, width)
                straightest, across = float(bound), width
        radius *= math.sqrt(2)
    return max(spacing, across) if thinned and across else min(spacing, diagonal / 4)
