"""Layers under construction: things are stamped by number, their heights looked up once at the end.

Each thing costs one OpenCV call on an int32 raster, whatever its number of attributes, which keeps the building of
an area well under half a second.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from sequences import paint
from sequences.world_model import DENSITY_STEP_PER_M, HEIGHT_STEP_M, Material, World


class StampLayer:
    """Numbered things on one grid, each with (bottom m, top m, density per m, material); later ones cover earlier
    ones."""

    def __init__(self, grid: MapGrid) -> None:
        self.grid = grid
        self.numbers: NDArray[np.int32] = np.zeros((grid.rows, grid.cols), dtype=np.int32)
        self._rows: list[tuple[float, float, float, float]] = [(0.0, 0.0, 0.0, 0.0)]

    def _next(self, top_m: float, material: Material, bottom_m: float, density_per_m: float) -> int:
        self._rows.append((bottom_m, top_m, density_per_m, float(material)))
        return len(self._rows) - 1

    def polygon(
        self,
        rings: Sequence[NDArray[np.float64]],
        top_m: float,
        material: Material,
        bottom_m: float = 0.0,
        density_per_m: float = 0.0,
    ) -> None:
        """Stamp a filled polygon; rings after the first are holes."""
        paint.fill(self.numbers, self.grid, rings, self._next(top_m, material, bottom_m, density_per_m))

    def line(
        self,
        points: NDArray[np.float64],
        width_m: float,
        top_m: float,
        material: Material,
        bottom_m: float = 0.0,
        density_per_m: float = 0.0,
    ) -> None:
        """Stamp a polyline (N, 2) of some width."""
        paint.stroke(self.numbers, self.grid, points, self._next(top_m, material, bottom_m, density_per_m), width_m)

    def disc(
        self,
        xy: NDArray[np.float64],
        radius_m: float,
        top_m: float,
        material: Material,
        bottom_m: float = 0.0,
        density_per_m: float = 0.0,
    ) -> None:
        """Stamp a disc about a point (2,)."""
        paint.disc(self.numbers, self.grid, xy, radius_m, self._next(top_m, material, bottom_m, density_per_m))

    def cells(
        self,
        mask: NDArray[np.bool_],
        top_m: float,
        material: Material,
        bottom_m: float = 0.0,
        density_per_m: float = 0.0,
    ) -> None:
        """Stamp the cells (rows, cols) of a mask."""
        self.numbers[mask] = self._next(top_m, material, bottom_m, density_per_m)

    def table(self) -> NDArray[np.float32]:
        """Attributes by number, shape (n, 4): bottom, top, density, material."""
        return np.array(self._rows, dtype=np.float32)


class WorldLayers:
    """Everything that stands on the ground of a world being built.

    `solid` is a height field; `low` (hedges, bushes, fences) and `crowns` (trees, balconies) are porous, and the
    low wins where both are; `brush_m` is the height of brushwood from the ground up. `boundaries` holds solid and
    porous garden boundaries until it is known where roads and buildings leave room for them.
    """

    def __init__(self, grid: MapGrid) -> None:
        self.grid = grid
        self.solid = StampLayer(grid)
        self.low = StampLayer(grid)
        self.crowns = StampLayer(grid)
        self.boundaries = StampLayer(grid)
        self.paved: NDArray[np.uint8] = np.zeros((grid.rows, grid.cols), dtype=np.uint8)
        self.brush_m: NDArray[np.float32] = np.zeros((grid.rows, grid.cols), dtype=np.float32)
        self.brush_density_per_m = 0.0
        self.base: NDArray[np.uint8] = np.full((grid.rows, grid.cols), int(Material.SOIL), dtype=np.uint8)

    def finish(
        self, ground: NDArray[np.float32], boundary_room: NDArray[np.bool_], texture: NDArray[np.float32]
    ) -> World:
        """Look all attributes up.

        Parameters
        ----------
        ground
            (rows, cols) height of the bare ground, metres.
        boundary_room
            (rows, cols) where garden boundaries may stand.
        texture
            (rows, cols) factor about 1 on the height of porous things, squared on their density: foliage is not smooth.
        """
        surface = ground.copy()
        material = self.base
        bottom = np.zeros(ground.shape, dtype=np.uint8)
        top, density = np.zeros_like(bottom), np.zeros_like(bottom)
        for layer in (self.crowns, self.boundaries, self.low):
            mask = layer.numbers > 0
            if layer is self.boundaries:
                brush = self.brush_m > 0.05
                bottom[brush] = 0
                top[brush] = np.clip(self.brush_m[brush] / HEIGHT_STEP_M, 1, 255).astype(np.uint8)
                density[brush] = np.clip(
                    self.brush_density_per_m * texture[brush] ** 2 / DENSITY_STEP_PER_M, 1, 255
                ).astype(np.uint8)
                mask &= boundary_room
            where = np.flatnonzero(mask)
            rows = layer.table()[layer.numbers.ravel()[where]]
            porous = rows[:, 2] > 0.0
            solid_cells, solid_rows = where[~porous], rows[~porous]
            surface.ravel()[solid_cells] += solid_rows[:, 1]
            material.ravel()[solid_cells] = solid_rows[:, 3].astype(np.uint8)
            cells, rows = where[porous], rows[porous]
            factor = np.where(rows[:, 3] == float(Material.FOLIAGE), texture.ravel()[cells], np.float32(1.0))
            bottom.ravel()[cells] = np.clip(rows[:, 0] / HEIGHT_STEP_M, 0, 255).astype(np.uint8)
            top.ravel()[cells] = np.clip(rows[:, 1] * factor / HEIGHT_STEP_M, 0, 255).astype(np.uint8)
            density.ravel()[cells] = np.clip(rows[:, 2] * factor**2 / DENSITY_STEP_PER_M, 1, 255).astype(np.uint8)
        where = np.flatnonzero(self.solid.numbers)
        rows = self.solid.table()[self.solid.numbers.ravel()[where]]
        surface.ravel()[where] = ground.ravel()[where] + rows[:, 1]
        material.ravel()[where] = rows[:, 3].astype(np.uint8)
        return World(self.grid, ground, surface, bottom, top, density, material)
