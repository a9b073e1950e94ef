"""What a registration gives."""

import math
from dataclasses import dataclass

from steelnb.core.types import Array


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """Pose and convergence of a registration.

    ``T_target_source (4, 4)``; ``iterations``; ``inliers``: number of pairs within the maximum correspondence distance;
    ``reason``: why the solver stopped.

    ``H (6, 6)`` is the final normal matrix of a twist ξ = (ω, v) in the axes of the target: a rotation about ``centre
    (3,)``, the mean of the transformed source, and its translation. ``unobserved (u, 3)`` are unit vectors along which
    the paired surfaces have no normals (`degeneracy.unobserved_shifts`), so the pose along them is not reliable;
    `align` with ``normals_min`` does not translate along them. ``squared_m2``: sum of the squared distances of the
    pairs at the pose; ``points``: number of points of the source.
    """

    T_target_source: Array
    iterations: int
    inliers: int
    H: Array
    reason: str
    centre: Array
    unobserved: Array
    squared_m2: float
    points: int

    @property
    def rmse_m(self) -> float:
        """Root mean square distance of the pairs, metres, NaN without a pair: Open3D's ``inlier_rmse``."""
        return math.sqrt(self.squared_m2 / self.inliers) if self.inliers else math.nan

    @property
    def overlap(self) -> float:
        """Share of the source's points that have a pair, 0 to 1: Open3D's ``fitness``."""
        return self.inliers / max(self.points, 1)

    def __repr__(self) -> str:
        numbers = f"rmse {self.rmse_m:.4g} m, overlap {self.overlap:.2f}, {len(self.unobserved)} directions unobserved"
        return f"RegistrationResult({self.reason} after {self.iterations} iterations, {numbers})"

    @property
    def converged(self) -> bool:
        """Whether the last step was below both bounds."""
        return self.reason == "converged"
