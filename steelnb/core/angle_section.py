"""The centroid of an equal-leg angle section, shared by estimators and by the truth that they are compared with."""

from numba.extending import register_jitable


@register_jitable
def centroid_m(flange_m: float, thickness_m: float) -> float:
    """Distance of the centroid from either outer face, metres: that of two rectangles b × t and (b − t) × t."""
    return (flange_m * flange_m + flange_m * thickness_m - thickness_m * thickness_m) / (
        2.0 * (2.0 * flange_m - thickness_m)
    )


@register_jitable
def centroid_growth(thickness: float) -> float:
    """Derivative of `centroid_m` with respect to the thickness, both as shares of the flange."""
    return (3.0 - 4.0 * thickness + thickness * thickness) / (2.0 * (2.0 - thickness) ** 2)
