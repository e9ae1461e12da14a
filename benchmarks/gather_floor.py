"""The floor of a filter step on a volume: reading the eight cells around every particle, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from fusion import LikelihoodVolume, se2
from fusion.arrays import FloatArray
from fusion.kernels.float_math import KERNEL, F, take


@numba.njit(**KERNEL)
def _gathered(table: NDArray[np.float32], cells: NDArray[np.int32], east: int, south: int) -> np.float32:
    total = F(0.0)
    for j in range(len(cells)):
        a = cells[j]
        b = np.int32(a + np.int32(east))
        c, d = np.int32(a + np.int32(south)), np.int32(b + np.int32(south))
        total += take(table, a) + take(table, np.int32(a + np.int32(1)))
        total += take(table, b) + take(table, np.int32(b + np.int32(1)))
        total += take(table, c) + take(table, np.int32(c + np.int32(1)))
        total += take(table, d) + take(table, np.int32(d + np.int32(1)))
    return total


def gather_floor(poses: FloatArray, volume: LikelihoodVolume) -> Callable[[], object]:
    """The gather as a piece of work: where the cells of poses (N, 3) lie has been worked out before."""
    grid, bins = volume.grid, volume.log_prob.shape[2]
    row, col = np.clip(grid.pixel_from_xy(poses[:, :2]), 0, (grid.rows - 2, grid.cols - 2)).astype(np.int64).T
    heading = np.minimum((poses[:, 2] % se2.TWO_PI) / se2.TWO_PI * bins, bins - 2).astype(np.int64)
    cells = ((row * grid.cols + col) * bins + heading).astype(np.int32)
    table = volume.log_prob.reshape(-1)
    return lambda: _gathered(table, cells, bins, grid.cols * bins)
