"""One photograph of a whole drive from KITTI + aerial's satellite images, each centred at the GPS fix of a frame.

Images are taken every so many metres of the drive; each pixel is that of the image whose centre is nearest, where the
image is least distorted. The protocol takes one scale for all of KITTI, so that neighbouring images agree to the pixel.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import MapRaster

SPACING_M = 25.0
_MOST_PIXELS = 4e8


def mosaic(centres: FloatArray, photograph: Callable[[int], MapRaster]) -> MapRaster:
    """Photographs laid on one grid.

    Parameters
    ----------
    centres
        (N, 2) metres in the map frame, one a frame in the order of the drive.
    photograph
        Gives that of a frame, its origin at the frame's centre. All have one size and scale.

    Raises
    ------
    SkyfixError
        If the photographs differ in size or scale, or the whole would be too large.
    """
    used = spaced(centres)
    first = photograph(used[0]).grid
    scale = first.metres_per_pixel
    low = np.floor((centres[used].min(axis=0) - 0.5 * np.array([first.width_m, first.height_m])) / scale)
    high = np.ceil((centres[used].max(axis=0) + 0.5 * np.array([first.width_m, first.height_m])) / scale)
    cols, rows = (high - low).astype(int) + 1
    if rows * cols > _MOST_PIXELS:
        raise SkyfixError(f"map: expected a drive that fits {_MOST_PIXELS:.0e} pixels, got {rows} x {cols}")
    grid = MapGrid(int(rows), int(cols), scale, float(low[0] * scale), float(low[1] * scale))
    picture = np.zeros((grid.rows, grid.cols, 3), dtype=np.uint8)
    nearest = np.full((grid.rows, grid.cols), np.inf, dtype=np.float32)
    for index in used:
        one = photograph(index)
        if (one.grid.rows, one.grid.cols, one.grid.metres_per_pixel) != (first.rows, first.cols, scale):
            raise SkyfixError(
                f"satellite images: expected {first.rows} x {first.cols} px, got {one.grid.rows} x {one.grid.cols}"
            )
        top, left = np.rint(grid.pixel_from_xy(centres[index] + one.grid.xy_from_pixel((0.0, 0.0)))).astype(int)
        here = np.s_[top : top + first.rows, left : left + first.cols]
        from_middle = [np.arange(size, dtype=np.float32) + 0.5 - 0.5 * size for size in (first.rows, first.cols)]
        distance = np.hypot(from_middle[0][:, None], from_middle[1][None, :])
        closer = distance < nearest[here]
        picture[here][closer] = one.picture[closer]
        nearest[here][closer] = distance[closer]
    return MapRaster(grid, None, picture)


def spaced(centres: FloatArray) -> list[int]:
    """The first frame, every next one that is far enough from the last, and the last."""
    used = [0]
    for index in range(1, len(centres)):
        if np.hypot(*(centres[index] - centres[used[-1]])) >= SPACING_M:
            used.append(index)
    return used if used[-1] == len(centres) - 1 else [*used, len(centres) - 1]
