"""A tower from a list of its members and plates, in a CSV file.

Columns ``kind, x0, y0, z0, x1, y1, z1, x2, y2, z2``, metres, world frame, z up; lines that begin with # are comments.
A member (`KINDS`) has two ends; its third point is empty. A ``plate`` is a parallelogram, given by one corner and the
two adjacent ones. A ``triangle`` is a plate with three corners. A last column ``width`` may follow: the width of a
member in metres, or empty for that of its kind.
"""

import csv
import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial import cKDTree

from steelnb.core.checks import quoted
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.geometry import connected
from steelnb.core.types import Array
from steelnb.settings.presets import members_file
from steelnb.settings.world import Kind

COLUMNS = ["kind", *(f"{axis}{k}" for k in range(3) for axis in "xyz")]
WIDTH = "width"
KINDS = get_args(Kind)
PLATES = {"plate": [(0, 1, 2), (1, 3, 2)], "triangle": [(0, 1, 2)]}
"""Triangles of a plate by corner; corner 3 lies opposite corner 0."""
JOINT_M = 0.02
"""Members within this distance of each other share a joint."""


def leg_half_width(members: str, z: float) -> float:
    """Half the distance along x between the outermost legs at height ``z``, metres. Raises `InputError`."""
    kinds, ends, *_ = read_members(members)
    legs = ends[np.array(kinds) == "leg"]
    if not len(legs):
        raise InputError(f"tower.members = {members!r}: no leg in the list; expected one, for the width of the body")
    legs = np.take_along_axis(legs, legs[..., 2].argsort(axis=1)[..., None], axis=1)
    z = float(np.clip(z, legs[..., 2].min(), legs[..., 2].max()))
    x = [np.interp(z, *leg[:, [2, 0]].T) for leg in legs if leg[0, 2] <= z <= leg[1, 2]]
    return float(max(x) - min(x)) / 2


def read_members(members: str) -> tuple[list[Kind], Array, Array, list[float | None]]:
    """Kinds and ends ``(M, 2, 3)`` of the members of a list, the triangles ``(P, 3, 3)`` of its plates, and the own
    widths of the members. The list is the name of a preset or a file ``FILE.csv``. Raises `InputError`."""
    path, ends, plates = members_file(members), [], []
    kinds: list[Any] = []
    widths: list[float | None] = []
    with reading(path, "a list of members"), path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(line if not line.startswith("#") else "\n" for line in file)
        rows = [(k, row) for k, row in enumerate(reader, 1) if row]
        if not rows or rows[0][1] not in (COLUMNS, [*COLUMNS, WIDTH]):
            raise InputError(f"{path}: columns {','.join(rows[0][1]) if rows else ''!r}: expected {','.join(COLUMNS)}")
        for line, row in rows[1:]:
            own = row[len(COLUMNS) :] if WIDTH in rows[0][1] and row[0] in KINDS else []
            points = _points(path, line, row[: len(row) - len(own)])
            if len(points) == 2:
                kinds.append(row[0])
                widths.append(_width(path, line, row, own))
                ends.append(points)
            else:
                corners = [*points, points[1] + points[2] - points[0]]
                plates += [[corners[i] for i in triangle] for triangle in PLATES[row[0]]]
    if not kinds:
        raise InputError(f"{path}: no member; expected one of {quoted(KINDS)}")
    return kinds, np.array(ends), np.array(plates).reshape(-1, 3, 3), widths


def _points(path: Path, line: int, row: list[str]) -> Array:
    """The ends of a member ``(2, 3)``, or three corners of a plate ``(3, 3)``. Raises `InputError`."""
    count = 6 if row[0] in KINDS else 9 if row[0] in PLATES else 0
    if not count:
        raise InputError(f"{path}: line {line}: kind {row[0]!r}: expected one of {quoted((*KINDS, *PLATES))}")
    try:
        number = [float(text) for text in row[1 : 1 + count]]
    except ValueError:
        number = []
    if len(number) < count or not all(map(math.isfinite, number)) or any(row[1 + count :]):
        raise InputError(f"{path}: line {line}: {','.join(row)}: expected {count} finite numbers after {row[0]!r}")
    points = np.array(number).reshape(-1, 3)
    if np.linalg.norm(points[1:] - points[0], axis=1).min() <= JOINT_M:
        raise InputError(f"{path}: line {line}: {','.join(row)}: expected points more than {JOINT_M} m apart")
    return points


def _width(path: Path, line: int, row: list[str], own: list[str]) -> float | None:
    """A member's own width, or None if its last column is empty. Raises `InputError`."""
    if not any(own):
        return None
    try:
        (width,) = map(float, own)
    except ValueError:
        width = math.nan
    if not 0 < width < math.inf:
        raise InputError(f"{path}: line {line}: {','.join(row)}: expected a width above 0 m, or none")
    return width


def joints_of_members(ends: Array) -> tuple[Array, list[tuple[int, ...]]]:
    """Joints ``(J, 3)`` of members with ``ends (M, 2, 3)``, and for each member the indices of its joints from end to
    end.

    A joint is placed at the first end that belongs to it or, where members cross, midway between their axes.
    """
    count = len(ends)
    points, owners = [ends.reshape(-1, 3)], [np.repeat(np.arange(count), 2)]
    for i in range(count - 1):
        on_i, on_others = _closest_points(ends[i], ends[i + 1 :])
        close = np.flatnonzero(np.linalg.norm(on_i - on_others, axis=1) <= JOINT_M)
        meeting = (on_i[close] + on_others[close]) / 2
        points += [meeting, meeting]
        owners += [np.full(len(close), i), i + 1 + close]
    point, owner = np.concatenate(points), np.concatenate(owners)
    pairs = cKDTree(point).query_pairs(JOINT_M, output_type="ndarray")
    _, first, label = np.unique(connected(pairs, len(point)), return_index=True, return_inverse=True)
    joints_of = []
    for m, (start, end) in enumerate(ends):
        own = np.unique(label[owner == m])
        inner = own[~np.isin(own, label[2 * m : 2 * m + 2])]
        inner = inner[np.argsort((point[first[inner]] - start) @ (end - start))]
        joints_of.append((int(label[2 * m]), *inner.tolist(), int(label[2 * m + 1])))
    return point[first], joints_of


def _closest_points(segment: Array, others: Array) -> tuple[Array, Array]:
    """The closest points of a ``segment (2, 3)`` and each of the ``others (N, 2, 3)``: on the segment ``(N, 3)`` and on
    the others ``(N, 3)``.

    Ericson, "Real-Time Collision Detection", 2005, section 5.1.9.
    """
    d, e, r = segment[1] - segment[0], others[:, 1] - others[:, 0], segment[0] - others[:, 0]
    dd, ee, de, dr, er = d @ d, (e * e).sum(axis=1), e @ d, r @ d, (e * r).sum(axis=1)
    sine = dd * ee - de**2
    s = np.where(sine > 1e-9 * dd * ee, np.clip((de * er - dr * ee) / np.maximum(sine, 1e-300), 0, 1), 0.0)
    t = np.clip((de * s + er) / ee, 0, 1)
    s = np.clip((de * t - dr) / dd, 0, 1)
    return segment[0] + s[:, None] * d, others[:, 0] + t[:, None] * e
