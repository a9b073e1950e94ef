"""Normal equations of a chain of poses, each tied to its neighbours: a block tridiagonal matrix and its factor."""

from typing import NamedTuple

import numpy as np
from numba import njit

from steelnb.types import Array

TINY = 1e-12
"""What is smaller counts as zero: what a bar tells fades from pose to pose once it is out of view, and numbers that
fade on until they are denormal take long."""


class Chain(NamedTuple):
    """The factor L of a matrix A = L Lᵀ of K poses: inverses of its diagonal blocks ``own (K, D, D)``; and the share of
    the neighbour's solution in that of each pose, of the one before in L⁻¹, ``onward (K, D, D)``, and of the one behind
    in L⁻ᵀ, ``back (K, D, D)``."""

    own: Array
    onward: Array
    back: Array

    @classmethod
    def factored(cls, matrix: Array, beside: Array) -> "Chain":
        """From the blocks of A on its diagonal ``(K, D, D)`` and above it ``(K − 1, D, D)``.

        Raises `numpy.linalg.LinAlgError` where A is not positive definite.
        """
        chain = cls(*np.zeros((3, *matrix.shape)))
        _factor(np.ascontiguousarray(matrix), np.ascontiguousarray(beside), *chain)
        return chain

    def half(self, right: Array) -> Array:
        """L⁻¹ times the columns ``right (K, D, M)``."""
        result = self.own @ right
        _sweep(self.onward, result, False)
        return result

    def rest(self, half: Array) -> Array:
        """L⁻ᵀ times the columns ``half (K, D, M)``: A⁻¹ times columns, where ``half`` is L⁻¹ times them."""
        result = self.own.transpose(0, 2, 1) @ half
        _sweep(self.back, result, True)
        return result

    def inverse_blocks(self) -> Array:
        """The blocks on the diagonal of A⁻¹ ``(K, D, D)``, from the last to the first (Takahashi, Fagan, Chen 1973)."""
        result = self.own.transpose(0, 2, 1) @ self.own
        for k in range(len(result) - 2, -1, -1):
            result[k] += self.back[k] @ result[k + 1] @ self.back[k].T
        return result


@njit(cache=True)
def _factor(matrix, beside, own, onward, back):  # type: ignore[no-untyped-def]
    for k in range(len(matrix)):
        block = matrix[k].copy()
        if k:
            above = own[k - 1] @ beside[k - 1]  # the block of Lᵀ
            block -= above.T @ above
        own[k] = np.linalg.inv(np.linalg.cholesky(block))
        if k:
            onward[k] = -own[k] @ above.T
            back[k - 1] = -own[k - 1].T @ above


@njit(cache=True)
def _sweep(share, columns, backwards):  # type: ignore[no-untyped-def]
    """Add to the columns of each pose their share of those of its neighbour, from neighbour to neighbour."""
    poses, size, count = columns.shape
    for i in range(1, poses):
        k, other = (poses - 1 - i, poses - i) if backwards else (i, i - 1)
        for m in range(count):
            largest = 0.0
            for d in range(size):
                largest = max(largest, abs(columns[other, d, m]))
            if largest > TINY:
                for n in range(size):
                    for d in range(size):
                        columns[k, n, m] += share[k, n, d] * columns[other, d, m]
