"""PoseLattice: where the cells of a grid filter lie, a grid that rides along with the vehicle in parts of a cell.

A motion hardly ever ends on a cell's centre. To split its mass among the cells around adds up to a quarter of a cell
squared to the variance, at every step. So nothing is split: whole cells are moved, and what is left over is kept as an
offset of the whole plane of a heading, at most half a cell, and as a turn of all headings together.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.grid import MapGrid


@dataclass(frozen=True, slots=True, eq=False)
class PoseLattice:
    """Cells over K headings and a raster.

    Parameters
    ----------
    grid : MapGrid
        The raster.
    offsets : (K, 2) float64
        How far (rows, cols) the plane of each heading lies from the raster, in cells, within half a cell.
    turned : float
        Heading of plane 0, radians; the others follow at ``2 pi / K``.

    Raises
    ------
    SkyfixError
        When there is no heading or a value is not finite.
    """

    grid: MapGrid
    offsets: FloatArray
    turned: float = 0.0

    def __post_init__(self) -> None:
        offsets = checked("lattice offsets", self.offsets, ("K", 2))
        if len(offsets) == 0 or not np.isfinite(self.turned):
            raise SkyfixError(f"lattice: expected headings and a finite turn, got {len(offsets)}, {self.turned}")
        object.__setattr__(self, "offsets", read_only(offsets))
        object.__setattr__(self, "turned", float(se2.wrap(self.turned)))

    @classmethod
    def of(cls, grid: MapGrid, headings: int) -> Self:
        """Cells at the pixel centres of `grid`, `headings` of them around the circle from zero."""
        if headings < 1:
            raise SkyfixError(f"headings: expected at least 1, got {headings}")
        return cls(grid, np.zeros((headings, 2)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(K, rows, cols), the shape of everything on the lattice."""
        return len(self.offsets), self.grid.rows, self.grid.cols

    @property
    def cell(self) -> FloatArray:
        """Extent of a cell in [x, y, yaw], (3,): metres, metres, radians."""
        side = self.grid.metres_per_pixel
        return np.array([side, side, se2.TWO_PI / len(self.offsets)])

    @property
    def headings(self) -> FloatArray:
        """Heading of every plane, (K,), wrapped."""
        return se2.wrap(self.turned + np.arange(len(self.offsets)) * self.cell[2])

    def poses(self, plane: int) -> FloatArray:
        """Poses (rows * cols, 3) of the cells of a plane, row by row."""
        row, col = np.indices(self.shape[1:], dtype=np.float64).reshape(2, -1)
        centres = np.stack([row, col], axis=-1) + 0.5 + self.offsets[plane]
        return np.column_stack([self.grid.xy_from_pixel(centres), np.full(len(row), self.headings[plane])])

    def at(self, cells: IntArray) -> FloatArray:
        """Poses (N, 3) of cells (N, 3) given as (plane, row, col)."""
        plane = cells[:, 0]
        xy = self.grid.xy_from_pixel(cells[:, 1:] + 0.5 + self.offsets[plane])
        return np.column_stack([xy, self.headings[plane]])
