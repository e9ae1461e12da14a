"""Systematic resampling almost without a branch: the ancestors of equally weighted particles from weights.

Of every particle the position of its share in the cumulative weight says which of the new particles is its first. Each
particle's number is written there eight times over, in one store, and the next particle's over it: whether a particle
gets none, one or eight copies, the processor has nothing to guess.

Source of systematic resampling: Kitagawa, "Monte Carlo filter and smoother", 1996, appendix.
"""

import numba
import numpy as np

from fusion.kernels.float_math import COPIES, KERNEL, put_copies, widest
from fusion.kernels.layout import BLOCK, LARGEST, WEIGHT, Float32s, Float64s, Int32s

_LANE = BLOCK // 4  # four running sums that do not wait for each other


@numba.njit(**KERNEL)
def share_out(sums: Float64s, count: int, edges: Float64s) -> None:
    """The weight before each block (blocks + 1,), in new particles: from 0 to `count`."""
    largest = sums[0, LARGEST]
    for block in range(len(sums)):
        largest = max(largest, sums[block, LARGEST])
    edges[0] = 0.0
    for block in range(len(sums)):
        edges[block + 1] = edges[block] + sums[block, WEIGHT] * np.exp(sums[block, LARGEST] - largest)
    scale = count / edges[len(sums)]
    for block in range(len(sums) + 1):
        edges[block] *= scale


@numba.njit(fastmath=False, nogil=True, error_model="numpy", cache=True)
def _running(start: int, n: int, weights: Float32s, before: Float64s) -> None:
    """Sum of the weights before each particle of a block, and of all of them."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    if n < BLOCK:
        for j in range(n):
            before[j] = a
            a += np.float64(weights[start + j])
        before[n] = a
        return
    for j in range(_LANE):
        before[j], before[_LANE + j], before[2 * _LANE + j], before[3 * _LANE + j] = a, b, c, d
        a += np.float64(weights[start + j])
        b += np.float64(weights[start + _LANE + j])
        c += np.float64(weights[start + 2 * _LANE + j])
        d += np.float64(weights[start + 3 * _LANE + j])
    b += a
    c += b
    for j in range(_LANE):
        before[_LANE + j] += a
        before[2 * _LANE + j] += b
        before[3 * _LANE + j] += c
    before[BLOCK] = c + d


@numba.njit(**KERNEL)
def spread_blocks(
    first: int,
    last: int,
    weights: Float32s,
    edges: Float64s,
    offset: float,
    ancestors: Int32s,
) -> None:
    """Ancestors out of blocks `first` to `last`.

    Parameters
    ----------
    weights
        (N,) over the largest of their block, none of them 0.
    edges
        (blocks + 1,) cumulative weight before each block, in new particles: from 0 to n.
    offset
        In [0, 1): where in its n-th part each new particle looks.
    ancestors
        (n,) to fill.
    """
    widest()
    before, firsts = np.empty(BLOCK + 1), np.empty(BLOCK + 1, np.int64)
    for block in range(first, last):
        low, high = int(np.ceil(edges[block] - offset)), int(np.ceil(edges[block + 1] - offset))
        if block == 0:
            low = 0
        if block == len(edges) - 2:
            high = len(ancestors)
        if high <= low:
            continue
        start = block * BLOCK
        n = min(BLOCK, len(weights) - start)
        _running(start, n, weights, before)
        scale, shift = (edges[block + 1] - edges[block]) / before[n], edges[block] - offset
        for j in range(n):
            firsts[j] = np.int64(min(max(np.ceil(before[j] * scale + shift), low), high))
        firsts[0], firsts[n] = low, high
        j = 0
        while firsts[j] <= high - COPIES:
            put_copies(ancestors, firsts[j], np.int32(start + j))
            for k in range(firsts[j] + COPIES, firsts[j + 1]):
                ancestors[k] = start + j
            j += 1
        while j < n:
            for k in range(firsts[j], firsts[j + 1]):
                ancestors[k] = start + j
            j += 1
