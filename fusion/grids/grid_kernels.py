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


@numba.njit(cache=True, fastmath=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _sum(values: Float32Array, top: int, bottom: int, left: int, right: int) -> float:
    total = 0.0
    for r in range(top, bottom):
        for c in range(left, right):
            total += values[r, c]
    return total


@numba.njit(cache=True, nogil=True)
def translate(
    mass: Float32Array,
    out: Float32Array,
    steps: IntArray,
    directions: IntArray,
    taps: Float32Array,
    radii: IntArray,
    gain: float,
    floor: float,
) -> float:
    """Blur every plane and move it by whole cells; the mass that leaves the map, times `gain`.

    Parameters
    ----------
    mass : (K, rows, cols) float32
        Before.
    out : (K, rows + 2 p, cols + 2 p) float32
        After, inside a frame of p cells of zeros.
    steps : (K, 2) int64
        Rows and columns to move by.
    directions : (K, 3, 2) int64
        Vectors of cells to blur along.
    taps : (K, 3, R + 1) float32
        Half of a symmetric kernel for each, from its middle outward, R >= 1.
    radii : (K, 3) int64
        Last tap that counts; 0 for no blur.
    gain, floor : float
        Multiplies every value; least value inside the map.
    """
    planes, rows, cols = mass.shape
    frame = (out.shape[1] - rows) // 2
    widest, reach = 0, 0
    for k in range(planes):
        total = 0
        for d in range(DIRECTIONS):
            step = radii[k, d] * max(abs(directions[k, d, 0]), abs(directions[k, d, 1]))
            widest = max(widest, step)
            total += step
        reach = max(reach, total)
    pad = reach + widest
    one = np.zeros((rows + 2 * pad, cols + 2 * pad), dtype=np.float32)
    other = np.zeros((rows + 2 * pad, cols + 2 * pad), dtype=np.float32)
    factor, least = np.float32(gain), np.float32(floor)
    left_map = 0.0
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
        # the window of the blurred plane that lands on the map
        top = min(max(pad - steps[k, 0], 0), rows + 2 * pad)
        bottom = max(min(pad - steps[k, 0] + rows, rows + 2 * pad), top)
        left = min(max(pad - steps[k, 1], 0), cols + 2 * pad)
        right = max(min(pad - steps[k, 1] + cols, cols + 2 * pad), left)
        left_map += _sum(one, 0, top, 0, cols + 2 * pad) + _sum(one, bottom, rows + 2 * pad, 0, cols + 2 * pad)
        left_map += _sum(one, top, bottom, 0, left) + _sum(one, top, bottom, right, cols + 2 * pad)
        first_row, first_col = top - pad + steps[k, 0], left - pad + steps[k, 1]
        if right - left < cols or bottom - top < rows:
            out[k, frame : frame + rows, frame : frame + cols] = least
        for r in range(bottom - top):
            values = one[top + r, left:right]
            line = out[k, frame + first_row + r, frame + first_col : frame + first_col + right - left]
            for c in range(right - left):
                line[c] = max(values[c], least)
    return left_map


@numba.njit(cache=True, fastmath=True, nogil=True)
def mix_headings(
    framed: Float32Array,
    out: Float32Array,
    centre: float,
    weights: Float32Array,
    sources: IntArray,
    cells: IntArray,
    parts: Float32Array,
    floor: float,
) -> None:
    """Blur across headings: every plane gets shares of its neighbours, moved by parts of a cell.

    Parameters
    ----------
    framed : (K, rows + 2 p, cols + 2 p) float32
        Before, inside a frame of p cells of zeros.
    out : (K, rows, cols) float32
        After.
    centre : float
        Share that stays.
    weights : (M,) float32
        Share taken from each of the M neighbours.
    sources : (K, M) int64
        The neighbours' planes.
    cells, parts : (K, M, 2) int64, float32
        Where the mass for cell (0, 0) comes from: the part of cell ``cells + 1``, the rest of cell ``cells``.
    floor : float
        Least value.
    """
    planes, rows, cols = out.shape
    frame = (framed.shape[1] - rows) // 2
    stay, least, unit = np.float32(centre), np.float32(floor), np.float32(1.0)
    for k in range(planes):
        for r in range(rows):
            line, own = out[k, r], framed[k, frame + r, frame : frame + cols]
            for c in range(cols):
                line[c] = stay * own[c]
            for m in range(weights.shape[0]):
                low, right = parts[k, m, 0], parts[k, m, 1]
                first = frame + cells[k, m, 1]
                upper = framed[sources[k, m], frame + r + cells[k, m, 0]]
                lower = framed[sources[k, m], frame + r + cells[k, m, 0] + 1]
                a, b = upper[first : first + cols], upper[first + 1 : first + 1 + cols]
                e, f = lower[first : first + cols], lower[first + 1 : first + 1 + cols]
                wa = weights[m] * (unit - low) * (unit - right)
                wb = weights[m] * (unit - low) * right
                we = weights[m] * low * (unit - right)
                wf = weights[m] * low * right
                for c in range(cols):
                    line[c] += wa * a[c] + wb * b[c] + we * e[c] + wf * f[c]
            for c in range(cols):
                line[c] = max(line[c], least)


@numba.njit(cache=True, nogil=True)
def mass_mixed_away(
    framed: Float32Array, frame: int, weights: Float32Array, cells: IntArray, parts: Float32Array
) -> float:
    """Mass that :func:`mix_headings` moves beyond the edges.

    Here the tables say where mass goes: from cell (r, c) of plane k to row ``r + cells`` and the next, which gets the
    part; likewise for columns. Only cells near an edge can lose any.
    """
    planes, neighbours = cells.shape[:2]
    rows, cols = framed.shape[1] - 2 * frame, framed.shape[2] - 2 * frame
    total = 0.0
    for k in range(planes):
        for m in range(neighbours):
            for r in range(rows):
                kept_row = _kept(r + cells[k, m, 0], rows, parts[k, m, 0])
                inner = min(max(0, -cells[k, m, 1]), cols), max(0, cols - max(0, cells[k, m, 1] + 1))
                c = 0
                while c < cols:
                    if kept_row == 1.0 and inner[0] <= c < inner[1]:
                        c = inner[1]  # nothing is lost between the two
                        continue
                    kept = kept_row * _kept(c + cells[k, m, 1], cols, parts[k, m, 1])
                    total += weights[m] * (1.0 - kept) * framed[k, frame + r, frame + c]
                    c += 1
    return total


@numba.njit(cache=True, nogil=True)
def _kept(cell: int, count: int, part: float) -> float:
    """Share of what is split between `cell` and the next that lands inside ``[0, count)``."""
    kept = 1.0 - part if 0 <= cell < count else 0.0
    return kept + part if -1 <= cell < count - 1 else kept


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
