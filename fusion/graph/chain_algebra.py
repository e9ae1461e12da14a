"""Three by three: what the recursions along a chain of poses are made of, compiled by numba.

Residuals are GTSAM's, ``log`` of an error pose, with exact derivatives (Sola, Deray, Atchuthan, arXiv 1812.01537).
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_TWO_PI = 2.0 * np.pi


@numba.njit(inline="always", **OPTIONS)
def wrap(angle: float) -> float:
    return angle - _TWO_PI * np.floor((angle + np.pi) / _TWO_PI)


@numba.njit(**OPTIONS)
def product(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@numba.njit(**OPTIONS)
def add_square(a: NDArray[np.float64], middle: NDArray[np.float64], scale: float, out: NDArray[np.float64]) -> None:
    """``out += scale * a middle a^T``, symmetric to the bit."""
    for i in range(3):
        x = a[i, 0] * middle[0, 0] + a[i, 1] * middle[1, 0] + a[i, 2] * middle[2, 0]
        y = a[i, 0] * middle[0, 1] + a[i, 1] * middle[1, 1] + a[i, 2] * middle[2, 1]
        z = a[i, 0] * middle[0, 2] + a[i, 1] * middle[1, 2] + a[i, 2] * middle[2, 2]
        for j in range(i + 1):
            value = scale * (x * a[j, 0] + y * a[j, 1] + z * a[j, 2])
            out[i, j] += value
            if i != j:
                out[j, i] += value


@numba.njit(**OPTIONS)
def invert(a: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Inverse by cofactors."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            out[m, i] = a[j, n] * a[k, o] - a[j, o] * a[k, n]
    scale = 1.0 / (a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0])
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale


@numba.njit(**OPTIONS)
def log_error(
    turn: float, x: float, y: float, yaw: float, residual: NDArray[np.float64], inverse: NDArray[np.float64]
) -> None:
    """``log`` of an error that is (x, y) on axes turned by `turn` from the map's, and `yaw`.

    Written: the residual, and the inverse (3, 3) of its derivative by the deviation on the axes of the map.
    """
    cos, sin = np.cos(turn), np.sin(turn)
    half = 0.5 * yaw
    if abs(half) < 1e-4:
        a, slope = 1.0 - half * half / 3.0, -half / 3.0
    else:
        a = half * np.cos(half) / np.sin(half)
        slope = 0.5 * (np.cos(half) / np.sin(half) - half / np.sin(half) ** 2)
    residual[0], residual[1], residual[2] = a * x + half * y, -half * x + a * y, yaw
    # derivative by the error: [[a, half, p], [-half, a, q], [0, 0, 1]]; by the deviation: that times a turn back
    p, q = slope * x + 0.5 * y, slope * y - 0.5 * x
    scale = 1.0 / (a * a + half * half)
    i00, i01, i10, i11 = a * scale, -half * scale, half * scale, a * scale
    i02, i12 = -(i00 * p + i01 * q), -(i10 * p + i11 * q)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = cos * i00 - sin * i10, cos * i01 - sin * i11, cos * i02 - sin * i12
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = sin * i00 + cos * i10, sin * i01 + cos * i11, sin * i02 + cos * i12
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = 0.0, 0.0, 1.0


@numba.njit(**OPTIONS)
def square_length(residual: NDArray[np.float64], turn: float, precision: NDArray[np.float64]) -> float:
    """``r^T R P R^T r`` for a precision P on axes that are turned by `-turn` from the residual's."""
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, z = cos * residual[0] - sin * residual[1], sin * residual[0] + cos * residual[1], residual[2]
    cross = precision[0, 1] * x * y + precision[0, 2] * x * z + precision[1, 2] * y * z
    return float(precision[0, 0] * x * x + precision[1, 1] * y * y + precision[2, 2] * z * z + 2.0 * cross)
