"""Corners and weights of trilinear interpolation between cell centres, circular in yaw.

Source: the cell-centre convention of `fusion.grid`; yaw bin k is centred at ``2 pi k / K``.
"""

from collections.abc import Iterator

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.grid import MapGrid


def _neighbours(position: FloatArray, count: int) -> tuple[tuple[IntArray, FloatArray], tuple[IntArray, FloatArray]]:
    """Index and weight of the lower and the upper cell of a position in cells, clamped to the outermost centres."""
    position = np.clip(position - 0.5, 0.0, count - 1.0)
    lower = np.minimum(position.astype(np.int64), max(count - 2, 0))
    upper_weight = position - lower
    return (lower, 1.0 - upper_weight), (np.minimum(lower + 1, count - 1), upper_weight)


def corners(grid: MapGrid, bin_count: int, poses: FloatArray) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """The eight cells around each pose (N, 3).

    Yields
    ------
    cell : (N,) int64
        Flat index into a (rows, cols, bin_count) array.
    pixel : (N,) int64
        Flat index into a (rows, cols) array.
    weight : (N,) float64
        Share of the cell; the eight sum to 1.
    """
    row_col = grid.pixel_from_xy(poses[:, :2])
    turns = poses[:, 2] / se2.TWO_PI
    yaw = (turns - np.floor(turns)) * bin_count
    lower = yaw.astype(np.int64)
    fraction = yaw - lower
    yaw_pair = ((lower % bin_count, 1.0 - fraction), ((lower + 1) % bin_count, fraction))
    for row, row_weight in _neighbours(row_col[:, 0], grid.rows):
        for col, col_weight in _neighbours(row_col[:, 1], grid.cols):
            pixel = row * grid.cols + col
            for yaw_bin, yaw_weight in yaw_pair:
                yield pixel * bin_count + yaw_bin, pixel, row_weight * col_weight * yaw_weight
