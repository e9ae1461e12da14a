"""Particles in the order of where they are: a counting sort by tiles of the plane, row after row.

Particles that are weighed one after the other then read the same part of a likelihood, while it is in the cache.
"""

import numba
import numpy as np

from fusion.kernels.float_math import KERNEL, F, get, larger, near, put, take, widest
from fusion.kernels.layout import BLOCK, Float32s, Float64s, Int32s

SIDE = 64
"""Tiles in a row, and rows."""
_LAST = F(SIDE - 1)
_STREAMS = 4  # parts of the cloud that are counted in turn: neighbours would wait for each other's tile


@numba.njit(**KERNEL)
def find_tiles(first: int, last: int, source: Float32s, ancestors: Int32s, box: Float64s, tiles: Int32s) -> None:
    """Tile of each copy in blocks `first` to `last`.

    Parameters
    ----------
    source, ancestors
        (3 M,) x, y, yaw, and (N,) whose copies.
    box
        (4,) x and y of the corner, tiles per metre along x and y; what lies outside belongs to the nearest tile.
    tiles
        (N,) to fill.
    """
    widest()
    many = source.size // 3
    xs, ys = source[:many], source[many : 2 * many]
    west, south, along, up = F(box[0]), F(box[1]), F(box[2]), F(box[3])
    for i in range(first * BLOCK, min(last * BLOCK, len(ancestors))):
        one = take(ancestors, np.int32(i))
        col = np.int32(min(larger((take(xs, one) - west) * along, F(0.0)), _LAST))
        row = np.int32(min(larger((take(ys, one) - south) * up, F(0.0)), _LAST))
        put(tiles, i, np.int32(np.int32(row * np.int32(SIDE)) + col))


@numba.njit(**KERNEL)
def sort_by_tile(ancestors: Int32s, tiles: Int32s, ordered: Int32s) -> None:
    """Write the ancestors (N,) into `ordered` by their tiles (N,)."""
    places, count = np.zeros(SIDE * SIDE + 1, np.int32), len(ancestors)
    stream = count // _STREAMS
    for i in range(stream):
        for part in range(_STREAMS):
            tile = np.int64(near(tiles, part * stream + i))
            put(places, tile + 1, np.int32(get(places, tile + 1) + 1))
    for i in range(_STREAMS * stream, count):
        places[tiles[i] + 1] += 1
    for one in range(SIDE * SIDE):
        places[one + 1] += places[one]
    for i in range(stream):
        for part in range(_STREAMS):
            tile = np.int64(near(tiles, part * stream + i))
            place = get(places, tile)
            put(ordered, np.int64(place), near(ancestors, part * stream + i))
            put(places, tile, np.int32(place + 1))
    for i in range(_STREAMS * stream, count):
        ordered[places[tiles[i]]] = ancestors[i]
        places[tiles[i]] += 1
