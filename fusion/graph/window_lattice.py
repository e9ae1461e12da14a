"""Moments of one likelihood under a Gaussian window that is narrow against the cells, on a lattice of its own.

In coordinates in which the window is the unit Gaussian a lattice of about one standard deviation gives sums that are
exact to 1e-7; it is finer where the likelihood's cells are. Along the heading the sums are taken by vector code in
32-bit arithmetic, see `fusion.kernels.float_math`, over positions in 64-bit.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.graph.spline import OPTIONS, inside, support
from fusion.kernels.float_math import INLINED, F, exp, get, near, put

REACH = 4.2
"""Standard deviations of a window that are summed over."""
_LANES, _READ = 8, 16  # values of loops that become vector code: fixed numbers, since remainders do not
_STEP = 1.05
_CELL_STEP = 0.8
_ENDLESS = F(1e9)  # bins; an infinity may be optimised away where fast arithmetic is allowed
_LEAST = -87.0  # what the vector code's exponentials end at
_HALF, _THREE_QUARTERS = F(0.5), F(0.75)


@numba.njit(inline="always", **OPTIONS)
def _blocks(count: int, size: int) -> int:
    """The least number of blocks that hold so many values."""
    return (count + size - 1) // size


@numba.njit(inline="always", **OPTIONS)
def beyond_cells(floor: float, log_uniform: float) -> float:
    """The density over uniform outside of a likelihood's cells, never quite 0."""
    return np.exp(max(floor - log_uniform, _LEAST))


@numba.njit(inline="always", **OPTIONS)
def bins_of_a_turn(radians: float) -> int:
    """How many yaw bins make the whole circle."""
    return int(2.0 * np.pi / radians + 0.5)


