"""Compiled work on the blocks of a cloud, shared among threads when that pays; the result does not depend on it."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import Float32Array, FloatArray
from fusion.kernels.resample import share_out, spread_blocks

_LEAST_BLOCKS = 8  # a thread


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="skyfix")


def share(threads: int, kernel: Any, blocks: int, *arguments: Any) -> None:
    """Run a kernel ``(first, last, *arguments)`` over all blocks, on as many of some threads as are worth having.

    One thread calls the kernel that several call: inlined into another kernel, it may be compiled to other roundings.
    """
    threads = max(1, min(threads, blocks // _LEAST_BLOCKS))
    if threads == 1:
        kernel(0, blocks, *arguments)
        return
    edges = [blocks * part // threads for part in range(threads + 1)]
    work = [_pool(threads).submit(kernel, a, b, *arguments) for a, b in pairwise(edges[1:])]
    kernel(edges[0], edges[1], *arguments)
    for each in work:
        each.result()


def find_ancestors(
    threads: int, weights: Float32Array, sums: FloatArray, offset: float, ancestors: NDArray[np.int32]
) -> None:
    """Fill in the ancestors (n,) of systematic resampling, see `fusion.kernels.resample`."""
    blocks = len(sums)
    edges = np.empty(blocks + 1)
    share_out(sums, len(ancestors), edges)
    share(threads, spread_blocks, blocks, weights, edges, offset, ancestors)
