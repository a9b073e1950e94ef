"""The settings of a calibrated camera, from ranges to known distances (docs/settings.md)."""

import numpy as np

from steelnb.core.checks import checked_array
from steelnb.core.errors import InputError
from steelnb.core.types import Array


def fitted_calibration(distance_m: Array, range_m: Array) -> dict[str, float]:
    """Scale and offset of ranges ``(N,)`` at known distances ``(N,)``, metres, by least squares, with their standard
    deviations, as overrides of the table ``tof``. Raises `InputError` below three different distances."""
    distance_m = checked_array(distance_m, "distance_m", ("N",))
    range_m = checked_array(range_m, "range_m", (len(distance_m),))
    different = len(np.unique(distance_m))
    if different < 3 or min(distance_m.min(), range_m.min()) <= 0:
        raise InputError(f"a calibration: expected positive ranges at 3 distances or more; found {different} distances")
    A = np.column_stack([distance_m, np.ones(len(distance_m))])
    (scale, offset_m), *_ = np.linalg.lstsq(A, range_m, rcond=None)
    residual = range_m - A @ [scale, offset_m]
    variance = np.diag(np.linalg.inv(A.T @ A)) * (residual @ residual) / (len(distance_m) - 2)
    names = "range_scale", "range_offset_m", "range_scale_sigma", "range_offset_sigma_m"
    values = scale, offset_m, *np.sqrt(variance)
    return {f"tof.{name}": float(value) for name, value in zip(names, values, strict=True)}
