"""Geman-McClure weights, which bound the influence of outliers: with the scale c, a residual r has the loss
½ c² r² / (c² + r²) and the weight (c² / (c² + r²))² of iteratively reweighted least squares.

Source: Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting" (Image and Vision
Computing 15, 1997), table 1. Both functions take numbers or arrays, and run in Python and in compiled kernels.
"""

from typing import Any

from numba.extending import register_jitable


@register_jitable(error_model="numpy")
def geman_mcclure(squared: Any, scale: Any) -> tuple[Any, Any]:
    """Weight and loss of squared residuals; an infinite scale gives plain least squares."""
    u = squared / (scale * scale)
    return 1.0 / ((1.0 + u) * (1.0 + u)), 0.5 * squared / (1.0 + u)


@register_jitable(error_model="numpy")
def weighted_geman_mcclure(squared: Any, bound: Any, weight: Any) -> tuple[Any, Any]:
    """Weight, and twice the loss, of squared residuals that have a ``weight`` already; ``bound``: the squared scale.

    It takes one division less where the bound differs from residual to residual.
    """
    return weight * (bound / (bound + squared)) ** 2, weight * bound * squared / (bound + squared)
