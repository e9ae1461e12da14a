"""Compiled loops of the grid filter: move probability mass on a lattice of (heading, row, col), heading first.

Heading comes first in memory because at a fixed heading every cell does the same: the same whole-cell step, the same
blur. A plane of one heading then stays in the cache while it is blurred, and the inner loops run along its columns
over neighbouring memory, which compilers turn into vector instructions. All loops run on one thread in a fixed order.

A blur with any 2 x 2 covariance is three blurs along lines of cells. Selling's formula writes a positive definite D as
a sum of three ``weight * v v^T`` with whole vectors v and weights >= 0, so that no mass is ever split between cells.

Sources: Selling, "Ueber die binaeren und ternaeren quadratischen Formen", 1874; Fehrenbach, Mirebeau, "Sparse
non-negative stencils for anisotropic diffusion", 2014, section 1 (the formula in this use).
"""

import numba
import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.kernels.float_math import get, near, put

DIRECTIONS = 3


@numba.njit(cache=True)
def selling(tensors: FloatArray, directions: IntArray, variances: FloatArray) -> None:
    """Decompose positive definite `tensors` (K, 2, 2) into `directions` (K, 3, 2) and `variances` (K, 3), in place.

    The superbase is turned until it is obtuse: a pair with a positive product ``v_i D v_j`` is replaced until none
    is left. The number of turns grows with the logarithm of the condition number.
    """
    base = np.empty((3, 2), dtype=np.int64)
    for k in range(tensors.shape[0]):
        xx, xy, yy = tensors[k, 0, 0], tensors[k, 0, 1], tensors[k, 1, 1]
        slack = 1e-12 * (xx + yy)
        base[:] = 0
        base[0, 0] = base[0, 1] = -1
        base[1, 0] = base[2, 1] = 1
        settled = 0
        i = 0
        while settled < 3:
            a, b, c = i, (i + 1) % 3, (i + 2) % 3
            product = base[a, 0] * (xx * base[b, 0] + xy * base[b, 1])
            product += base[a, 1] * (xy * base[b, 0] + yy * base[b, 1])
            if product > slack:
                for axis in range(2):
                    base[c, axis] = base[a, axis] - base[b, axis]
                    base[a, axis] = -base[a, axis]
                settled = 0
            else:
                variances[k, c] = max(0.0, -product)
                settled += 1
            i = (i + 1) % 3
        for c in range(3):
            directions[k, c, 0], directions[k, c, 1] = -base[c, 1], base[c, 0]


@numba.njit(fastmath=True, forceinline=True, nogil=True)
def _blur_along(
    source: Float32Array, target: Float32Array, taps: Float32Array, radius: int, down: int, right: int, margin: int
) -> None:
    """Blur `source` into `target` along the vector (down, right) of cells, leaving a margin of the buffer alone."""
    height, width = source.shape
    inner = width - 2 * margin
    for r in range(margin, height - margin):
        middle, out = source[r, margin : margin + inner], target[r, margin : margin + inner]
        one, other = source[r - down], source[r + down]
        before = one[margin - right : margin - right + inner]
        after = other[margin + right : margin + right + inner]
        for c in range(inner):
            out[c] = taps[0] * middle[c] + taps[1] * (before[c] + after[c])
        for n in range(2, radius + 1):
            one, other = source[r - n * down], source[r + n * down]
            before = one[margin - n * right : margin - n * right + inner]
            after = other[margin + n * right : margin + n * right + inner]
            for c in range(inner):
                out[c] += taps[n] * (before[c] + after[c])


@numba.njit(fastmath=True, forceinline=True, nogil=True)
def _sum(values: Float32Array, top: int, bottom: int, left: int, right: int) -> float:
    total = 0.0
    for r in range(top, bottom):
        line = values[r, left:right]
        for c in range(line.size):
            total += np.float64(line[c])
    return total


@numba.njit(forceinline=True, nogil=True)
def _window(start: int, count: int, size: int) -> tuple[int, int]:
    """The part of ``[start, start + count)`` that lies in ``[0, size)``."""
    first = min(max(start, 0), size)
    return first, max(min(start + count, size), first)


