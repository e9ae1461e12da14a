"""Clusters of a cloud as the compiled step keeps it, and the kernel that each gets when a cloud is regularised.

The same partition as `fusion.kernels.clusters` makes of poses, on float32 x, y, yaw in three arrays (3 N,), with equal
weights. Sines and cosines are taken a block at a time, where the processor takes them several at once.
"""

import math

import numba
import numpy as np

from fusion.kernels.float_math import INLINED, KERNEL, F, larger, put, sine_cosine, take
from fusion.kernels.layout import BLOCK, CLUSTER_SIZE, Float32s, Float64s, Int32s

_ROUNDING = 1e-14


@numba.njit(**KERNEL)
def gather_copies(source: Float32s, ancestors: Int32s, cloud: Float32s) -> None:
    """Write the ancestors' poses (3 M,) into `cloud` (3 N,)."""
    many, count = np.int32(source.size // 3), np.int32(len(ancestors))
    for axis in range(3):
        column, offset = source[axis * many : (axis + 1) * many], np.int64(axis) * count
        for i in range(count):
            put(cloud, offset + i, take(column, take(ancestors, np.int32(i))))


@numba.njit(**KERNEL)
def extent(values: Float32s) -> tuple[float, float]:
    """Least and greatest of some numbers."""
    least, greatest = F(3e38), F(-3e38)
    for i in range(len(values)):
        least = -larger(-values[i], -least)
        greatest = larger(values[i], greatest)
    return np.float64(least), np.float64(greatest)


@numba.njit(**KERNEL)
def cells_of_cloud(cloud: Float32s, x0: float, y0: float, cell_m: float, cols: int, yaw_cells: int) -> Int32s:
    """Cell of each particle in a grid of (rows, cols, yaw_cells) whose outermost rows and columns stay empty."""
    count = cloud.size // 3
    cells = np.empty(count, np.int32)
    west, south, per_m, per_rad = F(x0), F(y0), F(1.0 / cell_m), F(yaw_cells / (2.0 * math.pi))
    width, turn = np.int32(cols), np.int32(yaw_cells)
    for i in range(count):
        row = np.int32((cloud[i] - west) * per_m)
        col = np.int32((cloud[count + i] - south) * per_m)
        bins = cloud[2 * count + i] * per_rad
        bins = bins + F(turn) if bins < F(0.0) else bins
        yaw = min(np.int32(bins), np.int32(turn - 1))
        cells[i] = np.int32(np.int32(np.int32((row + 1) * width) + np.int32(col + 1)) * turn) + yaw
    return cells


@numba.njit(**INLINED)
def _directions(yaws: Float32s, sines: Float32s, cosines: Float32s) -> None:
    for i in range(len(yaws)):
        sines[i], cosines[i] = sine_cosine(yaws[i])


@numba.njit(**KERNEL)
def cloud_moments(cloud: Float32s, labels: Int32s, clusters: int) -> tuple[Float64s, Float64s, Float64s]:
    """Number (M,), mean (M, 3) and second moments xx, yx, yy, tx, ty, tt (M, 6) about it, of each cluster."""
    count = cloud.size // 3
    xs, ys, yaws = cloud[:count], cloud[count : 2 * count], cloud[2 * count :]
    sums = np.zeros((clusters, 5))
    sines, cosines = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    for start in range(0, count, BLOCK):
        n = min(BLOCK, count - start)
        _directions(yaws[start : start + n], sines, cosines)
        for j in range(n):
            one = sums[labels[start + j]]
            one[0] += 1.0
            one[1] += xs[start + j]
            one[2] += ys[start + j]
            one[3] += sines[j]
            one[4] += cosines[j]
    means, squares = np.empty((clusters, 3)), np.zeros((clusters, 6))
    for m in range(clusters):
        means[m, 0], means[m, 1] = sums[m, 1] / sums[m, 0], sums[m, 2] / sums[m, 0]
        means[m, 2] = math.atan2(sums[m, 3], sums[m, 4])
    for i in range(count):
        mean, square = means[labels[i]], squares[labels[i]]
        x, y, t = xs[i] - mean[0], ys[i] - mean[1], yaws[i] - mean[2]
        t = t - 2.0 * math.pi if t >= math.pi else t
        t = t + 2.0 * math.pi if t < -math.pi else t
        square[0] += x * x
        square[1] += y * x
        square[2] += y * y
        square[3] += t * x
        square[4] += t * y
        square[5] += t * t
    for m in range(clusters):
        squares[m] /= sums[m, 0]
    return sums[:, 0].copy(), means, squares


@numba.njit(**KERNEL)
def cluster_rows(means: Float64s, squares: Float64s, widths: Float64s) -> Float32s:
    """The clusters' rows for the step (M * CLUSTER_SIZE,), of kernels `widths` (M,) standard deviations wide."""
    rows = np.empty(len(means) * CLUSTER_SIZE, np.float32)
    for m in range(len(means)):
        xx, yx, yy = squares[m, 0], squares[m, 1], squares[m, 2]
        tx, ty, tt = squares[m, 3], squares[m, 4], squares[m, 5]
        a = math.sqrt(xx) if xx > 0.0 else 0.0
        b, d = (yx / a, tx / a) if a > 0.0 else (0.0, 0.0)
        rest = yy - b * b
        c = math.sqrt(rest) if rest > _ROUNDING * yy else 0.0
        e = (ty - b * d) / c if c > 0.0 else 0.0
        rest = tt - d * d - e * e
        f = math.sqrt(rest) if rest > _ROUNDING * tt else 0.0
        row = rows[m * CLUSTER_SIZE : (m + 1) * CLUSTER_SIZE]
        row[0], row[1], row[2], row[3] = means[m, 0], means[m, 1], means[m, 2], math.sqrt(1.0 - widths[m] * widths[m])
        row[4], row[5], row[6] = widths[m] * a, widths[m] * b, widths[m] * c
        row[7], row[8], row[9] = widths[m] * d, widths[m] * e, widths[m] * f
    return rows
