"""Moments of likelihoods under Gaussian windows: all poses in one pass, compiled by numba.

A window ``N(c, W)`` that is not much wider than the cells is summed on a lattice of its own, in coordinates in which it
is the unit Gaussian (`fusion.graph.window_lattice`). A wide one is summed cell by cell.
"""

from typing import Any

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from fusion.graph.spline import OPTIONS
from fusion.graph.window_lattice import REACH, sum_lattice
from fusion.kernels.float_math import intrinsic

_WIDE_CELLS = 1.5  # standard deviations of a window along each axis from which cells are sampled well enough


@numba.njit(forceinline=True, **OPTIONS)
def _is_wide(root: NDArray[np.float64], metres: float, radians: float) -> bool:
    """Whether the window's standard deviations given the other axes are wide against the cells."""
    least = min(root[0, 0], root[1, 1]) / metres
    return min(least, root[2, 2] / radians) > _WIDE_CELLS


@numba.njit(forceinline=True, **OPTIONS)
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


@intrinsic
def _cells_at(_context: Any, address: Any) -> Any:
    """The float32 values that begin at an address."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.int64), generate


@numba.njit(**OPTIONS)
def window_moments(
    tables: NDArray[np.int64],
    places: NDArray[np.float64],
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
    tables : (M, 5) int64
        Of each likelihood's ln densities, float32: the address in memory, rows, columns, yaw bins, and whether these
        close to a circle.
    places : (M, 8) float64
        x, y and yaw of the centre of the first cell, rows go down; metres and radians of a cell; ln density beyond the
        cells, and of an outlier; its probability p.
    centres, roots : (M, 3), (M, 3, 3) float64
        Of the windows; the lower triangular roots of their covariances.
    log_mass, means, spreads, flat
        Written: ln of the windowed mass, mean (M, 3) and covariance (M, 3, 3) of u, and the variances (M, 3) that a
        flat likelihood would have had on the same lattice.
    """
    for m in range(len(tables)):
        patch = numba.carray(_cells_at(tables[m, 0]), (tables[m, 1], tables[m, 2], tables[m, 3]))
        first, cell, floor = places[m, :3], places[m, 3:5], places[m, 5]
        log_uniform, outlier = places[m, 6], places[m, 7]
        if _is_wide(roots[m], cell[0], cell[1]):
            log_mass[m] = _sum_cells(
                patch, first, cell, log_uniform, outlier, centres[m], roots[m], means[m], spreads[m]
            )
            flat[m] = 1.0
        else:
            log_mass[m] = sum_lattice(
                patch,
                tables[m, 4] == 1,
                first,
                cell,
                floor,
                log_uniform,
                outlier,
                centres[m],
                roots[m],
                means[m],
                spreads[m],
                flat[m],
            )
