"""A global start: particles all over a map, stratified, so that none of it is left bare by chance.

The allowed pixels are taken row by row and cut into as many equal parts as there are particles, with one particle at
a random place in each; its heading follows the golden ratio around the circle from a random start, so that any run of
neighbours has its headings spread evenly. Every particle is uniform by itself. Neighbours in the list are neighbours on
the map, which keeps the memory that a filter step touches together.

Source: the golden-ratio sequence has the lowest discrepancy of all additive recurrences, see Kuipers, Niederreiter,
"Uniform distribution of sequences", 1974, 2.3.
"""

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid

_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def stratified_poses(
    grid: MapGrid, count: int, rng: np.random.Generator, allowed: ArrayLike | None = None
) -> FloatArray:
    """Poses (count, 3), uniform over the allowed pixels of a map and over all headings.

    Parameters
    ----------
    grid : MapGrid
        The map.
    count : int
        At least 1.
    rng : numpy Generator
        Source of randomness.
    allowed : (rows, cols) bool array_like, optional
        Where the vehicle can be, roads say; everywhere when left out.

    Raises
    ------
    SkyfixError
        When `count` is not positive, or `allowed` has another shape or allows nothing.
    """
    if count < 1:
        raise SkyfixError(f"particles: expected at least one, got {count}")
    mask = np.ones((grid.rows, grid.cols), np.bool_) if allowed is None else np.asarray(allowed, dtype=np.bool_)
    if mask.shape != (grid.rows, grid.cols):
        raise SkyfixError(f"allowed: expected ({grid.rows}, {grid.cols}), got {mask.shape}")
    pixels = np.flatnonzero(mask)
    if len(pixels) == 0:
        raise SkyfixError("allowed: expected at least one pixel, got none")
    place = (np.arange(count) + rng.random(count)) * (len(pixels) / count)
    which = np.minimum(place.astype(np.int64), len(pixels) - 1)
    row, col = np.divmod(pixels[which], grid.cols)
    inside = np.column_stack([rng.random(count), rng.random(count)])
    xy = grid.xy_from_pixel(np.column_stack([row, col]) + inside)
    turns = (rng.random() + _GOLDEN * np.arange(count)) % 1.0
    return np.column_stack([xy, se2.wrap(turns * se2.TWO_PI)])
