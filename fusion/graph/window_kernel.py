"""Moments of likelihoods under Gaussian windows: all poses in one pass, compiled by numba.

A window ``N(c, W)`` that is not much wider than the cells is summed on a lattice of its own, in coordinates in which it
is the unit Gaussian: fine enough for the window (about one standard deviation, where such sums are exact to 1e-7) and
for the likelihood's cells. A wide one is summed cell by cell.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.graph.spline import OPTIONS, inside, support

REACH = 4.2  # standard deviations
_STEP = 1.05
_CELL_STEP = 0.8
_WIDE_CELLS = 1.5  # standard deviations of a window along each axis from which cells are sampled well enough


@numba.njit(**OPTIONS)
def _is_wide(root: NDArray[np.float64], metres: float, radians: float) -> bool:
    """Whether the window's standard deviations given the other axes are wide against the cells."""
    least = min(root[0, 0], root[1, 1]) / metres
    return min(least, root[2, 2] / radians) > _WIDE_CELLS


@numba.njit(**OPTIONS)
def _sum_cells(
    patch: NDArray[np.float32],
    first: NDArray[np.float64],
    cell: NDArray[np.float64],
    log_uniform: float,
    outlier: float,
    centre: NDArray[np.float64],
    root: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> float:
    """As `window_moments` for one likelihood, summed over its cells (rows, cols, bins); outliers are added exactly."""
    (rows, cols, bins), metres, radians = patch.shape, cell[0], cell[1]
    volume = metres * metres * radians / ((2.0 * np.pi) ** 1.5 * root[0, 0] * root[1, 1] * root[2, 2])
    total = outlier
    mean[:] = 0.0
    spread[:] = 0.0
    for i in range(3):
        spread[i, i] = outlier
    u = np.empty(3)
    turned = first[2] - centre[2]
    turned -= 2.0 * np.pi * np.floor((turned + 0.5 * radians * (bins - 1)) / (2.0 * np.pi) + 0.5)
    for row in range(rows):
        y = first[1] - metres * row - centre[1]
        for col in range(cols):
            u[0] = (first[0] + metres * col - centre[0]) / root[0, 0]
            u[1] = (y - root[1, 0] * u[0]) / root[1, 1]
            plan = u[0] * u[0] + u[1] * u[1]
            if plan > REACH * REACH:
                continue
            bend = root[2, 0] * u[0] + root[2, 1] * u[1]
            for k in range(bins):
                u[2] = (turned + radians * k - bend) / root[2, 2]
                square = plan + u[2] * u[2]
                if square > REACH * REACH:
                    continue
                share = (1.0 - outlier) * volume * np.exp(patch[row, col, k] - log_uniform - 0.5 * square)
                total += share
                for i in range(3):
                    mean[i] += share * u[i]
                    for j in range(3):
                        spread[i, j] += share * u[i] * u[j]
    for i in range(3):
        mean[i] /= total
    for i in range(3):
        for j in range(3):
            spread[i, j] = spread[i, j] / total - mean[i] * mean[j]
    return float(np.log(total) + log_uniform)


@numba.njit(**OPTIONS)
def _profile(
    patch: NDArray[np.float32], wraps: bool, row: float, col: float, first: int, values: NDArray[np.float64]
) -> None:
    """The spline's coefficients along the yaw bins from `first` on, at a position within the cells."""
    rows, cols, bins = patch.shape
    middle, t = support(row)
    r0, r1, r2 = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    above, at, below = patch[inside(middle - 1, rows)], patch[inside(middle, rows)], patch[inside(middle + 1, rows)]
    middle, t = support(col)
    c0, c1, c2 = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    left, mid, right = inside(middle - 1, cols), inside(middle, cols), inside(middle + 1, cols)
    begin = first % bins if wraps else first
    for k in range(len(values)):
        b = begin + k
        if b < 0 or b >= bins:
            b = b % bins if wraps else inside(b, bins)
        values[k] = (
            r0 * (c0 * above[left, b] + c1 * above[mid, b] + c2 * above[right, b])
            + r1 * (c0 * at[left, b] + c1 * at[mid, b] + c2 * at[right, b])
            + r2 * (c0 * below[left, b] + c1 * below[mid, b] + c2 * below[right, b])
        )


@numba.njit(**OPTIONS)
def _sum_lattice(
    patch: NDArray[np.float32],
    wraps: bool,
    first: NDArray[np.float64],
    cell: NDArray[np.float64],
    floor: float,
    log_uniform: float,
    outlier: float,
    centre: NDArray[np.float64],
    root: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
    flat: NDArray[np.float64],
) -> float:
    """As `window_moments` for one likelihood, summed on the window's own lattice.

    The root is lower triangular: position depends on the first two coordinates alone, so that along the third the
    table is summed over rows and columns once.
    """
    (rows, cols, bins), metres, radians = patch.shape, cell[0], cell[1]
    counts, steps = np.empty(3, np.int64), np.empty(3)
    for axis in range(3):
        length = max(abs(root[0, axis]) / metres, abs(root[1, axis]) / metres, abs(root[2, axis]) / radians)
        steps[axis] = min(_STEP, _CELL_STEP / max(length, 1e-9))
        counts[axis] = int(np.ceil(REACH / steps[axis]))
        steps[axis] = REACH / counts[axis]
    along = np.exp(-0.5 * (steps[2] * np.arange(counts[2] + 1)) ** 2)
    stride = root[2, 2] * steps[2] / radians
    values = np.empty(int(2.0 * counts[2] * stride) + 5)
    turned = centre[2] - first[2] - 0.5 * radians * (bins - 1)
    turned -= 2.0 * np.pi * np.floor(turned / (2.0 * np.pi) + 0.5)  # the short way to the middle bin
    turned += 0.5 * radians * (bins - 1)
    total, window = 0.0, 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    s00, s01, s02, s11, s12, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    f0, f1, f2 = 0.0, 0.0, 0.0
    for a in range(-counts[0], counts[0] + 1):
        u0 = a * steps[0]
        col = (centre[0] + root[0, 0] * u0 - first[0]) / metres
        for b in range(-counts[1], counts[1] + 1):
            u1 = b * steps[1]
            plan = u0 * u0 + u1 * u1
            if plan > REACH * REACH:
                continue
            row = (first[1] - centre[1] - root[1, 0] * u0 - root[1, 1] * u1) / metres
            most = int(np.sqrt(REACH * REACH - plan) / steps[2])
            turn = (turned + root[2, 0] * u0 + root[2, 1] * u1) / radians
            is_inside = -0.5 <= row < rows - 0.5 and -0.5 <= col < cols - 0.5
            lowest = int(np.floor(turn - most * stride + 0.5)) - 1
            if is_inside:
                count = int(np.floor(turn + most * stride + 0.5)) + 2 - lowest
                _profile(patch, wraps, row, col, lowest, values[:count])
            mass, flank, square = 0.0, 0.0, 0.0  # along the third coordinate: sums of 1, u2 and u2 u2
            plain, plain_square = 0.0, 0.0
            for c in range(-most, most + 1):
                u2, position = c * steps[2], turn + c * stride
                share = along[abs(c)]
                plain += share
                plain_square += share * u2 * u2
                at = floor
                if is_inside and (wraps or -0.5 <= position < bins - 0.5):
                    middle, t = support(position)
                    k = middle - lowest
                    at = 0.5 * (0.5 - t) ** 2 * values[k - 1] + (0.75 - t * t) * values[k]
                    at += 0.5 * (0.5 + t) ** 2 * values[k + 1]
                share *= (1.0 - outlier) * np.exp(at - log_uniform) + outlier
                mass += share
                flank += share * u2
                square += share * u2 * u2
            weight = np.exp(-0.5 * plan)
            window += weight * plain
            f0 += weight * plain * u0 * u0
            f1 += weight * plain * u1 * u1
            f2 += weight * plain_square
            mass, flank, square = weight * mass, weight * flank, weight * square
            total += mass
            s0 += mass * u0
            s1 += mass * u1
            s2 += flank
            s00 += mass * u0 * u0
            s01 += mass * u0 * u1
            s02 += flank * u0
            s11 += mass * u1 * u1
            s12 += flank * u1
            s22 += square
    mean[0], mean[1], mean[2] = s0 / total, s1 / total, s2 / total
    spread[0, 0], spread[1, 1], spread[2, 2] = s00 / total, s11 / total, s22 / total
    spread[0, 1], spread[0, 2], spread[1, 2] = s01 / total, s02 / total, s12 / total
    spread[1, 0], spread[2, 0], spread[2, 1] = spread[0, 1], spread[0, 2], spread[1, 2]
    for i in range(3):
        for j in range(3):
            spread[i, j] -= mean[i] * mean[j]
    flat[0], flat[1], flat[2] = f0 / window, f1 / window, f2 / window
    return float(np.log(total / window) + log_uniform)


@numba.njit(**OPTIONS)
def window_moments(
    table: NDArray[np.float32],
    begins: NDArray[np.int64],
    shapes: NDArray[np.int64],
    firsts: NDArray[np.float64],
    cells: NDArray[np.float64],
    floors: NDArray[np.float64],
    log_uniforms: NDArray[np.float64],
    outlier: float,
    centres: NDArray[np.float64],
    roots: NDArray[np.float64],
    log_mass: NDArray[np.float64],
    means: NDArray[np.float64],
    spreads: NDArray[np.float64],
    flat: NDArray[np.float64],
) -> None:
    """Moments of ``((1 - p) L + p u) N(c, W)`` in whitened coordinates ``u``, ``pose = c + root u``.

    Parameters
    ----------
    table : (cells,) float32
        Log densities of all likelihoods; each begins at `begins` and has the cells of `shapes` (M, 3).
    shapes : (M, 4) int64
        Rows, columns, yaw bins, and whether these close to a circle.
    firsts : (M, 3) float64
        x, y and yaw of the centre of the first cell; rows go down.
    cells : (M, 2) float64
        Metres and radians of a cell.
    floors, log_uniforms : (M,) float64
        ln density beyond the cells, and of an outlier.
    outlier : float
        Its probability p.
    centres, roots : (M, 3), (M, 3, 3) float64
        Of the windows; the lower triangular roots of their covariances.
    log_mass, means, spreads, flat
        Written: ln of the windowed mass, mean (M, 3) and covariance (M, 3, 3) of u, and the variances (M, 3) that a
        flat likelihood would have had on the same lattice.
    """
    for m in range(len(begins)):
        rows, cols, bins = shapes[m, 0], shapes[m, 1], shapes[m, 2]
        patch = table[begins[m] : begins[m] + rows * cols * bins].reshape(rows, cols, bins)
        if _is_wide(roots[m], cells[m, 0], cells[m, 1]):
            log_mass[m] = _sum_cells(
                patch, firsts[m], cells[m], log_uniforms[m], outlier, centres[m], roots[m], means[m], spreads[m]
            )
            flat[m] = 1.0
        else:
            log_mass[m] = _sum_lattice(
                patch,
                shapes[m, 3] == 1,
                firsts[m],
                cells[m],
                floors[m],
                log_uniforms[m],
                outlier,
                centres[m],
                roots[m],
                means[m],
                spreads[m],
                flat[m],
            )
