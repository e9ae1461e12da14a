"""Ground of a world: smooth noise, hills, banks beside roads, crowned carriageways and kerbs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from sequences.world_style import WorldStyle

_CROWN_SLOPE = 0.02
_BANK_START_M = 0.8


def smooth_noise(grid: MapGrid, wavelength_m: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Zero-mean noise (rows, cols) of unit variance that varies over about `wavelength_m`, by cubic upsampling."""
    rows = max(2, int(np.ceil(grid.height_m / (0.5 * wavelength_m))) + 1)
    cols = max(2, int(np.ceil(grid.width_m / (0.5 * wavelength_m))) + 1)
    coarse = rng.standard_normal((rows, cols)).astype(np.float32)
    fine = cv2.resize(coarse, (grid.cols, grid.rows), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine, dtype=np.float32)


def distance_m(mask: NDArray[np.uint8], grid: MapGrid) -> NDArray[np.float32]:
    """Distance (rows, cols) of every cell from the nearest cell that is set, metres; 0 on it."""
    if not mask.any():
        return np.full(mask.shape, 1e3, dtype=np.float32)
    distance = cv2.distanceTransform((mask == 0).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(distance, dtype=np.float32) * np.float32(grid.metres_per_pixel)


def terrain(
    grid: MapGrid, paved: NDArray[np.uint8], style: WorldStyle, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Height of the ground (rows, cols) and each cell's distance from the carriageway, both metres.

    Parameters
    ----------
    paved
        (rows, cols) non-zero on carriageways.
    """
    off_road = distance_m(paved, grid)
    x, y = grid.centres()
    towards = rng.uniform(0.0, 2.0 * np.pi)
    grade_x, grade_y = style.slope * np.cos(towards), style.slope * np.sin(towards)
    ground = ((x - x.mean()) * grade_x)[None, :] + ((y - y.mean()) * grade_y)[:, None]
    height = ground.astype(np.float32) + np.float32(style.hill_amplitude_m) * smooth_noise(grid, 90.0, rng)
    bank_width_m = rng.uniform(2.0, 8.0)
    bank = np.clip((off_road - _BANK_START_M) / bank_width_m, 0.0, 1.0, dtype=np.float32)
    bank *= bank * (np.float32(3.0) - np.float32(2.0) * bank)
    height += np.float32(style.bank_amplitude_m) * bank * (smooth_noise(grid, 45.0, rng) + np.float32(0.5))
    rough = np.clip(off_road / 3.0, 0.0, 1.0, dtype=np.float32)
    height += np.float32(style.roughness_m) * rough * smooth_noise(grid, 3.0, rng)
    inside = distance_m((paved == 0).astype(np.uint8), grid)
    height += np.float32(_CROWN_SLOPE) * np.minimum(inside, np.float32(4.0))
    height += np.float32(style.kerb_m) * (paved == 0)
    return height, off_road
