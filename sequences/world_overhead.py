"""The map of a world as an aerial image shows it, segmented: what lies on top, in blobs.

OpenStreetMap draws what surveyors find worth drawing; a segmented aerial image shows every crown and hedge, hides what
is below them, and knows neither walls nor fences nor kinds of ground. A network that has seen only the former takes the
latter's vegetation for woods with free edges.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences.world_model import HEIGHT_STEP_M, Material, World
from sequences.world_terrain import smooth_noise

_SHOWN = ("void", "road", "building", "forest", "grass", "water")
_LEAST_PLANT_M = 0.8
_SURFACES = {
    Material.ROAD: "road",
    Material.CAR: "road",
    Material.BUILDING: "building",
    Material.GRASS: "grass",
    Material.WATER: "water",
}


def overhead_map(world: World, grid: MapGrid, offset_m: float, rng: np.random.Generator) -> MapRaster:
    """Segment a world seen from above.

    Every class is smeared by as much as a segmentation smears, its logits are disturbed by noise that varies over a
    few metres, and the most likely one is taken; what is narrower than the smear is gone.

    Parameters
    ----------
    world
        What stands there.
    grid
        Extent and resolution of the map, within the world.
    offset_m
        Standard deviation of the whole map's shift against the world, along each axis.
    rng
        Everything random is drawn from it.
    """
    step = world.grid.metres_per_pixel
    smear_px = rng.uniform(0.4, 1.1) / step
    shift = rng.normal(0.0, offset_m, 2) / step
    noise = rng.uniform(0.05, 0.35)
    shows_grass = rng.random() < 0.5
    top = _on_top(world)
    scores = np.empty((len(_SHOWN), grid.rows, grid.cols), dtype=np.float32)
    affine = _to_map(world.grid, grid, shift)
    for number, name in enumerate(_SHOWN):
        share = cv2.GaussianBlur((top == CLASS_INDEX[name]).astype(np.float32), (0, 0), smear_px)
        seen = cv2.warpAffine(
            share, affine, (grid.cols, grid.rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        scores[number] = seen + noise * (seen > 0.01) * smooth_noise(grid, 3.0, rng)
    if not shows_grass:  # ground is ground, whatever grows on it
        scores[0] += scores[_SHOWN.index("grass")]
        scores[_SHOWN.index("grass")] = -np.inf
    classes = np.array([CLASS_INDEX[name] for name in _SHOWN], dtype=np.uint8)[scores.argmax(axis=0)]
    return MapRaster.from_classes(grid, classes)


def _on_top(world: World) -> NDArray[np.uint8]:
    """Class (rows, cols) of what is highest in each of the world's cells."""
    by_material = np.full(max(Material) + 1, CLASS_INDEX["void"], dtype=np.uint8)
    for material, name in _SURFACES.items():
        by_material[material] = CLASS_INDEX[name]
    top = by_material[world.material]
    plants = world.canopy_top * np.float32(HEIGHT_STEP_M)
    grown = (plants > _LEAST_PLANT_M) & (plants > world.surface - world.ground)
    top[grown] = CLASS_INDEX["forest"]
    return top


def _to_map(world: MapGrid, grid: MapGrid, shift_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Affine (2, 3) from the map's pixels (column, row; integers at centres) to the world's, shifted by some cells."""
    scale = grid.metres_per_pixel / world.metres_per_pixel
    corner = grid.xy_from_pixel(np.array([0.5, 0.5]))  # middle of the map's first pixel
    row, col = world.pixel_from_xy(corner) - 0.5
    return np.array([[scale, 0.0, col + shift_px[0]], [0.0, scale, row + shift_px[1]]])
