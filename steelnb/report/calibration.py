"""Errors of a sensor in lines of text."""

import numpy as np

from steelnb.types import SensorErrors

SHOWN = {"m": (1e3, "mm"), "": (1e2, "%"), "rad": (180 / np.pi, "°"), "s": (1e3, "ms")}
"""Unit → factor and unit in which it is printed."""
TOLD_SHARE = 0.5
"""A flight tells an error if it has left less than this share of its standard deviation before."""


def error_lines(errors: SensorErrors) -> tuple[str, ...]:
    """Each error with its standard deviation after the flight and before, and whether the flight tells it."""
    lines = []
    for name, value, sigma, before, unit in zip(
        errors.NAMES, errors.value, errors.sigma, errors.prior_sigma, errors.UNITS, strict=True
    ):
        factor, shown = SHOWN[unit]
        told = "known" if not before else "" if sigma < TOLD_SHARE * before else "not told by this flight"
        number = f"{factor * value:+8.2f} ± {factor * sigma:.2f} {shown} (before: ± {factor * before:.2f})"
        lines.append(f"{name:<13} {number} {told}".rstrip())
    return tuple(lines)
