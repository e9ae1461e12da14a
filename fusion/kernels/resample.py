"""Systematic resampling without a branch: the ancestors of equally weighted particles from log weights.

Of every particle the position of its share in the cumulative weight says which of the new particles is its first.
Writing each particle's number there, later ones over earlier ones, and carrying the largest number forward fills the
list of ancestors; nowhere does the processor have to guess how many copies a particle gets.

Source of systematic resampling: Kitagawa, "Monte Carlo filter and smoother", 1996, appendix.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import KERNEL, F, exp
from fusion.kernels.layout import BLOCK, LARGEST

_LANES = 4  # running sums that do not wait for each other


@numba.njit(**KERNEL)
def block_masses(
    first: int, last: int, log_weights: NDArray[np.float64], sums: NDArray[np.float64], masses: NDArray[np.float64]
) -> None:
    """Total weight of each block over the exponential of its largest, added as `spread_blocks` adds."""
    weights = np.zeros(BLOCK, np.float32)
    for block in range(first, last):
        start = block * BLOCK
        n = min(BLOCK, len(log_weights) - start)
        _weights(start, n, log_weights, sums[block, LARGEST], weights)
        masses[block] = _lane_totals(weights).sum()


@numba.njit(**KERNEL)
def share_out(sums: NDArray[np.float64], masses: NDArray[np.float64], count: int, edges: NDArray[np.float64]) -> None:
    """The weight before each block (blocks + 1,), in new particles: from 0 to `count`."""
    largest = sums[0, LARGEST]
    for block in range(len(masses)):
        largest = max(largest, sums[block, LARGEST])
    edges[0] = 0.0
    for block in range(len(masses)):
        edges[block + 1] = edges[block] + masses[block] * np.exp(sums[block, LARGEST] - largest)
    scale = count / edges[len(masses)]
    for block in range(len(masses) + 1):
        edges[block] *= scale


@numba.njit(**KERNEL)
def _weights(
    start: int, n: int, log_weights: NDArray[np.float64], largest: float, weights: NDArray[np.float32]
) -> None:
    for j in range(n):
        weights[j] = exp(F(log_weights[start + j] - largest))
    for j in range(n, BLOCK):
        weights[j] = F(0.0)


@numba.njit(**KERNEL)
def _lane_totals(weights: NDArray[np.float32]) -> NDArray[np.float64]:
    width = BLOCK // _LANES
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for j in range(width):
        a += np.float64(weights[j])
        b += np.float64(weights[width + j])
        c += np.float64(weights[2 * width + j])
        d += np.float64(weights[3 * width + j])
    totals = np.empty(_LANES)
    totals[0], totals[1], totals[2], totals[3] = a, b, c, d
    return totals


@numba.njit(fastmath=False, nogil=True, error_model="numpy", cache=True)
def _running(weights: NDArray[np.float32], begin: NDArray[np.float64], before: NDArray[np.float64]) -> None:
    """Sum of the weights before each particle of a block."""
    width = BLOCK // _LANES
    a, b, c, d = begin[0], begin[1], begin[2], begin[3]
    for j in range(width):
        before[j], before[width + j], before[2 * width + j], before[3 * width + j] = a, b, c, d
        a += np.float64(weights[j])
        b += np.float64(weights[width + j])
        c += np.float64(weights[2 * width + j])
        d += np.float64(weights[3 * width + j])


@numba.njit(**KERNEL)
def spread_blocks(
    first: int,
    last: int,
    log_weights: NDArray[np.float64],
    sums: NDArray[np.float64],
    masses: NDArray[np.float64],
    edges: NDArray[np.float64],
    offset: float,
    ancestors: NDArray[np.int32],
) -> None:
    """Ancestors out of blocks `first` to `last`.

    Parameters
    ----------
    log_weights, sums, masses
        (N,) log weights; the blocks' largest; the blocks' `block_masses`.
    edges
        (blocks + 1,) cumulative weight before each block, in new particles: from 0 to n.
    offset
        In [0, 1): where in its n-th part each new particle looks.
    ancestors
        (n,) to fill.
    """
    weights, before, begin = np.zeros(BLOCK, np.float32), np.empty(BLOCK), np.empty(_LANES)
    firsts = np.empty(BLOCK, np.int64)
    for block in range(first, last):
        low, high = int(np.ceil(edges[block] - offset)), int(np.ceil(edges[block + 1] - offset))
        if block == 0:
            low = 0
        if block == len(masses) - 1:
            high = len(ancestors)
        if high <= low:
            continue
        start = block * BLOCK
        n = min(BLOCK, len(log_weights) - start)
        _weights(start, n, log_weights, sums[block, LARGEST], weights)
        totals = _lane_totals(weights)
        begin[0] = 0.0
        for lane in range(1, _LANES):
            begin[lane] = begin[lane - 1] + totals[lane - 1]
        _running(weights, begin, before)
        scale = (edges[block + 1] - edges[block]) / masses[block]
        shift = edges[block] - offset
        for j in range(n):
            firsts[j] = np.int64(np.ceil(before[j] * scale + shift))
        for k in range(low, high):
            ancestors[k] = 0
        for j in range(n):
            if weights[j] > F(0.0) and firsts[j] < high:
                ancestors[max(firsts[j], low)] = start + j
        largest = ancestors[low]
        for k in range(low, high):
            largest = max(largest, ancestors[k])
            ancestors[k] = largest
