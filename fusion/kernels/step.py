"""One step of a particle filter in blocks that stay in the first cache: move, weigh, moments; compiled by numba.

A cloud is kept as float32 x, y, yaw in three arrays (a 3 x N matrix), positions relative to an anchor near the cloud,
so that a position within 64 m of it is exact to 4 micrometres. A block is 1024 particles. Every block reads its
particles through the ancestors that resampling has chosen, adds kernel noise and motion noise from a counter-based
generator, interpolates the log density of a `Lookup`, updates the log weights and sums the moments. Blocks do not
share anything, and their sums are added in a fixed order, so threads can take any range of blocks and the result
is the same bit for bit.

Source of the layout: counter-based noise and blocks after Salmon et al. 2011 and the usual practice of tiling; the
sums are a streaming log-sum-exp with one maximum a block.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import (
    INLINED,
    KERNEL,
    F,
    exp,
    get,
    larger,
    log,
    put,
    sine_cosine,
    take,
    wrap,
)
from fusion.kernels.random import U, normal_pair, threefry

BLOCK = 1024
SCRATCH_SIZE = 11 * BLOCK
"""float32 numbers that one thread needs beside its particles."""

X, Y, T, ADDED, WEIGHTS, E0, E1, E2, E3, E4, E5 = (row * BLOCK for row in range(11))
"""Where the parts of a thread's scratch begin."""

# rows of a block's sums
LARGEST, WEIGHT, SQUARED, SUM_X, SUM_Y, SUM_SIN, SUM_COS = 0, 1, 2, 3, 4, 5, 6
SUM_XX, SUM_XY, SUM_YY, SUM_D, SUM_XD, SUM_YD, SUM_DD, FAR = 7, 8, 9, 10, 11, 12, 13, 14
SUMS = 15

# motion: (n,) float64 arguments of a move
MOTION_SIZE = 32
DELTA, ROOT, SHIFT = 0, 3, 12  # increment (3), lower root of its covariance (9, row by row), change of anchor (2)
CENTRE, SHRINK, KERNEL_ROOT, KERNEL_ON = 14, 17, 18, 27  # regularisation: mean (3), factor, root of the kernel (9)
MOVED = 28  # not 0 when there is an increment, and not only resampling to carry out

# weighing: (n,) float64 arguments of a lookup
LOOKUP_SIZE = 16
COL_SCALE, COL_SHIFT, ROW_SCALE, ROW_SHIFT, YAW_SCALE = 0, 1, 2, 3, 4
TEMPER_SCALE, TEMPER_SHIFT, FLOOR_BEFORE, FLOOR, INLIER, UNIFORM = 5, 6, 7, 8, 9, 10
REFERENCE_X, REFERENCE_Y, REFERENCE_YAW, LOG_SHIFT = 11, 12, 13, 14

NOTHING, VOLUME, MAPS = 0, 1, 2
"""What to weigh by."""

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


@numba.njit(**KERNEL)
def three_normals(start: int, n: int, step: np.uint32, key: NDArray[np.uint32], s: Float32s) -> None:
    """Normals for n particles from `start` on, into E0, E1 and E2 of the scratch `s`."""
    words = (key[0], key[1], key[2], key[3])
    for j in range(n):
        a, b, _, d = threefry((U(start + j), step, U(0), U(0)), words)
        first, second = normal_pair(a, d)
        third, _ = normal_pair(b, U(d >> U(10)))
        s[E0 + j], s[E1 + j], s[E2 + j] = first, second, third


@numba.njit(**KERNEL)
def _six_normals(start: int, n: int, step: np.uint32, key: NDArray[np.uint32], s: Float32s) -> None:
    words = (key[0], key[1], key[2], key[3])
    for j in range(n):
        a, b, c, d = threefry((U(start + j), step, U(0), U(0)), words)
        first, second = normal_pair(a, d)
        third, fourth = normal_pair(b, U(d >> U(10)))
        fifth, sixth = normal_pair(c, U(d >> U(20)))
        s[E0 + j], s[E1 + j], s[E2 + j] = first, second, third
        s[E3 + j], s[E4 + j], s[E5 + j] = fourth, fifth, sixth