@numba.njit(cache=True, fastmath=True, nogil=True)
def translate(
    mass: Float32Array,
    out: Float32Array,
    steps: IntArray,
    directions: IntArray,
    taps: Float32Array,
    radii: IntArray,
    gain: float,
    rim: int,
) -> tuple[float, float]:
    """Blur every plane along lines, move it by whole cells, and multiply it.

    Parameters
    ----------
    mass : (K, rows, cols) float32
        Before.
    out : (K, rows + 2 p, cols + 2 p) float32
        After, p cells of more room at every edge; of less where p is negative.
    steps : (K, 2) int64
        Rows and columns to move by.
    directions : (K, 3, 2) int64
        Vectors of cells to blur along.
    taps : (K, 3, R + 1) float32
        Half of a symmetric kernel for each, from its middle outward, R >= 1.
    radii : (K, 3) int64
        Last tap that counts; 0 for no blur.
    gain : float
        Multiplies every value.
    rim : int
        How far from its edges a cell of `out` is inside.

    Returns
    -------
    tuple of 2 floats
        All mass, and what of it ends not inside, in the rim or beyond.
    """
    planes, rows, cols = mass.shape
    height, width = out.shape[1:]
    frame = (height - rows) // 2
    widest, reach = 0, 0
    for k in range(planes):
        total = 0
        for d in range(DIRECTIONS):
            step = radii[k, d] * max(abs(directions[k, d, 0]), abs(directions[k, d, 1]))
            widest = max(widest, step)
            total += step
        reach = max(reach, total)
    pad = reach + widest
    tall, wide = rows + 2 * pad, cols + 2 * pad
    one = np.zeros((tall, wide), dtype=np.float32)
    other = np.zeros((tall, wide), dtype=np.float32)
    factor = np.float32(gain)
    everything = edge = 0.0
    for k in range(planes):
        one[:pad] = 0.0
        one[pad + rows :] = 0.0
        for r in range(rows):
            line, values = one[pad + r], mass[k, r]
            line[:pad] = 0.0
            line[pad + cols :] = 0.0
            middle = line[pad : pad + cols]
            for c in range(cols):
                middle[c] = factor * values[c]
        for d in range(DIRECTIONS):
            if radii[k, d] > 0:
                _blur_along(one, other, taps[k, d], radii[k, d], directions[k, d, 0], directions[k, d, 1], widest)
                one, other = other, one
        down, right = steps[k, 0] + frame - pad, steps[k, 1] + frame - pad  # from the padded plane to `out`
        first, last = _window(-down, height, tall)
        west, east = _window(-right, width, wide)
        if east - west < width or last - first < height:
            out[k] = 0.0
        for r in range(first, last):
            values, line = one[r, west:east], out[k, r + down, west + right : east + right]
            for c in range(values.size):
                line[c] = values[c]
        first, last = _window(rim - down, max(height - 2 * rim, 0), tall)
        west, east = _window(rim - right, max(width - 2 * rim, 0), wide)
        rest = _sum(one, 0, first, 0, wide) + _sum(one, last, tall, 0, wide)
        rest += _sum(one, first, last, 0, west) + _sum(one, first, last, east, wide)
        edge += rest
        everything += rest + _sum(one, first, last, west, east)
    return everything, edge


@numba.njit(cache=True, fastmath=True, nogil=True)
def gather(
    source: Float32Array, width: int, starts: IntArray, weights: Float32Array, out: Float32Array, floor: float
) -> float:
    """Weighted sums of cells at fixed distances, for every cell of every plane; the sum of all.

    Parameters
    ----------
    source : (...,) float32
        Planes whose rows are `width` cells long, one behind the other.
    starts : (K, T) int64
        Where the cell is that is to be added to cell (0, 0) of the plane; T a multiple of 8.
    weights : (K, T) float32
        What each is multiplied by.
    out : (K, rows, cols) float32
        The sums, at least `floor`; none of the same memory as `source`.
    """
    planes, rows, cols = out.shape
    target, least = out.reshape(-1), np.float32(floor)
    total = 0.0
    for k in range(planes):
        for r in range(rows):
            at, along = (k * rows + r) * cols, r * width
            for t in range(0, starts.shape[1], 8):
                a, b, c, d = starts[k, t], starts[k, t + 1], starts[k, t + 2], starts[k, t + 3]
                e, f, g, h = starts[k, t + 4], starts[k, t + 5], starts[k, t + 6], starts[k, t + 7]
                wa, wb, wc, wd = weights[k, t], weights[k, t + 1], weights[k, t + 2], weights[k, t + 3]
                we, wf, wg, wh = weights[k, t + 4], weights[k, t + 5], weights[k, t + 6], weights[k, t + 7]
                for i in range(cols):
                    n = along + i
                    value = wa * near(source, a + n) + wb * near(source, b + n)
                    value += wc * near(source, c + n) + wd * near(source, d + n)
                    value += we * near(source, e + n) + wf * near(source, f + n)
                    value += wg * near(source, g + n) + wh * near(source, h + n)
                    put(target, at + i, value if t == 0 else get(target, at + i) + value)
            for i in range(cols):
                value = max(get(target, at + i), least)
                put(target, at + i, value)
                total += np.float64(value)
    return total


@numba.njit(cache=True, nogil=True)
def plane_moments(mass: Float32Array) -> FloatArray:
    """Sums over every plane, (K, 7): of the mass times 1, r, c, r r, r c, c c, and of the mass squared.

    r and c are counted from the middle of the plane.
    """
    planes, rows, cols = mass.shape
    sums = np.zeros((planes, 7))
    for k in range(planes):
        for r in range(rows):
            zero = first = second = square = 0.0
            line = mass[k, r]
            for c in range(cols):
                value, at = np.float64(line[c]), c - 0.5 * (cols - 1)
                zero += value
                first += at * value
                second += at * at * value
                square += value * value
            row = r - 0.5 * (rows - 1)
            sums[k, 0] += zero
            sums[k, 1] += row * zero
            sums[k, 2] += first
            sums[k, 3] += row * row * zero
            sums[k, 4] += row * first
            sums[k, 5] += second
            sums[k, 6] += square
    return sums


@numba.njit(cache=True, fastmath=True, nogil=True)
def reweigh(mass: Float32Array, weights: Float32Array, gain: float, fresh: float, floor: float) -> tuple[float, float]:
    """Put ``(gain * mass + fresh) * weights``, at least `floor`, in place of the weights; sum and sum of squares."""
    planes, rows, cols = mass.shape
    factor, extra, least = np.float32(gain), np.float32(fresh), np.float32(floor)
    total = squares = 0.0
    for k in range(planes):
        for r in range(rows):
            line, target = mass[k, r], weights[k, r]
            for c in range(cols):
                value = max((factor * line[c] + extra) * target[c], least)
                target[c] = value
                total += np.float64(value)
                squares += np.float64(value) * np.float64(value)
    return total, squares
