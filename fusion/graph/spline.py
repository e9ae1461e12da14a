"""A smooth function from a table of log densities: the quadratic B-spline with the cells as coefficients.

It has a gradient everywhere, never overshoots, and what is concave stays concave. On a parabola it differs from the
table by a constant only, so that gradients and curvatures of a Gaussian are exact. Compiled by numba.

Source: Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine, 1999 (the
smoothing, not the interpolating, spline).
"""

from typing import Any

import numba
import numpy as np

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
