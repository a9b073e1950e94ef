"""The voxels around each voxel, by one sweep through the sorted keys of all: a hash table would be asked hundreds of
times a voxel, mostly for voxels that do not exist."""

from typing import NamedTuple

import numpy as np

from steelnb.core.kernels import njit
from steelnb.core.types import IntArray


class Columns(NamedTuple):
    """Offsets of keys (`voxel_kernels.pack`) in C columns along z: ``low (C,)`` and ``high (C,)`` of each, where it
    begins in ``place`` ``(C,)``, and ``place (K,)`` of each offset in the order of `offsets_within`."""

    low: IntArray
    high: IntArray
    begin: IntArray
    place: IntArray


def columns_of(offsets: IntArray) -> Columns:
    """The columns of the ``offsets (K,)`` of a ball."""
    place = np.argsort(offsets, kind="stable")
    ordered = offsets[place]
    begin = np.flatnonzero(np.diff(ordered, prepend=ordered[0] - 2) != 1)
    return Columns(ordered[begin], ordered[np.append(begin[1:], len(ordered)) - 1], begin, place)


@njit(cache=True, nogil=True)
def advance(key, n, columns, first, last):
    """Move the ranges ``first (C,)`` and ``last (C,)`` of the sorted keys in each column on to the voxel ``n``, from
    that before or from 0; returns the number of voxels in them."""
    count = 0
    for c in range(len(first)):
        low, high = key[n] + columns.low[c], key[n] + columns.high[c]
        begin = first[c]
        while begin < len(key) and key[begin] < low:
            begin += 1
        end = max(begin, last[c])
        while end < len(key) and key[end] <= high:
            end += 1
        first[c], last[c] = begin, end
        count += end - begin
    return count


@njit(cache=True, nogil=True)
def gather(key, n, columns, first, last, at, found):
    """Write the voxels in the ranges to ``found (K,)``, in the order of `offsets_within`; returns their number. The
    buffer ``at (K,)`` holds −1, and does so again on return."""
    for c in range(len(first)):
        base = columns.begin[c] - key[n] - columns.low[c]
        for k in range(first[c], last[c]):
            at[columns.place[base + key[k]]] = k
    count = 0
    for k in range(len(at)):
        if at[k] >= 0:
            found[count] = at[k]
            count += 1
            at[k] = -1
    return count
