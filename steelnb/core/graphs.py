"""What hangs together."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from steelnb.core.types import IntArray


def connected(pairs: IntArray, count: int) -> IntArray:
    """Number of the group of each of ``count`` things ``(N,)``, of which ``pairs (P, 2)`` belong together."""
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
