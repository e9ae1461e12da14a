"""A 2.5-D world that laser beams can be cast into: ground, solid things on it, and porous things that let part of
the beams through.

All layers share one grid. Solids (buildings, walls, cars, trunks) form a height field; foliage, fences and
balconies are a slab between two heights with a chance of a return per metre. Heights of porous slabs are stored in
decimetres above the ground and their densities in steps of 1/20 per metre, so that a square kilometre at 0.25 m
fits in memory (13 bytes a cell).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from sequences import paint
from sequences.osm import Line

DENSITY_STEP_PER_M = 0.05
HEIGHT_STEP_M = 0.1


class Material(IntEnum):
    """What a cell's surface is made of; decides reflectance and drop-out."""

    SOIL = 0
    ROAD = 1
    BUILDING = 2
    WALL = 3
    FENCE = 4
    FOLIAGE = 5
    CAR = 6
    POLE = 7
    GRASS = 8
    WATER = 9


@dataclass(frozen=True, slots=True)
class World:
    """Rasters (rows, cols) of a world, row 0 in the north.

    Attributes
    ----------
    grid
        Where they lie in the map frame.
    ground
        float32, height of the bare ground, metres.
    surface
        float32, height of the top of what is solid (the ground where nothing stands), metres.
    canopy_bottom, canopy_top
        uint8, porous slab above the ground, decimetres; top 0 where there is none.
    canopy_density
        uint8, chance of a return per metre of path, in steps of `DENSITY_STEP_PER_M`.
    material
        uint8, `Material` of the solid or bare surface.
    roads
        Where the carriageways are; none for a world made from a raster.
    """

    grid: MapGrid
    ground: NDArray[np.float32]
    surface: NDArray[np.float32]
    canopy_bottom: NDArray[np.uint8]
    canopy_top: NDArray[np.uint8]
    canopy_density: NDArray[np.uint8]
    material: NDArray[np.uint8]
    roads: tuple[Line, ...] = ()

    def cells(self, xy: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column of the cells that hold map points (..., 2), clamped to the grid."""
        rc = np.floor(self.grid.pixel_from_xy(xy)).astype(np.intp)
        return np.clip(rc[..., 0], 0, self.grid.rows - 1), np.clip(rc[..., 1], 0, self.grid.cols - 1)

    def ground_at(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the bare ground at map points (..., 2), metres; outside the grid that of the nearest cell."""
        return self.ground[self.cells(xy)].astype(np.float64)

    def is_free(self, xy: NDArray[np.float64], radius_m: float = 2.0, height_m: float = 2.0) -> NDArray[np.bool_]:
        """Whether nothing solid or porous below `height_m` stands within `radius_m` of map points (..., 2)."""
        tall = (self.surface - self.ground > 0.3) | (
            (self.canopy_top > 3) & (self.canopy_bottom < round(height_m / HEIGHT_STEP_M))
        )
        size = 2 * round(radius_m / self.grid.metres_per_pixel) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        blocked = cv2.dilate(tall.astype(np.uint8), kernel)
        free: NDArray[np.bool_] = (blocked[self.cells(xy)] == 0) & self.grid.contains(xy)
        return free

    def cleared(self, path_xy: NDArray[np.float64], width_m: float) -> World:
        """The world with everything but buildings taken away along a path (N, 2), so that a vehicle can drive
        there."""
        lane = np.zeros(self.ground.shape, dtype=np.uint8)
        paint.stroke(lane, self.grid, path_xy, 1, width_m)
        clear = (lane > 0) & (self.material != Material.BUILDING)
        surface, top = self.surface.copy(), self.canopy_top.copy()
        surface[clear] = self.ground[clear]
        top[clear & (self.canopy_bottom < round(3.0 / HEIGHT_STEP_M))] = 0
        return replace(self, surface=surface, canopy_top=top)
