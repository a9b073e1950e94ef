"""The result of a registration: pose, convergence, normal equations, directions left out."""

from dataclasses import dataclass, field

import numpy as np

from steelnb.types import Array


@dataclass(frozen=True)
class RegistrationResult:
    """Pose and convergence of a registration.

    ``T_target_source (4, 4)``; ``converged``; ``iterations``; ``inliers``, pairs within the largest distance;
    ``reason`` why it stopped.

    ``H (6, 6)`` and ``b (6,)`` are the normal equations at the end, of twists ξ = (ω, v) in the axes of the target: a
    turn about ``centre (3,)``, the middle of the source under the pose, and the shift of that centre. ``unobserved (u,
    3)``, unit vectors: shifts that were left out of the solve, since the surfaces paired have no normals along them
    (`observability.unobserved_shifts`).
    """

    T_target_source: Array
    converged: bool
    iterations: int
    inliers: int
    H: Array
    b: Array
    reason: str
    centre: Array
    unobserved: Array = field(default_factory=lambda: np.zeros((0, 3)))
