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
from fusion.graph.window_lattice import REACH, beyond_cells, bins_of_a_turn, put_moments, sum_lattice
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
    floor: float,
    log_uniform: float,
    outlier: float,
    centre: NDArray[np.float64],
    root: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> float:
    """As `window_moments` for one likelihood, summed over its cells (rows, cols, bins) and their images a turn apart.

    The floor and outliers are added as the whole window, exactly, and the cells by what they are above the floor.
    """
    (rows, cols, bins), metres, radians = patch.shape, cell[0], cell[1]
    volume = metres * metres * radians / ((2.0 * np.pi) ** 1.5 * root[0, 0] * root[1, 1] * root[2, 2])
    volume *= 1.0 - outlier
    beyond, turn = beyond_cells(floor, log_uniform), bins_of_a_turn(radians)
    total, s0, s1, s2 = (1.0 - outlier) * beyond + outlier, 0.0, 0.0, 0.0
    s00, s01, s02, s11, s12, s22 = total, 0.0, 0.0, total, 0.0, total
    turned = (centre[2] - first[2]) / radians
    for row in range(rows):
        y = first[1] - metres * row - centre[1]
        for col in range(cols):
            u0 = (first[0] + metres * col - centre[0]) / root[0, 0]
            u1 = (y - root[1, 0] * u0) / root[1, 1]
            plan = u0 * u0 + u1 * u1
            if plan > REACH * REACH:
                continue
            middle = turned + (root[2, 0] * u0 + root[2, 1] * u1) / radians
            half = np.sqrt(REACH * REACH - plan) * root[2, 2] / radians
            least, most = int(np.ceil(middle - half)), int(np.floor(middle + half))
            mass, flank, square = 0.0, 0.0, 0.0  # sums of 1, u2 and u2 u2
            for begin in range(least // turn * turn, most + 1, turn):
                for k in range(max(least - begin, 0), min(most - begin + 1, bins)):
                    u2 = (begin + k - middle) * radians / root[2, 2]
                    share = np.exp(-0.5 * u2 * u2) * (np.exp(patch[row, col, k] - log_uniform) - beyond)
                    mass += share
                    flank += share * u2
                    square += share * u2 * u2
            weight = volume * np.exp(-0.5 * plan)
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
                patch, first, cell, floor, log_uniform, outlier, centres[m], roots[m], means[m], spreads[m]
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
