"""MapGrid: the only home of the pixel <-> metre convention, in both directions.

The map frame is in metres, x east along the columns, y north against the rows (REP-105, a local origin). A raster is
``array[row, col]`` with row 0 in the north. Continuous pixel coordinates follow GDAL: integers are pixel *edges* and
the centre of pixel (r, c) is (r + 0.5, c + 0.5), so that

    x = x0 + (c + 0.5) * metres_per_pixel        y = y0 + (rows - r - 0.5) * metres_per_pixel

with (x0, y0) the lower-left corner. Any other convention (GeoTIFF, ROS ``MapMetaData``, tiles) is converted by the
reader of that format.
"""

from dataclasses import dataclass
from math import ceil, floor, isfinite

import numpy as np
from numpy.typing import ArrayLike

from fusion.arrays import BoolArray, FloatArray, checked, keep_plain
from fusion.errors import SkyfixError

_SNAP_TOLERANCE_PIXELS = 1e-3


@dataclass(frozen=True, slots=True)
class MapGrid:
    """Where a raster lies in the map frame.

    Parameters
    ----------
    rows, cols : int
        Size of the raster, at least one pixel.
    metres_per_pixel : float
        Side of a square pixel.
    x0, y0 : float
        Lower-left corner of the raster (the corner, not the centre of a pixel), metres in the map frame.

    Raises
    ------
    SkyfixError
        When a size is not positive or a value is not finite.
    """

    rows: int
    cols: int
    metres_per_pixel: float
    x0: float
    y0: float

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        if not all(size >= 1 and float(size).is_integer() for size in (self.rows, self.cols)):
            raise SkyfixError(f"grid: expected whole numbers of pixels from 1 x 1 on, got {self.rows} x {self.cols}")
        if not (isfinite(self.metres_per_pixel) and self.metres_per_pixel > 0.0):
            raise SkyfixError(f"grid: expected metres_per_pixel > 0, got {self.metres_per_pixel}")
        if not (isfinite(self.x0) and isfinite(self.y0)):
            raise SkyfixError(f"grid: expected a finite corner, got ({self.x0}, {self.y0})")

    @property
    def width_m(self) -> float:
        """Extent along x."""
        return self.cols * self.metres_per_pixel

    @property
    def height_m(self) -> float:
        """Extent along y."""
        return self.rows * self.metres_per_pixel

    @property
    def area_m2(self) -> float:
        """Area covered."""
        return self.width_m * self.height_m

    @property
    def centre_xy(self) -> FloatArray:
        """Centre of the raster, (2,), map frame."""
        return np.array([self.x0 + 0.5 * self.width_m, self.y0 + 0.5 * self.height_m])

    def pixel_from_xy(self, xy: ArrayLike) -> FloatArray:
        """Continuous (row, col) coordinates, integers at pixel edges, of map points (..., 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        row = self.rows - (xy[..., 1] - self.y0) / self.metres_per_pixel
        col = (xy[..., 0] - self.x0) / self.metres_per_pixel
        return np.stack([row, col], axis=-1)

    def xy_from_pixel(self, row_col: ArrayLike) -> FloatArray:
        """Map points (..., 2) of continuous (row, col) coordinates; the inverse of :meth:`pixel_from_xy`."""
        row_col = np.asarray(row_col, dtype=np.float64)
        x = self.x0 + row_col[..., 1] * self.metres_per_pixel
        y = self.y0 + (self.rows - row_col[..., 0]) * self.metres_per_pixel
        return np.stack([x, y], axis=-1)

    def centres(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates of the pixel centres: x of every column (cols,), y of every row (rows,), y falling."""
        col = np.arange(self.cols, dtype=np.float64) + 0.5
        row = np.arange(self.rows, dtype=np.float64) + 0.5
        return self.x0 + col * self.metres_per_pixel, self.y0 + (self.rows - row) * self.metres_per_pixel

    def contains(self, xy: ArrayLike) -> BoolArray:
        """Whether map points (..., 2) lie on the raster, edges included; NaN lies nowhere."""
        xy = np.asarray(xy, dtype=np.float64)
        inside_x = (xy[..., 0] >= self.x0) & (xy[..., 0] <= self.x0 + self.width_m)
        inside_y = (xy[..., 1] >= self.y0) & (xy[..., 1] <= self.y0 + self.height_m)
        return inside_x & inside_y

    def window(self, centre_xy: ArrayLike, half_extent_m: float) -> "MapGrid":
        """Square window on this grid's pixels that covers `centre_xy` +- `half_extent_m`.

        The window has an odd side, ``2 * ceil(half_extent_m / metres_per_pixel) + 1`` pixels, and its middle pixel
        holds `centre_xy`. It may reach beyond this grid.

        Raises
        ------
        SkyfixError
            When the centre is not finite or the extent is not positive.
        """
        centre = checked("window centre", centre_xy, (2,))
        if not (isfinite(half_extent_m) and half_extent_m > 0.0):
            raise SkyfixError(f"window: expected half_extent_m > 0, got {half_extent_m}")
        row, col = (floor(value) for value in self.pixel_from_xy(centre))
        half = ceil(half_extent_m / self.metres_per_pixel - _SNAP_TOLERANCE_PIXELS)
        x0 = self.x0 + (col - half) * self.metres_per_pixel
        y0 = self.y0 + (self.rows - row - half - 1) * self.metres_per_pixel
        return MapGrid(2 * half + 1, 2 * half + 1, self.metres_per_pixel, x0, y0)

    def offset_of(self, window: "MapGrid") -> tuple[int, int]:
        """Row and column in this grid of the window's pixel (0, 0); negative where it reaches beyond.

        Raises
        ------
        SkyfixError
            When the window's pixels are not this grid's pixels.
        """
        top_left = window.xy_from_pixel((0.0, 0.0))
        offset = self.pixel_from_xy(top_left)
        whole = np.rint(offset)
        same_scale = abs(window.metres_per_pixel / self.metres_per_pixel - 1.0) < 1e-9
        if not same_scale or np.abs(offset - whole).max() > _SNAP_TOLERANCE_PIXELS:
            raise SkyfixError(f"window: expected pixels of {self}, got {window}")
        return int(whole[0]), int(whole[1])