@numba.njit(forceinline=True, **OPTIONS)
def put_moments(
    total: float,
    first: tuple[float, float, float],
    second: tuple[float, float, float, float, float, float],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> None:
    """Mean and covariance of three coordinates from sums of 1, of them and of their products (upper triangle)."""
    for i in range(3):
        mean[i] = first[i] / total
    spread[0, 0], spread[0, 1], spread[0, 2] = second[0] / total, second[1] / total, second[2] / total
    spread[1, 1], spread[1, 2], spread[2, 2] = second[3] / total, second[4] / total, second[5] / total
    spread[1, 0], spread[2, 0], spread[2, 1] = spread[0, 1], spread[0, 2], spread[1, 2]
    for i in range(3):
        for j in range(3):
            spread[i, j] -= mean[i] * mean[j]


@numba.njit(**INLINED)
def _profile(
    cells: NDArray[np.float32],
    rows: int,
    cols: int,
    bins: int,
    wraps: bool,
    row: float,
    col: float,
    first: int,
    count: int,
    values: NDArray[np.float32],
) -> None:
    """The spline's coefficients along `count` yaw bins from `first` on, at a position within the cells.

    The values are read in blocks, so that some beyond the count are written too.
    """
    middle, t = support(row)
    r0, r1, r2 = F(0.5 * (0.5 - t) ** 2), F(0.75 - t * t), F(0.5 * (0.5 + t) ** 2)
    above, at, below = inside(middle - 1, rows) * cols, inside(middle, rows) * cols, inside(middle + 1, rows) * cols
    middle, t = support(col)
    c0, c1, c2 = F(0.5 * (0.5 - t) ** 2), F(0.75 - t * t), F(0.5 * (0.5 + t) ** 2)
    left, mid, right = inside(middle - 1, cols), inside(middle, cols), inside(middle + 1, cols)
    begin = first % bins if wraps else first
    blocks = _blocks(count, _READ)
    if begin >= 0 and begin + count <= bins and (below + right) * bins + begin + blocks * _READ <= rows * cols * bins:
        p00, p01, p02 = (above + left) * bins + begin, (above + mid) * bins + begin, (above + right) * bins + begin
        p10, p11, p12 = (at + left) * bins + begin, (at + mid) * bins + begin, (at + right) * bins + begin
        p20, p21, p22 = (below + left) * bins + begin, (below + mid) * bins + begin, (below + right) * bins + begin
        for block in range(blocks):
            for lane in range(_READ):
                k = block * _READ + lane
                upper = c0 * near(cells, p00 + k) + c1 * near(cells, p01 + k) + c2 * near(cells, p02 + k)
                same = c0 * near(cells, p10 + k) + c1 * near(cells, p11 + k) + c2 * near(cells, p12 + k)
                lower = c0 * near(cells, p20 + k) + c1 * near(cells, p21 + k) + c2 * near(cells, p22 + k)
                put(values, k, r0 * upper + r1 * same + r2 * lower)
        return
    for k in range(count):
        b = (begin + k) % bins if wraps else inside(begin + k, bins)
        upper = c0 * cells[(above + left) * bins + b] + c1 * cells[(above + mid) * bins + b]
        upper += c2 * cells[(above + right) * bins + b]
        same = (
            c0 * cells[(at + left) * bins + b] + c1 * cells[(at + mid) * bins + b] + c2 * cells[(at + right) * bins + b]
        )
        lower = c0 * cells[(below + left) * bins + b] + c1 * cells[(below + mid) * bins + b]
        lower += c2 * cells[(below + right) * bins + b]
        put(values, k, r0 * upper + r1 * same + r2 * lower)


@numba.njit(**INLINED)
def _along(
    values: NDArray[np.float32],
    shifts: NDArray[np.float32],
    shares: NDArray[np.float32],
    lanes: int,
    place: np.float32,
    least: np.float32,
    most: np.float32,
    floor: np.float32,
    log_uniform: np.float32,
) -> tuple[float, float, float]:
    """Sums of the density over uniform along a spline's coefficients, at `place + shifts`, times three rows of shares.

    Outside of [least, most) the spline is the floor. Lanes come in blocks of a fixed number.
    """
    mass, flank, square = F(0.0), F(0.0), F(0.0)
    for block in range(lanes // _LANES):
        for lane in range(_LANES):
            j = block * _LANES + lane
            position = place + get(shifts, j)
            k = np.int32(position + _HALF)
            t = position - F(k)
            before, after = _HALF - t, _HALF + t
            at = _HALF * before * before * get(values, k - 1) + (_THREE_QUARTERS - t * t) * get(values, k)
            at += _HALF * after * after * get(values, k + 1)
            density = exp((at if least <= position < most else floor) - log_uniform)
            mass += density * get(shares, j)
            flank += density * get(shares, lanes + j)
            square += density * get(shares, 2 * lanes + j)
    return float(mass), float(flank), float(square)


@numba.njit(forceinline=True, **OPTIONS)
def sum_lattice(
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
    """As `fusion.graph.window_kernel.window_moments` for one likelihood.

    The root is lower triangular: position depends on the first two coordinates alone, so that along the third the
    table is summed over rows and columns once.
    """
    (rows, cols, bins), metres, radians, cells = patch.shape, cell[0], cell[1], patch.reshape(-1)
    counts, steps = np.empty(3, np.int64), np.empty(3)
    for axis in range(3):
        length = max(abs(root[0, axis]) / metres, abs(root[1, axis]) / metres, abs(root[2, axis]) / radians)
        steps[axis] = min(_STEP, _CELL_STEP / max(length, 1e-9))
        counts[axis] = int(np.ceil(REACH / steps[axis]))
        steps[axis] = REACH / counts[axis]
    most, stride = counts[2], root[2, 2] * steps[2] / radians
    lanes = _LANES * _blocks(2 * most + 1, _LANES)
    shifts, shares = np.zeros(lanes, np.float32), np.zeros(3 * lanes, np.float32)
    plain, plain_square = 0.0, 0.0  # along the third coordinate: sums of the window and of the window times u2 u2
    for c in range(2 * most + 1):
        u2 = (c - most) * steps[2]
        share = np.exp(-0.5 * u2 * u2)
        shifts[c], shares[c], shares[lanes + c], shares[2 * lanes + c] = c * stride, share, share * u2, share * u2 * u2
        plain += share
        plain_square += share * u2 * u2
    bells = np.empty(counts[0] + counts[1] + 2)
    for a in range(counts[0] + 1):
        bells[a] = np.exp(-0.5 * (a * steps[0]) ** 2)
    for b in range(counts[1] + 1):
        bells[counts[0] + 1 + b] = np.exp(-0.5 * (b * steps[1]) ** 2)
    count = int(2.0 * most * stride) + 5
    values = np.zeros(_READ * _blocks(count, _READ), np.float32)
    turned = centre[2] - first[2] - 0.5 * radians * (bins - 1)
    turned -= 2.0 * np.pi * np.floor(turned / (2.0 * np.pi) + 0.5)  # the short way to the middle bin
    turned += 0.5 * radians * (bins - 1)
    beyond, turn = beyond_cells(floor, log_uniform), bins_of_a_turn(radians)
    total, window = 0.0, 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    s00, s01, s02, s11, s12, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    f0, f1 = 0.0, 0.0
    for a in range(-counts[0], counts[0] + 1):
        u0 = a * steps[0]
        col = (centre[0] + root[0, 0] * u0 - first[0]) / metres
        for b in range(-counts[1], counts[1] + 1):
            u1 = b * steps[1]
            plan = u0 * u0 + u1 * u1
            if plan > REACH * REACH:
                continue
            row = (first[1] - centre[1] - root[1, 0] * u0 - root[1, 1] * u1) / metres
            weight = bells[abs(a)] * bells[counts[0] + 1 + abs(b)]
            mass, flank, square, images = 0.0, 0.0, 0.0, 0  # sums of 1, u2 and u2 u2
            if -0.5 <= row < rows - 0.5 and -0.5 <= col < cols - 0.5:
                place = (turned + root[2, 0] * u0 + root[2, 1] * u1) / radians - most * stride
                image, images = 0, 1
                if not wraps:  # the cells' images a turn apart that the window reaches
                    image = int(np.floor((place + 0.5 - bins) / turn)) + 1
                    images = int(np.floor((place + 2.0 * most * stride + 0.5) / turn)) + 1 - image
                lowest = int(np.floor(place + 0.5)) - 1
                for k in range(image, image + images):
                    least = lowest - k * turn
                    _profile(cells, rows, cols, bins, wraps, row, col, least, count, values)
                    begin, end = -_ENDLESS, _ENDLESS
                    if not wraps:
                        begin, end = F(-0.5 - least), F(bins - 0.5 - least)
                    along = _along(
                        values, shifts, shares, lanes, F(place - lowest), begin, end, F(floor), F(log_uniform)
                    )
                    mass += along[0]
                    flank += along[1]
                    square += along[2]
            mass = (1.0 - outlier) * (mass + (1 - images) * beyond * plain) + outlier * plain
            square = (1.0 - outlier) * (square + (1 - images) * beyond * plain_square) + outlier * plain_square
            flank *= 1.0 - outlier
            window += weight
            f0 += weight * u0 * u0
            f1 += weight * u1 * u1
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
    put_moments(total, (s0, s1, s2), (s00, s01, s02, s11, s12, s22), mean, spread)
    flat[0], flat[1], flat[2] = f0 / window, f1 / window, plain_square / plain
    return float(np.log(total / (window * plain)) + log_uniform)
