"""Checks of what users hand in, shared by the types, by functions and by every odometry.

Each returns the checked value, or raises a one-line `InputError` that names it, its value and what was expected. Data
frames and structured arrays with fields x, y and z become arrays.
"""

import difflib
import math
import numbers
from collections.abc import Iterable
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from steelnb.core.errors import InputError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
COORDINATE_MAX_M = 1e8
"""No coordinate is larger: the earth is 4e7 m around. Drivers write such numbers for no return."""
RIGID_TOLERANCE = 1e-3
"""Largest deviation of RᵀR from the identity. Rounding to single precision or to text stays below it."""
SAME_S = 1e-6
"""Stamps that differ by less than a microsecond are the same, at any epoch."""
STAMP_MAX_S = 1e11
"""The year 5138. Stamps beyond are no seconds: Unix times in milliseconds are larger."""
INTEGER_MAX = int(np.iinfo(np.int64).max)
_CLOUD, _RIGID = "(N, 3) or (H, W, 3)", "a rigid transform (4, 4)"


def guess(name: Any, known: Iterable[str]) -> str:
    """`, did you mean ...?` if a known name is similar, else empty."""
    by_lower = {each.lower(): each for each in known}
    near = difflib.get_close_matches(str(name).lower(), by_lower, n=1)
    return f", did you mean {by_lower[near[0]]!r}?" if near else ""


def quoted(names: Any) -> str:
    """Names in quotes, separated by commas."""
    return ", ".join(repr(name) for name in names)


def shown(value: object, size: int = 80) -> str:
    """A value in a message, on one line of at most ``size`` characters; arrays and other objects by their kind."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or isinstance(value, str | numbers.Number | list | tuple | dict):
        return " ".join(repr(value).split())[:size]
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def checked_choice(value: object, name: str, known: Iterable[str]) -> str:
    """One of the ``known`` names."""
    known = tuple(known)
    if isinstance(value, str) and value in known:
        return value
    raise InputError(f"{name} = {shown(value)}: expected one of {quoted(known)}{guess(value, known)}")


def checked_kind(value: object, name: str, kind: Any, hint: str = "") -> Any:
    """An object of a class, or of one in a union. ``hint``: what to call to get one."""
    if isinstance(value, kind) and (not isinstance(value, str | bytes) or str in (kind, *get_args(kind))):
        return value
    kinds = " or ".join(dict.fromkeys(getattr(each, "__name__", str(each)) for each in get_args(kind) or (kind,)))
    raise InputError(f"{name} = {shown(value)}: expected {kinds}{f', as from {hint}' if hint else ''}")


def checked_number(
    value: Any,
    name: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: float = -math.inf,
    infinite: bool = False,
) -> float:
    """A real number from ``low`` to ``high`` and greater than ``above``; infinity only if ``infinite``."""
    try:
        number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    except OverflowError:  # of an integer
        number = math.nan
    if above < number and low <= number <= high and (infinite or -math.inf < number < math.inf):
        return number
    kind = "positive " if above == 0 else ""
    kind += "" if infinite or high < math.inf else "finite "
    limits = [f"of at least {low:g}"] * (low > -math.inf) + [f"of at most {high:g}"] * (high < math.inf)
    limits = [f"from {low:g} to {high:g}"] if len(limits) == 2 else limits
    limits += [f"above {above:g}"] if above not in (0, -math.inf) else []
    raise InputError(f"{name} = {shown(value)}: expected a {kind}number{''.join(f' {each}' for each in limits)}")


def checked_integer(value: Any, name: str, low: int, high: int = INTEGER_MAX) -> int:
    """A whole number, also one of NumPy's, from ``low`` to ``high``."""
    if isinstance(value, numbers.Integral) and not isinstance(value, bool) and low <= int(value) <= high:
        return int(value)
    limits = f"from {low} to {high}" if high < INTEGER_MAX else f"of at least {low} and below 2**63"
    raise InputError(f"{name} = {shown(value)}: expected an integer {limits}")


def check_sequence(values: Any, name: str, of: str) -> None:
    """Raise `InputError` for what has no length and items, such as an iterator, and for texts and arrays."""
    has_items = hasattr(values, "__len__") and hasattr(values, "__getitem__")
    if not has_items or isinstance(values, str | bytes | dict | np.ndarray):
        raise InputError(f"{name}: {type(values).__name__}; expected a sequence of {of}")


