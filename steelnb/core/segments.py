"""Lines and segments, as searches for straight bars return them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steelnb.core import checks
from steelnb.core.arguments import checks_arguments
from steelnb.core.errors import InputError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Lines:
    """Infinite lines: ``anchor (M, 3)``, unit ``direction (M, 3)``, number of points ``count (M,)``, and ``label
    (N,)``, the line of each input point or −1. Public functions refuse values for which `checked` raises an error."""

    anchor: Array
    direction: Array
    count: IntArray
    label: IntArray

    def __post_init__(self) -> None:
        check_columns(self, count=0, anchor=3, direction=3)
        label = checks.checked_shape(self.label, "Lines.label", np.shape(self.label)[:1])
        checks.set_checked(self, label=label)

    def __len__(self) -> int:
        return len(self.count)

    def __repr__(self) -> str:
        return f"Lines({len(self)} of {len(self.label)} points)"

    def checked(self) -> "Lines":
        """The lines in the types that kernels are compiled for. Raises `InputError` for anchors and directions that are
        not finite, and negative counts and labels below −1."""
        anchor, direction = (_finite(getattr(self, name), f"Lines.{name}") for name in ("anchor", "direction"))
        count = _at_least(self.count, "Lines.count", 0, np.int64)
        return Lines(anchor, direction, count, _at_least(self.label, "Lines.label", -1, np.int64))


@dataclass(frozen=True, eq=False)
class Segments:
    """Line segments, metres: ``start (M, 3)``, ``end (M, 3)``, number of points ``count (M,)``, and ``radius (M,)``,
    the root mean square distance of these points from the axis. Public functions refuse values for which `checked`
    raises an error; the constructor, which odometries call often, does not read them."""

    start: Array
    end: Array
    count: IntArray
    radius: Array

    def __post_init__(self) -> None:
        check_columns(self, start=3, end=3, count=0, radius=0)

    def __len__(self) -> int:
        return len(self.count)

    def __repr__(self) -> str:
        return f"Segments({len(self)}, {self.length.sum():.2f} m in all)"

    def checked(self) -> "Segments":
        """The segments in the types that kernels are compiled for. Raises `InputError` for ends that are not finite,
        and for negative counts and radii; unknown radii may be NaN."""
        start, end = (_finite(getattr(self, name), f"Segments.{name}") for name in ("start", "end"))
        count = _at_least(self.count, "Segments.count", 0, np.int64)
        return Segments(start, end, count, _at_least(self.radius, "Segments.radius", 0, np.float64))

    @staticmethod
    def empty() -> "Segments":
        return Segments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))

    @staticmethod
    @checks_arguments
    def joined(parts: "Iterable[Segments]") -> "Segments":
        """The segments of all parts, in order. Without parts there are none."""
        parts = [Segments.empty(), *(checks.checked_kind(part, "a part", Segments) for part in parts)]
        columns = zip(*((p.start, p.end, p.count, p.radius) for p in parts), strict=True)
        return Segments(*(np.concatenate(column) for column in columns))

    @property
    def length(self) -> Array:
        """Lengths ``(M,)`` in metres."""
        return np.linalg.norm(self.end - self.start, axis=1)

    @property
    def middle(self) -> Array:
        """Midpoints ``(M, 3)``."""
        return 0.5 * (self.start + self.end)

    @property
    def direction(self) -> Array:
        """Unit vectors from start to end ``(M, 3)``."""
        return (self.end - self.start) / np.maximum(self.length, 1e-12)[:, None]

    def transformed(self, T_target_source: Array) -> "Segments":
        """The same segments in another frame."""
        R, t = (T := checks.checked_pose(T_target_source, "T_target_source"))[:3, :3], T[:3, 3]
        return Segments(self.start @ R.T + t, self.end @ R.T + t, self.count, self.radius)

    def moved(self, by: Array) -> "Segments":
        """The segments translated by ``by (3,)``, metres."""
        return replace(self, start=self.start + checks.checked_array(by, "by", (3,)), end=self.end + by)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> "Segments":
        """The segments selected by an index or a mask."""
        return Segments(self.start[index], self.end[index], self.count[index], self.radius[index])


def _writable(array: Any, dtype: Any) -> NDArray[Any]:
    """The same array if it has the type and may be written, else a copy: a kernel is compiled for each kind."""
    return array if array.dtype == dtype and array.flags.writeable else np.array(array, dtype=dtype)


def _plain(array: Any) -> NDArray[Any]:
    """A plain array of a data frame's column, or of a masked one, whose masked values are NaN."""
    return np.asarray(np.ma.filled(array.astype(float), np.nan) if isinstance(array, np.ma.MaskedArray) else array)


def _finite(array: Array, name: str) -> Array:
    array = _plain(array)
    if not math.isfinite(array.sum()):  # the sum of finite coordinates is finite
        checks.checked_array(array, name, ("M", 3))
    return _writable(array, np.float64)


def _at_least(array: NDArray[Any], name: str, low: int, dtype: Any) -> NDArray[Any]:
    """Finite numbers of at least ``low``; NaN, for unknown, if the type is a float."""
    array = _plain(array)
    known = array[~np.isnan(array)] if dtype is np.float64 else array
    if not (low <= known.min(initial=low) and known.max(initial=low) < np.inf):
        off = known[~((known >= low) & (known < np.inf))][0]
        raise InputError(f"{name}: {off}; expected finite numbers of at least {low}")
    return _writable(array, dtype)


def check_columns(instance: object, **columns: int) -> None:
    """Raise `InputError` unless fields are numbers of as many rows as the first field has: ``(M,)`` for 0 columns,
    ``(M, 3)`` for 3. Values are not read, so that this takes a few microseconds. A slice of a larger array is copied:
    kernels are compiled for contiguous arrays, and would be compiled again for a slice."""
    rows: Any = None
    for name, width in columns.items():
        array = getattr(instance, name)
        shape = getattr(array, "shape", ())
        rows = shape[0] if rows is None and shape else rows
        dtype = getattr(array, "dtype", None)
        if shape != ((rows, width) if width else (rows,)) or dtype is None or dtype.kind not in "fiu":
            has = f"{checks.shown(array) if dtype is None else dtype} of shape {shape}"
            expected = f"({rows or 'M'}, {width or ''}".rstrip() + ")"
            raise InputError(f"{type(instance).__name__}.{name}: {has}; expected an array {expected} of numbers")
        if isinstance(array, np.ndarray) and not array.flags.c_contiguous:
            checks.set_checked(instance, **{name: np.ascontiguousarray(array)})
