"""The command nearest to a wished one that keeps all barriers.

A barrier is a function h of the pose that must not fall below zero; a command u keeps it where dh/du · u ≥ −α h (Ames
et al., "Control barrier functions: theory and applications", ECC 2019). All are soft, with weights far apart, so that
there always is a command: structure before sight.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from steelnb.types import Array


class Barrier(NamedTuple):
    """``gradient (4,)`` of h by velocity (world axes, m/s) and yaw rate (rad/s), the ``value`` of h, the rate ``alpha``
    (1/s) at which it may fall towards zero, and the ``weight`` of not keeping it."""

    gradient: Array
    value: float
    alpha: float
    weight: float


def nearest_command(wished: Array, cost: Array, barriers: list[Barrier]) -> Array:
    """Minimise ½ Σ cost (u − wished)² + ½ Σ weight · slack² over u ``(4,)`` and the slack of each barrier.

    With x = (√cost (u − wished), √weight · slack) this is the least-distance problem min ‖x‖ for G x ≥ h, which a
    non-negative least-squares problem solves (Lawson, Hanson, "Solving Least Squares Problems", 1974, chapter 23).
    """
    if not barriers:
        return wished
    gradient = np.array([each.gradient for each in barriers])
    bound = -np.array([each.alpha * each.value for each in barriers]) - gradient @ wished
    if (bound <= 0).all():
        return wished
    scale = 1 / np.sqrt([each.weight for each in barriers])
    G = np.hstack([gradient / np.sqrt(cost), np.diag(scale)])
    E = np.vstack([G.T, bound])
    target = np.zeros(len(E))
    target[-1] = 1.0
    residual = E @ nnls(E, target)[0] - target
    return np.asarray(wished - residual[: len(wished)] / residual[-1] / np.sqrt(cost))
