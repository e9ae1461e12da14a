"""Maps of a world that are not drawn by surveyors: what an aerial image shows, segmented, or where one can drive.

OpenStreetMap draws what surveyors find worth drawing; a segmented aerial image shows every crown and hedge, hides what
is below them, and knows neither walls nor fences nor kinds of ground. A network that has seen only the former takes the
latter's vegetation for woods with free edges. Maps for driving (nuScenes) may show the carriageway alone, but all of
it, where OpenStreetMap has a line in its middle.
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
    for number, name in enumerate(_SHOWN):
        share = cv2.GaussianBlur((top == CLASS_INDEX[name]).astype(np.float32), (0, 0), smear_px)
        seen = _sampled(share, world.grid, grid, shift)
        scores[number] = seen + noise * (seen > 0.01) * smooth_noise(grid, 3.0, rng)
    if not shows_grass:  # ground is ground, whatever grows on it
        scores[0] += scores[_SHOWN.index("grass")]
        scores[_SHOWN.index("grass")] = -np.inf
    classes = np.array([CLASS_INDEX[name] for name in _SHOWN], dtype=np.uint8)[scores.argmax(axis=0)]
    return MapRaster.from_classes(grid, classes)


def drivable_map(world: World, grid: MapGrid, offset_m: float, rng: np.random.Generator) -> MapRaster:
    """Where one can drive, surveyed to a pixel, whatever stands there; parameters as for `overhead_map`."""
    shift = rng.normal(0.0, offset_m, 2) / world.grid.metres_per_pixel
    paved = np.isin(world.material, (Material.ROAD, Material.CAR)).astype(np.uint8)
    seen = cv2.morphologyEx(paved, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))  # poles are no holes
    here = _sampled(seen.astype(np.float32), world.grid, grid, shift) > 0.5
    classes = np.where(here, CLASS_INDEX["road"], CLASS_INDEX["void"]).astype(np.uint8)
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


def _sampled(
    layer: NDArray[np.float32], world: MapGrid, grid: MapGrid, shift_px: NDArray[np.float64]
) -> NDArray[np.float32]:
    """A layer of the world, shifted by some of its cells, at the map's pixels."""
    scale = grid.metres_per_pixel / world.metres_per_pixel
    row, col = world.pixel_from_xy(grid.xy_from_pixel(np.array([0.5, 0.5]))) - 0.5  # OpenCV has centres at integers
    affine = np.array([[scale, 0.0, col + shift_px[0]], [0.0, scale, row + shift_px[1]]])
    sampled = cv2.warpAffine(
        layer, affine, (grid.cols, grid.rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(sampled, dtype=np.float32)
