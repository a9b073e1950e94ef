"""Paths of which each message has only the latest poses."""

from collections.abc import Sequence

import numpy as np

from steelnb.core.types import Array

SAME_PLACE_M = 0.05
"""Largest distance of poses of one stamp in messages of one path."""


def whole_path(earlier: Sequence[Array], last: Array) -> Array:
    """Rows ``(N, 8)`` of a path of which each message has only the latest poses, rising by stamp: ``last (M, 8)``, and
    what ``earlier`` ones had before, back to the first that shares no stamp with those after it or has other places."""
    for rows in reversed(earlier):
        _, ours, theirs = np.intersect1d(last[:, 0], rows[:, 0], return_indices=True)
        if not len(ours) or np.abs(last[ours, 1:4] - rows[theirs, 1:4]).max() > SAME_PLACE_M:
            break
        last = np.concatenate([last, rows[~np.isin(rows[:, 0], last[:, 0])]])
    return last[np.argsort(last[:, 0], kind="stable")] if len(earlier) else last