@numba.njit(**KERNEL)
def _fetch(source: Float32s, ancestors: NDArray[np.int32], start: int, n: int, s: Float32s) -> None:
    """Read the ancestors of a block, or the block itself when nothing has been resampled."""
    size = source.size // 3
    for axis in range(3):
        offset = axis * size
        if ancestors.size == 0:
            for j in range(n):
                s[axis * BLOCK + j] = source[offset + start + j]
        else:
            column = source[offset : offset + size]
            for j in range(n):
                put(s, axis * BLOCK + j, take(column, take(ancestors, np.int32(start + j))))


@numba.njit(**KERNEL)
def _regularise(n: int, motion: Float64s, s: Float32s) -> None:
    """Draw a block towards the mean and add kernel noise, see `fusion.particles.regularisation`."""
    mx, my, mt, shrink = F(motion[14]), F(motion[15]), F(motion[16]), F(motion[17])
    r00, r10, r11 = F(motion[18]), F(motion[21]), F(motion[22])
    r20, r21, r22 = F(motion[24]), F(motion[25]), F(motion[26])
    for j in range(n):
        e0, e1, e2 = s[E3 + j], s[E4 + j], s[E5 + j]
        s[X + j] = mx + shrink * (s[X + j] - mx) + r00 * e0
        s[Y + j] = my + shrink * (s[Y + j] - my) + (r10 * e0 + r11 * e1)
        turned = mt + shrink * wrap(s[T + j] - mt)
        s[T + j] = wrap(turned + (r20 * e0 + r21 * e1 + r22 * e2))


@numba.njit(**KERNEL)
def _advance(n: int, motion: Float64s, s: Float32s) -> None:
    """Compose a block with the increment and its noise."""
    dx, dy, dt = F(motion[0]), F(motion[1]), F(motion[2])
    r00, r10, r11 = F(motion[3]), F(motion[6]), F(motion[7])
    r20, r21, r22 = F(motion[9]), F(motion[10]), F(motion[11])
    sx, sy = F(motion[12]), F(motion[13])
    for j in range(n):
        e0, e1, e2 = s[E0 + j], s[E1 + j], s[E2 + j]
        yaw = s[T + j]
        forward = dx + r00 * e0
        left = dy + (r10 * e0 + r11 * e1)
        sine, cosine = sine_cosine(yaw)
        s[X + j] = (s[X + j] - sx) + (cosine * forward - sine * left)
        s[Y + j] = (s[Y + j] - sy) + (sine * forward + cosine * left)
        s[T + j] = wrap(yaw + (dt + (r20 * e0 + r21 * e1 + r22 * e2)))


@numba.njit(**INLINED)
def _cell(position: F, count: np.int32) -> tuple[np.int32, np.int32, F]:
    """Lower cell, step to the upper one and weight of the upper one, of a position in cells from the edge."""
    last = F(count) - F(1.0)
    inner = larger(position - F(0.5), F(0.0))
    inner = min(last, inner)
    highest = np.int32(count - 2) if count > 2 else np.int32(0)
    lower = np.int32(inner)
    lower = min(highest, lower)
    return lower, np.int32(1) if count > 1 else np.int32(0), inner - F(lower)


@numba.njit(**INLINED)
def _bin(yaw: F, scale: F, bins: np.int32) -> tuple[np.int32, np.int32, F]:
    """Lower bin, upper bin and weight of the upper one, of a heading in [-pi, pi)."""
    turns = yaw * scale
    turns = turns + F(bins) if turns < F(0.0) else turns
    lower = np.int32(turns)
    lower = lower if lower < bins else np.int32(bins - 1)
    upper = np.int32(lower + 1)
    return lower, upper if upper < bins else np.int32(0), turns - F(lower)


