"""A smooth function from a table of log densities: the quadratic B-spline with the cells as coefficients.

It has a gradient everywhere, never overshoots, and what is concave stays concave. On a parabola it differs from the
table by a constant only, so that gradients and curvatures of a Gaussian are exact. Compiled by numba.

Source: Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine, 1999 (the
smoothing, not the interpolating, spline).
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}


@numba.njit(inline="always", **OPTIONS)
def support(position: float) -> tuple[int, float]:
    """Middle cell of the three that a position reaches, and the position's offset from its centre, in [-1/2, 1/2)."""
    middle = np.floor(position + 0.5)
    return int(middle), position - middle


@numba.njit(inline="always", **OPTIONS)
def inside(index: int, count: int) -> int:
    """The nearest index in [0, count)."""
    return min(max(index, 0), count - 1)


@numba.njit(**OPTIONS)
def value_at(
    table: NDArray[np.float32],
    begin: int,
    rows: int,
    cols: int,
    bins: int,
    wraps: bool,
    row: float,
    col: float,
    turn: float,
    outside: float,
) -> float:
    """Value at a position in cells, 0 at the centre of the first; beyond the outermost cells `outside`.

    The cells (rows, cols, bins) begin at `begin` of the flat table; the last axis closes to a circle if it `wraps`.
    """
    if row < -0.5 or row >= rows - 0.5 or col < -0.5 or col >= cols - 0.5:
        return outside
    if not wraps and (turn < -0.5 or turn >= bins - 0.5):
        return outside
    middle_row, t = support(row)
    row_weights = (0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2)
    middle_col, t = support(col)
    col_weights = (0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2)
    middle, t = support(turn)
    below, here, above = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    if wraps:
        low, mid, high = (middle - 1) % bins, middle % bins, (middle + 1) % bins
    else:
        low, mid, high = inside(middle - 1, bins), middle, inside(middle + 1, bins)
    total = 0.0
    for i in range(3):
        start = begin + inside(middle_row + i - 1, rows) * cols * bins
        for j in range(3):
            base = start + inside(middle_col + j - 1, cols) * bins
            along = below * table[base + low] + here * table[base + mid] + above * table[base + high]
            total += row_weights[i] * col_weights[j] * along
    return total