def check_length(values: Any, name: str, count: int, what: str) -> None:
    """Raise `InputError` unless there are ``count`` values, ``what`` says of what kind."""
    if len(values) != count:
        raise InputError(f"{name}: {len(values)}; expected {count}, {what}")


def checked_array(values: object, name: str, shape: tuple[str | int, ...]) -> Array:
    """Finite numbers as float64 in an array of a shape such as ``("N", 3)``, where a letter is any length."""
    expected = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    array = _real(values, name, f"real numbers in an array {expected}")
    if array.ndim != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise InputError(f"{name}: an array of shape {array.shape}; expected {expected}")
    if not np.isfinite(array).all():
        at = np.argwhere(~np.isfinite(array))[0]
        raise InputError(f"{name}{at.tolist()} = {array[tuple(at)]}: expected finite numbers")
    return array


def checked_shape(values: Any, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Whole numbers or truth values in an array of a shape."""
    array = np.asarray(values)
    if array.shape != shape or array.dtype.kind not in "biu":
        raise InputError(f"{name}: {array.dtype} of shape {array.shape}; expected {shape}, integers or truth values")
    return array


def checked_integers(
    values: object, name: str, shape: tuple[str | int, ...], low: int, high: int = INTEGER_MAX
) -> IntArray:
    """Whole numbers from ``low`` to ``high`` as int64 in an array of a shape, as for `checked_array`."""
    array = checked_array(values, name, shape)
    off = array[(array < low) | (array > high) | (array % 1 != 0)]
    if off.size:
        raise InputError(f"{name}: {off[0]:g}; expected whole numbers from {low} to {high}")
    return array.astype(np.int64)


def checked_sizes(values: object, name: str, count: int) -> Array:
    """Numbers ``(count,)`` that are not negative, or NaN for unknown, as float64."""
    array = _real(values, name, f"real numbers in an array ({count},)")
    if array.shape != (count,):
        raise InputError(f"{name}: an array of shape {array.shape}; expected ({count},)")
    off = array[(array < 0) | np.isinf(array)]
    if off.size:
        raise InputError(f"{name}: {off[0]:g}; expected finite numbers of at least 0")
    return array


def checked_stamps(values: object, name: str) -> Array:
    """Strictly increasing finite stamps ``(N,)``, seconds."""
    stamp_s = checked_array(values, name, ("N",))
    if not (stamp_s[1:] > stamp_s[:-1]).all():
        k = int(np.argmin(np.diff(stamp_s) > 0)) + 1
        raise InputError(f"{name}[{k}] = {stamp_s[k]!s} after {stamp_s[k - 1]!s}: expected strictly increasing stamps")
    checked_stamp(stamp_s[0] if len(stamp_s) else 0.0, f"{name}[0]")  # a later one alone may be a file's damaged line
    return stamp_s


def checked_stamp(value: object, name: str) -> float:
    """A finite stamp, seconds."""
    stamp_s = checked_number(value, name)
    if stamp_s > STAMP_MAX_S:
        raise InputError(f"{name} = {shown(value)}: expected seconds, at most {STAMP_MAX_S:.0e}")
    return stamp_s


def check_same_stamps(stamp_s: Array, name: str, expected_s: Array, of: str) -> None:
    """Raise `InputError` unless stamps ``(N,)`` are those of something else, to within `SAME_S`."""
    check_length(stamp_s, name, len(expected_s), f"as {of}")
    off_s = np.abs(stamp_s - expected_s)
    if not (off_s <= SAME_S).all():
        k = int(np.argmin(off_s <= SAME_S))
        raise InputError(
            f"{name}: number {k} is at {stamp_s[k]!s} s, {stamp_s[k] - expected_s[k]:.6g} s after {of};"
            " expected the same stamps"
        )


def checked_cloud(points: object, name: str = "points") -> Array:
    """A cloud ``(N, 3)`` or image ``(H, W, 3)``, metres, as float64 of the same shape; masked entries become NaN."""
    array = _real(points, name, f"real numbers in an array {_CLOUD}")
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise InputError(f"{name}: an array of shape {array.shape}; expected {_CLOUD}, metres")
    return array


def checked_points(points: object, name: str = "points") -> Array:
    """The points ``(N, 3)`` of a cloud or image, all finite."""
    array = np.ascontiguousarray(checked_cloud(points, name)).reshape(-1, 3)
    if not np.isfinite(array).all():
        off = int(np.count_nonzero(~np.isfinite(array).all(axis=1)))
        raise InputError(f"{name}: {off} of {len(array)} points not finite; drop them")
    check_coordinates(array, name)
    return array


def checked_pose(T_target_source: object, name: str) -> Array:
    """A rigid transform ``(4, 4)`` as float64. Raises `InputError` if it is not one."""
    array = _real(T_target_source, name, _RIGID)
    if array.shape != (4, 4):
        raise InputError(f"{name}: an array of shape {array.shape}; expected {_RIGID}")
    _check_rigid(array[None], name, "")
    return array


def checked_poses(T_target_source: object, name: str, count: int) -> Array:
    """Rigid transforms ``(count, 4, 4)`` as float64. Raises `InputError` that names the first that is not one."""
    array = _real(T_target_source, name, f"a finite ({count}, 4, 4) array")
    if array.shape != (count, 4, 4):
        raise InputError(f"{name}: an array of shape {array.shape}; expected ({count}, 4, 4)")
    _check_rigid(array, name, "[{}]")
    return array


def _as_array(values: Any) -> NDArray[Any]:
    """An array of ``values``; of a data frame or a structured array with x, y and z, these three. Masked entries become
    NaN."""
    names = getattr(values, "columns", getattr(getattr(values, "dtype", None), "names", None))
    if names is not None and {"x", "y", "z"} <= set(names):
        return np.stack([_as_array(values[axis]) for axis in "xyz"], axis=-1)
    return np.ma.filled(values.astype(np.float64), np.nan) if np.ma.isMaskedArray(values) else np.asarray(values)


def _real(values: Any, name: str, expected: str) -> Array:
    """Real numbers as float64, contiguous, as kernels are compiled for."""
    try:
        array = _as_array(values)
        if array.dtype.kind not in "fiu":
            raise TypeError
        return np.asarray(array, dtype=np.float64, order="C")
    except (TypeError, ValueError, RuntimeError):  # the last by tensors with gradients
        kind = getattr(values, "dtype", type(values).__name__)
        raise InputError(f"{name}: {kind}; expected {expected}") from None


def _check_rigid(T: Array, name: str, index: str) -> None:
    """Raise `InputError` for the first of ``T (N, 4, 4)`` that is not rigid. ``index``: how to write its number."""
    R = T[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        skew = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
        row = np.abs(T[:, 3] - np.eye(4)[3]).max(axis=1, initial=0.0)
        handed = np.linalg.det(R)
    near = np.abs(T[:, :3, 3]).max(axis=1, initial=0.0) <= COORDINATE_MAX_M
    good = (skew <= RIGID_TOLERANCE) & (row <= RIGID_TOLERANCE) & (handed > 0) & near
    if good.all():
        return
    k = int(np.argmin(good))
    name, at = f"{name}{index.format(k)}", T[k]
    if not np.isfinite(at).all():
        raise InputError(f"{name}: an entry is not finite; expected {_RIGID}")
    check_coordinates(at[:3, 3], name)
    if row[k] > RIGID_TOLERANCE:
        raise InputError(f"{name}: last row {at[3].tolist()}; expected 0, 0, 0, 1")
    if skew[k] > RIGID_TOLERANCE:
        length = np.linalg.norm(at[:3, :3], axis=0).round(4).tolist()
        raise InputError(f"{name}: axes of length {length}, not orthonormal; expected a rotation, no scale or shear")
    raise InputError(f"{name}: a reflection (determinant {handed[k]:.3f}); expected a right-handed frame")


def set_checked(instance: object, **values: object) -> None:
    """Set fields of a frozen dataclass to their checked values, in its ``__post_init__``."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def check_coordinates(points: NDArray[np.float64], name: str) -> None:
    """Raise `InputError` if a finite coordinate is beyond `COORDINATE_MAX_M`."""
    largest = float(np.abs(points).max(initial=0.0))
    if largest > COORDINATE_MAX_M:
        raise InputError(f"{name}: a coordinate of {largest:.3g}; expected metres, at most {COORDINATE_MAX_M:.0e}")
