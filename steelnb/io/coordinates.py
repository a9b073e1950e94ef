"""What the coordinates of a cloud say of their unit and precision, and which points are none of it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError
from steelnb.core.types import Array

STRAY_M, STRAY_DISTANCES, STRAY_SHARE = 1e4, 1000.0, 0.01
"""Points farther than both from the median point, in metres and in median distances, are strays if they are so few:
such as zeros among the coordinates of a survey."""
STEP_MAX_M, FAR_FROM_ZERO_M, ROUNDED_POINTS = 0.02, 1e4, 100
"""Largest step between coordinates; those below the second are left as they are, as are few points."""
DEGREE_EXTENTS, DEGREES_MIN, DEGREES_FROM_ZERO, DEGREES_WIDE = 1e3, 1e-6, 5000.0, 0.005
"""Coordinates in degrees extend over so many times less than heights in metres, but over more than rounding does, and
are so many times their extent away from zero, as a thin tube is only if it stands far from the origin. No tube is as
wide as the last and so many times taller; a site of half a kilometre is, in degrees."""


def is_stray(points: Array) -> NDArray[np.bool_]:
    """Mask ``(N,)`` of the strays (`STRAY_M`) among points ``(N, 3)``."""
    distance_m = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    is_far = distance_m > max(STRAY_M, STRAY_DISTANCES * float(np.median(distance_m)))
    return is_far & (np.count_nonzero(is_far) <= STRAY_SHARE * len(points))


def check_steps(path: Path | str, points: Array) -> None:
    """Raise `InputError` if large coordinates are multiples of some centimetres: they were stored in single precision,
    or with too few digits."""
    for name, values in zip("xyz", points.T, strict=True):
        if len(points) < ROUNDED_POINTS or not np.abs(values).max() > FAR_FROM_ZERO_M:
            continue
        different = np.unique(values)
        step = float(np.diff(different).min(initial=np.inf))
        steps = (different - different[0]) / step
        if step > STEP_MAX_M and np.abs(steps - np.round(steps)).max() < 0.01:
            raise InputError(
                f"{path}: {name} is around {values.mean():.0f} in steps of {step:.3g} m, as of single precision; "
                "expected doubles, or coordinates near zero"
            )


def check_degrees(path: Path | str, points: Array) -> None:
    """Raise `InputError` if x and y can be degrees, and extend a thousand times less than z."""
    extent = np.ptp(points, axis=0)
    in_degrees = bool((np.abs(points[:, :2]) <= (180, 90)).all()) or bool((np.abs(points[:, :2]) <= (90, 180)).all())
    is_far = float(np.abs(points[:, :2]).max()) > DEGREES_FROM_ZERO * extent[:2].max()
    is_far |= bool(extent[:2].max() > DEGREES_WIDE)
    if in_degrees and is_far and DEGREES_MIN < extent[:2].max() < extent[2] / DEGREE_EXTENTS:
        spans = f"x and y extend over {extent[0]:.2g} and {extent[1]:.2g}, z over {extent[2]:.3g}"
        raise InputError(f"{path}: {spans}, as with longitude and latitude in degrees; expected metres")
