"""Arrays of coordinates from what users hand in: data frames become arrays, and impossible coordinates are refused."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError

COORDINATE_MAX_M = 1e8
"""No coordinate is larger: the earth is 4e7 m around. Drivers write such numbers for no return."""


def fields_of(values: Any) -> tuple[str, ...]:
    """The names of the fields of a structured array, such as points read from a ROS 2 message; else nothing."""
    return getattr(getattr(values, "dtype", None), "names", None) or ()


def as_array(values: Any) -> NDArray[Any]:
    """An array of ``values``. Of a data frame with columns named x, y and z, in any case and order, these three; of
    a structured array, the fields of these names."""
    fields = [name.lower() for name in fields_of(values)]
    if all(fields.count(axis) == 1 for axis in "xyz"):
        columns = [values[fields_of(values)[fields.index(axis)]].astype(np.float64) for axis in "xyz"]
        return np.stack([np.ma.filled(column, np.nan) for column in columns], axis=-1)
    if not hasattr(values, "columns") or not hasattr(values, "iloc"):
        return np.asarray(values)
    names = [str(name).lower() for name in values.columns]
    if all(names.count(axis) == 1 for axis in "xyz"):
        values = values.iloc[:, [names.index(axis) for axis in "xyz"]]
    return np.asarray(values.to_numpy(np.float64, na_value=np.nan))


def remedy(values: Any) -> str:
    """What to hand in instead of an object with points, such as a cloud of Open3D; empty for others."""
    return ", such as its .points" if hasattr(values, "points") else ""


def check_coordinates(points: NDArray[np.float64], name: str) -> None:
    """Raise `InputError` if a finite coordinate is beyond `COORDINATE_MAX_M`."""
    largest = float(np.abs(points).max(initial=0.0))
    if largest > COORDINATE_MAX_M:
        raise InputError(f"{name}: a coordinate of {largest:.3g}; expected metres, at most {COORDINATE_MAX_M:.0e}")


def without_zeros(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(..., 3)`` with NaN in place of those at exactly zero; the same array if there are none."""
    x = points[..., 0]
    if not (x == 0).any():  # a tenth of the time of a look at all coordinates
        return points
    zero = (points == 0).all(axis=-1)
    return np.where(zero[..., None], np.nan, points) if zero.any() else points