@numba.njit(**INLINED)
def _level(value: np.float32, scale: np.float32, shift: np.float32, before: np.float32, floor: np.float32) -> F:
    """A cell's ln density after tempering, which leaves alone what was not evaluated."""
    return scale * value + shift if value > before else floor


@numba.njit(**KERNEL)
def _weigh_by_volume(n: int, table: Float32s, shape: NDArray[np.int64], look: Float64s, s: Float32s) -> None:
    """ln density of a block under a volume that has the headings of a cell side by side."""
    rows, cols, bins = np.int32(shape[0]), np.int32(shape[1]), np.int32(shape[2])
    cs, c0, rs, r0, ks = F(look[0]), F(look[1]), F(look[2]), F(look[3]), F(look[4])
    scale, shift, before, floor = F(look[5]), F(look[6]), F(look[7]), F(look[8])
    inlier, uniform = F(look[9]), F(look[10])
    row_stride = np.int32(cols * bins)
    for j in range(n):
        u, v = c0 + cs * get(s, X + j), r0 + rs * get(s, Y + j)
        col, east, cw = _cell(u, cols)
        row, south, rw = _cell(v, rows)
        k, upper, kw = _bin(get(s, T + j), ks, bins)
        a = np.int32(np.int32(row * row_stride) + np.int32(col * bins))
        b = np.int32(a + np.int32(east * bins))
        down = np.int32(south * row_stride)
        c, d = np.int32(a + down), np.int32(b + down)
        low = _level(take(table, np.int32(a + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(a + upper)), scale, shift, before, floor)
        nw = low + kw * (high - low)
        low = _level(take(table, np.int32(b + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(b + upper)), scale, shift, before, floor)
        ne = low + kw * (high - low)
        low = _level(take(table, np.int32(c + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(c + upper)), scale, shift, before, floor)
        sw = low + kw * (high - low)
        low = _level(take(table, np.int32(d + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(d + upper)), scale, shift, before, floor)
        se = low + kw * (high - low)
        north, far = nw + cw * (ne - nw), sw + cw * (se - sw)
        total = larger(north + rw * (far - north), floor)
        inside = (u >= F(0.0)) & (u <= F(cols)) & (v >= F(0.0)) & (v <= F(rows))
        put(s, ADDED + j, log(inlier * exp(total if inside else floor) + uniform))


@numba.njit(**INLINED)
def _pixel_level(
    pixel: np.int32, lower: np.int32, upper: np.int32, kw: F, table: Float32s, location: Float32s, terms: tuple[F, F, F]
) -> F:
    """ln density at a pixel between two headings of it."""
    scale, shift, floor = terms
    at = take(location, pixel)
    low = larger(scale * (at + take(table, lower)) + shift, floor)
    high = larger(scale * (at + take(table, upper)) + shift, floor)
    return low + kw * (high - low)


@numba.njit(**KERNEL)
def _weigh_by_maps(
    n: int,
    table: Float32s,
    location: Float32s,
    slots: NDArray[np.int32],
    shape: NDArray[np.int64],
    look: Float64s,
    s: Float32s,
) -> None:
    """ln density of a block under a map of positions and, at every pixel, a distribution of headings."""
    rows, cols, bins = np.int32(shape[0]), np.int32(shape[1]), np.int32(shape[2])
    pixel_stride, bin_stride = np.int32(shape[3]), np.int32(shape[4])
    cs, c0, rs, r0, ks = F(look[0]), F(look[1]), F(look[2]), F(look[3]), F(look[4])
    floor, inlier, uniform = F(look[8]), F(look[9]), F(look[10])
    terms = (F(look[5]), F(look[6]), floor)
    for j in range(n):
        u, v = c0 + cs * get(s, X + j), r0 + rs * get(s, Y + j)
        col, east, cw = _cell(u, cols)
        row, south, rw = _cell(v, rows)
        k, upper, kw = _bin(get(s, T + j), ks, bins)
        k, upper = np.int32(k * bin_stride), np.int32(upper * bin_stride)
        a = np.int32(np.int32(row * cols) + col)
        b, c = np.int32(a + east), np.int32(a + np.int32(south * cols))
        d = np.int32(c + east)
        at_a, at_b = np.int32(take(slots, a) * pixel_stride), np.int32(take(slots, b) * pixel_stride)
        at_c, at_d = np.int32(take(slots, c) * pixel_stride), np.int32(take(slots, d) * pixel_stride)
        nw = _pixel_level(a, np.int32(at_a + k), np.int32(at_a + upper), kw, table, location, terms)
        ne = _pixel_level(b, np.int32(at_b + k), np.int32(at_b + upper), kw, table, location, terms)
        sw = _pixel_level(c, np.int32(at_c + k), np.int32(at_c + upper), kw, table, location, terms)
        se = _pixel_level(d, np.int32(at_d + k), np.int32(at_d + upper), kw, table, location, terms)
        north, far = nw + cw * (ne - nw), sw + cw * (se - sw)
        total = north + rw * (far - north)
        inside = (u >= F(0.0)) & (u <= F(cols)) & (v >= F(0.0)) & (v <= F(rows))
        put(s, ADDED + j, log(inlier * exp(total if inside else floor) + uniform))


@numba.njit(**KERNEL)
def _moments(
    start: int, n: int, log_weights: Float64s, out: Float64s, look: Float64s, s: Float32s, sums: Float64s
) -> None:
    """New log weights of a block, and the sums of its moments about the reference pose."""
    if log_weights.size > 0:
        shift = look[LOG_SHIFT]
        for j in range(n):
            value = (log_weights[start + j] - shift) + s[ADDED + j]
            out[start + j] = value
            s[ADDED + j] = F(value)
    else:
        for j in range(n):
            out[start + j] = s[ADDED + j]
    largest = F(-3e38)
    for j in range(n):
        largest = larger(s[ADDED + j], largest)
    rx, ry, rt = F(look[11]), F(look[12]), F(look[13])
    total, squared = F(0), F(0)
    sum_x, sum_y, sum_d, sum_s, sum_c = F(0), F(0), F(0), F(0), F(0)
    xx, xy, yy, xd, yd, dd, far = F(0), F(0), F(0), F(0), F(0), F(0), F(0)
    for j in range(n):
        w = exp(s[ADDED + j] - largest)
        x, y, d = s[X + j] - rx, s[Y + j] - ry, wrap(s[T + j] - rt)
        sine, cosine = sine_cosine(d)
        total += w
        squared += w * w
        sum_s += w * sine
        sum_c += w * cosine
        wx, wy, wd = w * x, w * y, w * d
        sum_x += wx
        sum_y += wy
        sum_d += wd
        xx += wx * x
        xy += wx * y
        yy += wy * y
        xd += wd * x
        yd += wd * y
        dd += wd * d
        far = larger(larger(d, -d), far)
    sums[0], sums[1], sums[2] = largest, total, squared
    sums[3], sums[4], sums[5], sums[6] = sum_x, sum_y, sum_s, sum_c
    sums[7], sums[8], sums[9] = xx, xy, yy
    sums[10], sums[11], sums[12], sums[13], sums[14] = sum_d, xd, yd, dd, far


@numba.njit(**KERNEL)
def step_blocks(
    first: int,
    last: int,
    source: Float32s,
    ancestors: NDArray[np.int32],
    motion: Float64s,
    key: NDArray[np.uint32],
    epoch: np.uint32,
    cloud: Float32s,
    mode: int,
    table: Float32s,
    location: Float32s,
    slots: NDArray[np.int32],
    shape: NDArray[np.int64],
    look: Float64s,
    log_weights: Float64s,
    out: Float64s,
    sums: Float64s,
) -> None:
    """Blocks `first` to `last` of one step.

    Parameters
    ----------
    first, last
        Blocks; particles ``first * BLOCK`` up to ``last * BLOCK``, cut at the end of the cloud.
    source, ancestors
        (3 M,) x, y, yaw before the step, and (N,) whom to copy; without ancestors M is N and everyone stays.
    motion
        (MOTION_SIZE,) as `fusion.particles.cloud` packs it; empty when nobody moves: then `cloud` is read, not written.
    key, epoch
        Of the random numbers.
    cloud
        (3 N,) x, y, yaw after the step.
    mode
        NOTHING, VOLUME or MAPS: how to weigh.
    table, location, slots, shape, look
        As `fusion.particles.lookup` packs them.
    log_weights
        (N,) before the step; empty for equal ones, which then count as 0.
    out
        (N,) log weights after the step, not normalised.
    sums
        (blocks, SUMS), the moments of each block.
    """
    count = cloud.size // 3
    s = np.empty(SCRATCH_SIZE, np.float32)
    everyone = np.empty(0, np.int32)
    for block in range(first, last):
        start = block * BLOCK
        n = min(BLOCK, count - start)
        if motion.size > 0:
            _fetch(source, ancestors, start, n, s)
            if motion[KERNEL_ON] > 0.0:
                _six_normals(start, n, epoch, key, s)
                _regularise(n, motion, s)
            else:
                three_normals(start, n, epoch, key, s)
            _advance(n, motion, s)
            for axis in range(3):
                for j in range(n):
                    cloud[axis * count + start + j] = s[axis * BLOCK + j]
        else:
            _fetch(cloud, everyone, start, n, s)
        if mode == VOLUME:
            _weigh_by_volume(n, table, shape, look, s)
        elif mode == MAPS:
            _weigh_by_maps(n, table, location, slots, shape, look, s)
        else:
            for j in range(n):
                s[ADDED + j] = F(0)
        _moments(start, n, log_weights, out, look, s, sums[block])


@numba.njit(**KERNEL)
def combined(sums: Float64s, look: Float64s) -> Float64s:
    """Moments of a whole cloud from those of its blocks, added in order.

    Returns
    -------
    (13,) float64
        The largest log weight, ln of the sum of the weights, the effective sample size; x, y and yaw of the mean
        (yaw not wrapped); the covariance's xx, xy, yy, xt, yt, tt about it; and how far the yaws lie from the
        reference, at most. No correction for the sample's size.
    """
    largest = sums[0, LARGEST]
    for block in range(1, len(sums)):
        largest = max(largest, sums[block, LARGEST])
    t = np.zeros(SUMS)
    for block in range(len(sums)):
        scale = np.exp(sums[block, LARGEST] - largest)
        t[WEIGHT] += sums[block, WEIGHT] * scale
        t[SQUARED] += sums[block, SQUARED] * (scale * scale)
        for column in range(SUM_X, FAR):
            t[column] += sums[block, column] * scale
        t[FAR] = max(t[FAR], sums[block, FAR])
    share = 1.0 / t[WEIGHT]
    x, y, d = t[SUM_X] * share, t[SUM_Y] * share, t[SUM_D] * share
    yaw = np.arctan2(t[SUM_SIN], t[SUM_COS])
    result = np.empty(13)
    result[0], result[1] = largest, np.log(t[WEIGHT]) + largest
    result[2] = t[WEIGHT] * t[WEIGHT] / t[SQUARED]
    result[3], result[4] = look[REFERENCE_X] + x, look[REFERENCE_Y] + y
    result[5] = look[REFERENCE_YAW] + yaw
    result[6] = max(t[SUM_XX] * share - x * x, 0.0)
    result[7] = t[SUM_XY] * share - x * y
    result[8] = max(t[SUM_YY] * share - y * y, 0.0)
    result[9] = t[SUM_XD] * share - x * d
    result[10] = t[SUM_YD] * share - y * d
    result[11] = max(t[SUM_DD] * share - yaw * (2.0 * d - yaw), 0.0)
    result[12] = t[FAR]
    return result
