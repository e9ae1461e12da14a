"""Random cells: from a mass, and backward through a motion, from where mass arrived to where it came from.

A cell that mass arrived in is drawn back along all ways that lead there: the neighbour's plane that a heading error
brought it from, the position's error, the blur before. Each way has its share in the operator, and its start the mass
that was there; their product is the chance of having come that way.
"""

import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.grids.grid_kernels import DIRECTIONS
from fusion.grids.grid_motion import GridMotion

_BLOCK = 2**20  # ways looked at together


def draw_cells(mass: Float32Array, count: int, rng: np.random.Generator) -> IntArray:
    """Draw cells (count, 3), each (plane, row, col), by their mass (K, rows, cols)."""
    by_plane = np.cumsum(mass.sum(axis=(1, 2), dtype=np.float64))
    planes = np.searchsorted(by_plane, rng.random(count) * by_plane[-1], side="right")
    cells = np.empty((count, 3), dtype=np.int64)
    cells[:, 0] = np.minimum(planes, len(mass) - 1)
    where = rng.random(count)
    for plane in np.unique(cells[:, 0]):
        chosen = np.flatnonzero(cells[:, 0] == plane)
        inside = np.cumsum(mass[plane], dtype=np.float64)
        flat = np.minimum(np.searchsorted(inside, where[chosen] * inside[-1], side="right"), inside.size - 1)
        cells[chosen, 1:] = np.stack(np.divmod(flat, mass.shape[2]), axis=-1)
    return cells


def draw_sources(mass: Float32Array, motion: GridMotion, cells: IntArray, rng: np.random.Generator) -> IntArray:
    """For every cell (N, 3) after a motion, draw the cell before it, given the mass (K, rows, cols) before."""
    sources = np.empty_like(cells)
    where = rng.random(len(cells))
    for plane in np.unique(cells[:, 0]):
        ways = _ways_into(motion, int(plane))
        chosen = np.flatnonzero(cells[:, 0] == plane)
        for part in np.array_split(chosen, max(1, len(chosen) * len(ways[0]) // _BLOCK)):
            sources[part] = _drawn(mass, ways, cells[part, 1:], where[part])
    return sources


_Ways = tuple[IntArray, IntArray, FloatArray]


def _ways_into(motion: GridMotion, plane: int) -> _Ways:
    """All ways into a plane: source planes (W,), cells at the start relative to the end (W, 2), shares (W,)."""
    taps = motion.gathering
    planes, starts, shares = [], [], []
    blurs: dict[int, tuple[IntArray, FloatArray]] = {}
    for source, stop, share in zip(taps.planes[plane].tolist(), taps.cells[plane], taps.weights[plane], strict=True):
        if share == 0.0:
            continue
        if source not in blurs:
            blurs[source] = _blur(motion, source)
        offsets, weights = blurs[source]
        planes.append(np.full(len(weights), source))
        starts.append(stop - motion.steps[source] + offsets)
        shares.append(np.float64(share) * weights)
    return np.concatenate(planes), np.concatenate(starts), np.concatenate(shares)


def _blur(motion: GridMotion, plane: int) -> tuple[IntArray, FloatArray]:
    """The blur of a plane in one: offsets (B, 2) and weights (B,), the three line blurs multiplied out."""
    vectors, taps, radii = (of[plane] for of in motion.noise.lines)
    reach = int((radii[:, None] * np.abs(vectors)).sum(axis=0).max())
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    kernel[reach, reach] = 1.0
    for d in range(DIRECTIONS):
        blurred = taps[d, 0] * kernel
        for n in range(1, int(radii[d]) + 1):
            for way in (n, -n):
                blurred += taps[d, n] * np.roll(kernel, way * vectors[d], axis=(0, 1))
        kernel = blurred
    offsets = np.argwhere(kernel > 0.0)
    return offsets - reach, kernel[tuple(offsets.T)]


def _drawn(mass: Float32Array, ways: _Ways, cells: IntArray, where: FloatArray) -> IntArray:
    """One way back for each of the cells (N, 2) of a plane; `where` (N,) uniform in [0, 1)."""
    planes, starts, shares = ways
    start = cells[:, None] + starts
    inside = np.asarray(((start >= 0) & (start < mass.shape[1:])).all(axis=-1))
    row, col = np.where(inside[..., None], start, 0).transpose(2, 0, 1)
    chances = np.where(inside, mass[planes, row, col] * shares, 0.0)
    cumulative = np.cumsum(chances, axis=1)
    way = (cumulative <= where[:, None] * cumulative[:, -1:]).sum(axis=1)
    every = np.arange(len(cells))
    return np.column_stack([planes[way], start[every, way]])
