"""One step of a particle filter in blocks that stay in the first cache: move, weigh, moments; compiled by numba.

A cloud is kept as float32 x, y, yaw in three arrays (a 3 x N matrix), positions relative to an anchor near the cloud,
so that a position within 64 m of it is exact to 4 micrometres. A block is 512 particles. Every block reads its
particles through the ancestors that resampling has chosen, adds kernel noise and motion noise, however wide, from a
counter-based generator, interpolates the log density of a `Lookup`, updates the log weights and sums the moments.
Blocks do not share anything, and their sums are added in a fixed order, so threads can take any range of blocks and the
result is the same bit for bit.

Source of the layout: counter-based noise and blocks after Salmon et al. 2011 and the usual practice of tiling; the
sums are a streaming log-sum-exp with one maximum a block.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import KERNEL, F, widest
from fusion.kernels.layout import (
    ADDED,
    BLOCK,
    CLUSTER_KERNELS,
    E0,
    E3,
    KERNEL_STREAM,
    KIND,
    MAPS,
    MOTION_STREAM,
    NO_KERNEL,
    SCRATCH_SIZE,
    VOLUME,
    Float32s,
    Float64s,
    Int32s,
)
from fusion.kernels.moments import block_moments
from fusion.kernels.motion import advance, fetch, regularise, regularise_in_clusters, three_normals
from fusion.kernels.weigh import weigh_by_maps, weigh_by_volume


@numba.njit(**KERNEL)
def step_blocks(
    first: int,
    last: int,
    source: Float32s,
    ancestors: Int32s,
    labels: Int32s,
    clusters: Float32s,
    motion: Float64s,
    key: NDArray[np.uint32],
    epoch: int,
    cloud: Float32s,
    mode: int,
    table: Float32s,
    location: Float32s,
    slots: Int32s,
    look: Float64s,
    log_weights: Float64s,
    out: Float64s,
    weights: Float32s,
    sums: Float64s,
) -> None:
    """Blocks `first` to `last` of one step.

    Parameters
    ----------
    first, last
        Blocks; particles ``first * BLOCK`` up to ``last * BLOCK``, cut at the end of the cloud.
    source, ancestors
        (3 M,) x, y, yaw before the step, and (N,) whom to copy; without ancestors M is N and everyone stays.
    labels, clusters
        (N,) cluster of each particle after the copying, and the clusters' rows, see `fusion.kernels.layout`; both empty
        unless the motion has a kernel for each cluster.
    motion
        (MOTION_SIZE,) as `fusion.particles.cloud` packs it; empty when nobody moves: then `cloud` is read, not written.
    key, epoch
        Of the random numbers.
    cloud
        (3 N,) x, y, yaw after the step.
    mode
        NOTHING, VOLUME or MAPS: how to weigh.
    table, location, slots, look
        As `fusion.particles.lookup` packs them.
    log_weights
        (N,) before the step; empty for equal ones, which then count as 0.
    out
        (N,) log weights after the step, not normalised.
    weights
        (N,) over the largest of their block.
    sums
        (blocks, SUMS), the moments of each block.
    """
    widest()
    count = cloud.size // 3
    s = np.empty(SCRATCH_SIZE, np.float32)
    everyone = np.empty(0, np.int32)
    word = np.uint32(epoch)
    for block in range(first, last):
        start = block * BLOCK
        n = min(BLOCK, count - start)
        if motion.size > 0:
            fetch(source, ancestors, start, n, s)
            three_normals(start, n, word, MOTION_STREAM, key, E0, s)
            if motion[KIND] != NO_KERNEL:
                three_normals(start, n, word, KERNEL_STREAM, key, E3, s)
                if motion[KIND] == CLUSTER_KERNELS:
                    regularise_in_clusters(start, n, labels, clusters, s)
                else:
                    regularise(n, motion, s)
            advance(n, motion, s)
            for axis in range(3):
                for j in range(n):
                    cloud[axis * count + start + j] = s[axis * BLOCK + j]
        else:
            fetch(cloud, everyone, start, n, s)
        if mode == VOLUME:
            weigh_by_volume(n, table, look, s)
        elif mode == MAPS:
            weigh_by_maps(n, table, location, slots, look, s)
        else:
            for j in range(n):
                s[ADDED + j] = F(0)
        block_moments(start, n, log_weights, out, look, s, weights, sums[block])
