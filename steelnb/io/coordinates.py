"""What the coordinates of a cloud say of their order, unit and precision, and which points are none of it."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.core.checks import COORDINATE_MAX_M
from steelnb.core.errors import InputError
from steelnb.core.types import Array

STRAY_M, STRAY_DISTANCES, STRAY_SHARE = 1e4, 1000.0, 0.01
"""Points farther than both from the median point, in metres and in median distances, are strays if they are so few:
such as zeros among the coordinates of a survey."""
NO_RETURN, SAME_M, APART_M = (0, 999, 9999, 99999, 32767, 32768), 1e-6, 100.0
"""Numbers, of either sign, that programs write where a coordinate is missing, and their minimum distance from others.
Zero counts only in a survey."""
FARTHEST_M = 4e4
"""Points farther than this from the mean of all cannot be put into the voxels of a map."""
STEP_MAX_M, FAR_FROM_ZERO_M, ROUNDED_POINTS = 0.02, 1e4, 100
"""Largest step between coordinates; those below the second are left as they are, as are few points."""
EARTH_M, HIGH_M = (6.33e6, 6.4e6), 1e4
"""Bounds of the Earth's radius, which the coordinates of a projection may have, too, but with a z below the second."""
DEGREE_EXTENTS, DEGREES_MIN, DEGREES_FROM_ZERO, DEGREES_WIDE = 1e3, 1e-6, 5000.0, 0.02
"""Coordinates in degrees extend over so many times less than heights in metres, but over more than rounding does, and
are so many times their extent away from zero, as a thin tube is only if it stands far from the origin. No tube is as
wide as the last and so many times taller; a site of two kilometres is, in degrees."""
LINES_COUNTED, TIME_MAX, OFTEN = 10, 1e19, 0.25
"""Minimum number of lines that tell what a first column is, what no time exceeds, in nanoseconds, and the share of
lines from which on a column changes often."""


def is_stray(path: Path | str, points: Array) -> NDArray[np.bool_]:
    """Mask ``(N,)`` of the strays (`STRAY_M`) among points ``(N, 3)``, and of those without a return (`NO_RETURN`).

    Where there was no return, several points have the same coordinate, farther from all others than these from each
    other. Raises `InputError` for too many points too far from the others.
    """
    is_missing = np.zeros(len(points), dtype=bool)
    for values in points.T:
        for value in (values.min(), values.max()):
            if abs(value - round(value)) > SAME_M or abs(round(value)) not in NO_RETURN:
                continue
            here = np.abs(values - value) < SAME_M
            if 1 < np.count_nonzero(here) < len(points) / 2:  # a single one may be a point
                least_m = max(np.ptp(values[~here]), APART_M if round(value) else STRAY_M)
                is_missing |= here & (np.abs(values[~here] - value).min() > least_m)
    is_missing &= is_missing.mean() < 0.5
    kept = points[~is_missing]
    distance_m = np.linalg.norm(points - np.median(kept, axis=0), axis=1)
    is_far = distance_m > max(STRAY_M, STRAY_DISTANCES * float(np.median(distance_m[~is_missing])))
    count = np.count_nonzero(is_far & ~is_missing)
    if count > STRAY_SHARE * len(kept) and np.abs(kept - kept.mean(axis=0)).max() > FARTHEST_M:
        far = f"{count} of {len(points)} points are more than {STRAY_M / 1e3:g} km from most"
        raise InputError(f"{path}: {far}; expected one site")
    return is_missing | (is_far & (count <= STRAY_SHARE * len(kept)))


def check_geocentric(path: Path | str, points: Array) -> None:
    """Raise `InputError` if points ``(N, 3)`` lie on the Earth as seen from its centre (ECEF), where z is not up."""
    x, y, z = np.median(points, axis=0).tolist()
    if EARTH_M[0] < math.hypot(x, y, z) < EARTH_M[1] and abs(z) > HIGH_M:
        place = f"coordinates around ({x:.0f}, {y:.0f}, {z:.0f}) m, as from the centre of the Earth (ECEF)"
        raise InputError(f"{path}: {place}; expected a projection with z up, such as UTM")


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
            steps = f"{name} is around {values.mean():.0f} in steps of {step:.3g} m, as of single precision"
            raise InputError(f"{path}: {steps}; expected doubles, or coordinates near zero")


def check_first_column(columns: Array) -> None:
    """Raise ValueError if x, y and z are not the first of ``columns (N, 3 to 6)`` without names.

    The first column rises in equal steps, or holds times. Or up to three columns hold only whole numbers, and most
    numbers of the next three have decimals; but not if the first may be an x that seldom changes, and not before
    colours and normals.
    """
    expected = "expected x, y and z first, or names of columns"
    first = columns[:, 0].astype(np.float64)
    step = np.diff(first)
    if len(first) < LINES_COUNTED:
        return
    if step[0] > 0 and np.abs(step - step[0]).max() <= 1e-6 * step[0]:
        raise ValueError(f"its first column counts the lines in steps of {step[0]:g}; {expected}")
    finite = first[np.isfinite(first)]
    if len(finite) and COORDINATE_MAX_M < (typical := np.median(finite)) < TIME_MAX:
        raise ValueError(f"its first column is around {typical:.3g}, as of times; {expected}")
    if not finite.any() or (finite != np.round(finite)).any():
        return
    columns = columns[np.isfinite(columns).all(axis=1)].astype(np.float64)
    has_decimals = columns != np.round(columns)
    leading = int(np.argmax(has_decimals.any(axis=0)))
    axes, behind = has_decimals[:, leading : leading + 3], columns[:, 3:]
    if not 1 <= leading <= 3 or axes.shape[1] < 3 or (axes.mean(axis=0) <= 0.5).any():
        return
    are_normals = behind.shape[1] == 3 and np.abs(behind).max() <= 1
    if leading == 1:  # an x of walls and profiles hardly changes, and what is 0 to 1, or a time, is no z
        largest = np.abs(columns[:, 3]).max()
        may_be_x = (np.diff(columns[:, 0]) != 0).mean() < OFTEN or not 1 < largest <= COORDINATE_MAX_M
    else:
        may_be_x = leading == 3 and (columns[:, :3].min() < 0 or columns[:, :3].max() > 255)
    if not may_be_x and not are_normals:
        raise ValueError(f"its first column holds whole numbers, as of rows, intensities or classes; {expected}")


def check_degrees(path: Path | str, points: Array) -> None:
    """Raise `InputError` if x and y can be degrees, and extend a thousand times less than z."""
    extent = np.ptp(points, axis=0)
    in_degrees = bool((np.abs(points[:, :2]) <= (180, 90)).all()) or bool((np.abs(points[:, :2]) <= (90, 180)).all())
    is_far = float(np.abs(points[:, :2]).max()) > DEGREES_FROM_ZERO * extent[:2].max()
    is_far |= bool(extent[:2].max() > DEGREES_WIDE)
    if in_degrees and is_far and DEGREES_MIN < extent[:2].max() < extent[2] / DEGREE_EXTENTS:
        spans = f"x and y extend over {extent[0]:.2g} and {extent[1]:.2g}, z over {extent[2]:.3g}"
        raise InputError(f"{path}: {spans}, as with longitude and latitude in degrees; expected metres")
