"""A world from a map that exists only as a class raster, such as a segmented aerial image.

Buildings are extruded, each connected one with its own height; vegetation becomes bushes, hedges and trees of
varying height and density; cars stand along the edges of roads, whose direction is read from the distance to the
edge.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences.world_layers import WorldLayers
from sequences.world_model import Material, World
from sequences.world_plants import add_bush, add_tree, scatter
from sequences.world_roads import add_car
from sequences.world_style import WorldStyle
from sequences.world_terrain import distance_m, smooth_noise, terrain

_FINEST_M, _COARSEST_M = 0.25, 0.34
_MAX_CELLS = 32e6
_CENTRELINE_WIDTH_M = 8.5
_CAR_SPACING_M = 6.5


def world_from_raster(map_raster: MapRaster, seed: int, style: WorldStyle | None = None) -> World:
    """Extrude a class raster; the same seed gives the same world.

    Parameters
    ----------
    map_raster
        A map with classes. Roads may be areas or centrelines of one pixel.
    seed
        Seed of everything that the map does not say.
    style
        How the world deviates from the map; default: `WorldStyle()`.

    Raises
    ------
    SkyfixError
        If the map is a photograph without classes.
    """
    if map_raster.classes is None:
        raise SkyfixError("world: expected a map with classes, got a photograph")
    rng = np.random.default_rng(seed)
    style = style or WorldStyle()
    classes, grid = _resampled(map_raster)
    layers = WorldLayers(grid)
    layers.paved = _carriageway(classes, map_raster.grid.metres_per_pixel, grid)
    layers.base[layers.paved > 0] = Material.ROAD
    layers.base[classes == CLASS_INDEX["grass"]] = Material.GRASS
    layers.base[classes == CLASS_INDEX["water"]] = Material.WATER
    ground, off_road = terrain(grid, layers.paved, style, rng)

    building = (classes == CLASS_INDEX["building"]).astype(np.uint8)
    room = (off_road > 0.6) & (building == 0)
    _vegetate(layers, classes, room, style, rng)
    _barriers(layers, classes, style, rng)
    _park_cars(layers, off_road, style, rng)
    texture = np.exp(np.float32(0.5) * smooth_noise(grid, 0.8, rng))
    world = layers.finish(ground, room, texture)
    _extrude(world, building, style, rng)
    return world


def _resampled(map_raster: MapRaster) -> tuple[NDArray[np.uint8], MapGrid]:
    """Classes at the world's resolution: that of the map if fine enough, else a finer one."""
    grid = map_raster.grid
    assert map_raster.classes is not None
    step = grid.metres_per_pixel
    if not _FINEST_M <= step <= _COARSEST_M:
        step = max(_FINEST_M, float(np.sqrt(grid.area_m2 / _MAX_CELLS)))
    rows, cols = max(1, round(grid.height_m / step)), max(1, round(grid.width_m / step))
    if (rows, cols) == (grid.rows, grid.cols):
        return map_raster.classes, grid
    fine = cv2.resize(map_raster.classes, (cols, rows), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(fine, dtype=np.uint8), MapGrid(rows, cols, step, grid.x0, grid.y0)


def _carriageway(classes: NDArray[np.uint8], map_step_m: float, grid: MapGrid) -> NDArray[np.uint8]:
    """Cells of carriageways and car parks; roads drawn as centrelines are widened."""
    road = np.isin(classes, [CLASS_INDEX["road"], CLASS_INDEX["parking"]]).astype(np.uint8)
    size = 2 * int(np.ceil(map_step_m / grid.metres_per_pixel)) + 1
    wide = cv2.morphologyEx(road, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    if np.count_nonzero(wide) > 0.5 * np.count_nonzero(road):
        return road
    narrow = (distance_m(road, grid) < 0.5 * _CENTRELINE_WIDTH_M) & (classes != CLASS_INDEX["building"])
    return narrow.astype(np.uint8)


def _extrude(world: World, building: NDArray[np.uint8], style: WorldStyle, rng: np.random.Generator) -> None:
    number, labels, stats, _ = cv2.connectedComponentsWithStats(building, connectivity=4)
    storeys = np.maximum(1.0, rng.normal(style.storeys, 0.8, number))
    heights = np.where(stats[:, cv2.CC_STAT_AREA] * world.grid.metres_per_pixel**2 < 40.0, 2.6, 3.0 * storeys + 2.0)
    where = np.flatnonzero(building)
    world.surface.ravel()[where] = world.ground.ravel()[where] + heights[labels.ravel()[where]].astype(np.float32)
    world.material.ravel()[where] = Material.BUILDING


def _vegetate(
    layers: WorldLayers,
    classes: NDArray[np.uint8],
    room: NDArray[np.bool_],
    style: WorldStyle,
    rng: np.random.Generator,
) -> None:
    """Brushwood and hedges of varying height along with trees where vegetation is, a few bushes elsewhere."""
    forest = ((classes == CLASS_INDEX["forest"]) & room).astype(np.uint8)
    patches = smooth_noise(layers.grid, 9.0, rng) + np.float32(0.6) * smooth_noise(layers.grid, 2.0, rng)
    tallness = np.clip((patches + np.float32(0.3)) * np.float32(1.5), 0.0, 4.0)
    layers.brush_m = np.where(forest > 0, tallness, np.float32(0.0))
    layers.brush_density_per_m = style.foliage_per_m
    for point in scatter(forest, 1000.0 / 8.0**2, layers, rng):
        add_tree(layers, point, rng.uniform(0.4, 1.2), style, rng)
    open_ground = (room & (forest == 0) & (classes != CLASS_INDEX["water"])).astype(np.uint8)
    for point in scatter(open_ground, 0.3 * style.bush_density, layers, rng):
        add_bush(layers, point, style, rng)
    for point in scatter(open_ground, 0.3 * style.tree_density, layers, rng):
        add_tree(layers, point, rng.uniform(0.3, 1.0), style, rng)


def _barriers(layers: WorldLayers, classes: NDArray[np.uint8], style: WorldStyle, rng: np.random.Generator) -> None:
    """Walls, fences, hedges and tree rows that the raster draws."""
    for kind, top, material, density in (
        ("wall", 1.6, Material.WALL, 0.0),
        ("fence", 1.4, Material.FENCE, 3.0),
        ("hedge", 1.6, Material.FOLIAGE, 2.5 * style.foliage_per_m),
    ):
        layers.boundaries.cells(classes == CLASS_INDEX[kind], top, material, 0.0, density)
    rows, cols = np.nonzero(classes == CLASS_INDEX["tree"])
    thinned = rng.random(len(rows)) < layers.grid.metres_per_pixel / 8.0
    spots = np.stack([rows[thinned], cols[thinned]], axis=-1) + 0.5
    for point in layers.grid.xy_from_pixel(spots):
        add_tree(layers, point, rng.uniform(0.6, 1.2), style, rng)


def _park_cars(layers: WorldLayers, off_road: NDArray[np.float32], style: WorldStyle, rng: np.random.Generator) -> None:
    """Cars along the edges of carriageways; the edge's direction is that of the distance field's contour lines."""
    grid = layers.grid
    inside = distance_m((layers.paved == 0).astype(np.uint8), grid)
    edge = (inside > 0.7) & (inside < 0.7 + 1.5 * grid.metres_per_pixel)
    rows, cols = np.nonzero(edge)
    keep = rng.random(len(rows)) < 0.6 * style.parked_share * grid.metres_per_pixel / _CAR_SPACING_M
    blurred = cv2.GaussianBlur(inside - np.minimum(off_road, np.float32(3.0)), (0, 0), 1.5 / grid.metres_per_pixel)
    for row, col in zip(rows[keep], cols[keep], strict=True):
        if not (1 <= row < grid.rows - 1 and 1 <= col < grid.cols - 1):
            continue
        across_x = float(blurred[row, col + 1] - blurred[row, col - 1])
        across_y = float(blurred[row - 1, col] - blurred[row + 1, col])
        xy = grid.xy_from_pixel(np.array([row + 0.5, col + 0.5]))
        add_car(layers, np.array([*xy, np.arctan2(across_y, across_x) + 0.5 * np.pi]), rng)
