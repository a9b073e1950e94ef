"""LZF, the compression of PCD files."""

import numpy as np
from numpy.typing import NDArray

from steelnb.core.kernels import njit


def lzf_unpacked(packed: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Uncompress data of LibLZF, by Marc Lehmann. Raises ValueError if they do not fill exactly ``size`` bytes."""
    unpacked = np.zeros(size, np.uint8)
    if not _unpack(packed, unpacked):
        raise ValueError("its compressed data are damaged")
    return unpacked


@njit(cache=True)
def _unpack(packed, unpacked):
    """Whether the data are sound. A control byte below 32 is followed by that many bytes and one more; else its three
    upper bits, with a further byte if all are set, are the length of an earlier stretch that is repeated."""
    at, to, end, size = 0, 0, len(packed), len(unpacked)
    while at < end:
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > end or to + length > size:
                return False
            for k in range(length):
                unpacked[to + k] = packed[at + k]
            at += length
        else:
            length = (control >> 5) + 2
            if length == 9:
                if at >= end:
                    return False
                length += int(packed[at])
                at += 1
            if at >= end:
                return False
            source = to - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            if source < 0 or to + length > size:
                return False
            for k in range(length):  # the stretch may overlap its own copy
                unpacked[to + k] = unpacked[source + k]
        to += length
    return to == size
