"""The settings of a calibrated camera, from ranges to known distances (docs/settings.md)."""

import numpy as np

from steelnb.core.checks import checked_array, checked_number
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.settings.sensors import SCALE_MAX, SCALE_MIN


def fitted_calibration(distance_m: Array, range_m: Array) -> dict[str, float]:
    """Scale and offset of ranges ``(N,)`` at known distances ``(N,)``, metres, by least squares, with their standard
    deviations, as overrides of the table ``tof``. Raises `InputError` for fewer than three different distances, for
    values that are not positive, and for a scale that no camera has, as between metres and millimetres."""
    distance_m = checked_array(distance_m, "distance_m", ("N",))
    range_m = checked_array(range_m, "range_m", (len(distance_m),))
    different = len(np.unique(distance_m))
    if different < 3:
        raise InputError(f"distance_m: {different} different values; expected at least 3")
    checked_number(distance_m.min(), "the smallest distance_m", above=0)
    checked_number(range_m.min(), "the smallest range_m", above=0)
    A = np.column_stack([distance_m, np.ones(len(distance_m))])
    (scale, offset_m), *_ = np.linalg.lstsq(A, range_m, rcond=None)
    checked_number(scale, "the scale of range_m against distance_m, both in metres,", SCALE_MIN, SCALE_MAX)
    residual = range_m - A @ [scale, offset_m]
    variance = np.diag(np.linalg.inv(A.T @ A)) * (residual @ residual) / (len(distance_m) - 2)
    names = "range_scale", "range_offset_m", "range_scale_sigma", "range_offset_sigma_m"
    values = scale, offset_m, *np.sqrt(variance)
    return {f"tof.{name}": float(value) for name, value in zip(names, values, strict=True)}
