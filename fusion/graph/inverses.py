"""Inverses of many matrices of three by three in one compiled pass: numpy's own call LAPACK for each of them."""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray
from fusion.graph.chain_algebra import OPTIONS, invert


def inverses(matrices: FloatArray) -> FloatArray:
    """Of matrices (M, 3, 3) with rows and columns of similar scales, or triangular ones."""
    found = np.empty(matrices.shape)
    _invert_all(matrices, found)
    return found


@numba.njit(**OPTIONS)
def _invert_all(matrices: NDArray[np.float64], found: NDArray[np.float64]) -> None:
    for k in range(len(matrices)):
        invert(matrices[k], found[k])
