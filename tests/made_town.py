"""A made-up town, a network that has learned nothing, and an embedding of its features, for tests of retrieval."""

import numpy as np
import torch
from numpy.typing import NDArray

from fusion.grid import MapGrid
from learned.bev import BevSettings
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.place_embedding import PlaceEmbedding
from learned.retrieval import fingerprint_of
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings

RINGS = RingHarmonics((4.0, 8.0, 12.0, 16.0), orders=6, cell_m=2.0, reach_m=20.0)
TOWN = MapGrid(400, 480, 0.5, -50.0, 20.0)


def small_rotmatch() -> RotMatch:
    """One that has learned nothing."""
    torch.manual_seed(0)
    return RotMatch(RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8), BevSettings(20.0))))


def embedding_of(matcher: RotMatch, rings: RingHarmonics = RINGS) -> PlaceEmbedding:
    """Random projections, the same for scans and maps."""
    generator = torch.Generator().manual_seed(1)
    features = 4 * len(rings.rings_m)
    weights = torch.randn(rings.orders + 1, features, 5, generator=generator, dtype=torch.complex64)
    zero = torch.zeros(features)
    return PlaceEmbedding(weights, weights, zero, zero, fingerprint_of(matcher.net), rings)


def town() -> MapRaster:
    """Two roads and blocks of houses at random."""
    rng = np.random.default_rng(0)
    classes = np.zeros((TOWN.rows, TOWN.cols), np.uint8)
    for _ in range(120):
        row, col = rng.integers(0, TOWN.rows), rng.integers(0, TOWN.cols)
        classes[row : row + rng.integers(8, 40), col : col + rng.integers(8, 40)] = CLASS_INDEX["building"]
    classes[190:206], classes[:, 230:246] = CLASS_INDEX["road"], CLASS_INDEX["road"]
    return MapRaster.from_classes(TOWN, classes)


def made_points() -> NDArray[np.float32]:
    """Returns (4000, 4) all around."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-18, 18, (4000, 2)), rng.uniform(-1.7, 2.0, 4000), np.zeros(4000)])
    return points.astype(np.float32)
