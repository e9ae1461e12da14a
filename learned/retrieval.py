"""Retrieval: where on a map a scan may have been taken, when nothing is known beforehand.

Looking a scan up in an index of the map (`learned.place_index`) costs a fraction of voting over the whole map
(`learned.map_search`), and hardly more on a larger map. The answer is a density over poses too, for a filter to take
particles from.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from fusion.arrays import BoolArray, FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.bev import bev_counts, log_density
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.network import picture_tensor
from learned.place_embedding import PlaceEmbedding
from learned.place_index import VOTE_CELLS, PlaceIndex, Retrieved
from learned.rotmatch import RotMatch, RotMatchNet

_INNER_CELLS, _MARGIN_CELLS = 256, 28
"""The map's features are made in windows, of which the middle is kept."""
_DRIVABLE = ("road", "path", "parking")
_BARRED = ("building", "water")
_AT_ONCE = 512
_LARGEST_TILE_M = 1e6


@dataclass(frozen=True, slots=True)
class TileSettings:
    """How a map is cut.

    Attributes
    ----------
    tile_m
        Side of a tile.
    step_m
        Places are the middles of cells of this side, a multiple of the vote's cells (2 m for the shipped network).
    road_within_m
        Cells with no road, path or car park this near are left out; on a map that has none of them, none are.

    Raises
    ------
    SkyfixError
        If a side is not positive and finite, the tile no multiple of the step, or the distance negative.
    """

    tile_m: float = 64.0
    step_m: float = 8.0
    road_within_m: float = 4.0

    def __post_init__(self) -> None:
        possible = 0.0 < self.step_m <= self.tile_m <= _LARGEST_TILE_M and self.road_within_m >= 0.0
        ratio = min(self.tile_m / self.step_m, _LARGEST_TILE_M) if possible else 0.0
        if not possible or abs(ratio - round(ratio)) > 1e-9:
            raise SkyfixError(f"tiles: expected a multiple of a positive step_m, got {self}")


class Retriever:
    """A network's features, embedded: makes an index of a map and looks scans up in it.

    Parameters
    ----------
    matcher
        Whose encoders are used.
    embedding
        Of its features; the shipped one where left out.

    Raises
    ------
    SkyfixError
        If the embedding was trained on the features of other weights.
    """

    def __init__(self, matcher: RotMatch, embedding: PlaceEmbedding | None = None) -> None:
        self._embedding = embedding or PlaceEmbedding.shipped()
        harmonics = self._embedding.harmonics
        if (weights := fingerprint_of(matcher.net)) != self._embedding.network:
            raise SkyfixError(
                f"place embedding: expected one of the features of weights {weights[:12]}, "
                f"got one of {self._embedding.network[:12]}"
            )
        self._net = matcher.net.reaching(harmonics.reach_m).eval()
        self._temperature = matcher.calibration.temperature
        self._harmonics, self._basis = harmonics, harmonics.basis()
        self._cell_m = self._net.stride * self._net.bev.metres_per_pixel
        self._pool = round(harmonics.cell_m / self._cell_m)

    def build(self, map_raster: MapRaster, settings: TileSettings | None = None) -> PlaceIndex:
        """Index a map.

        Raises
        ------
        SkyfixError
            If no place of it can be driven on, or its cells are no multiple of the vote's.
        """
        settings = settings or TileSettings()
        feature_m = VOTE_CELLS * self._cell_m
        per_cell = settings.step_m / feature_m
        if round(per_cell) < 1 or abs(per_cell - round(per_cell)) > 1e-9:
            raise SkyfixError(f"tiles: expected a step_m of a multiple of {feature_m:g} m, got {settings.step_m:g} m")
        grid = _covering(map_raster.grid, settings.step_m)
        cells = np.argwhere(_drivable(map_raster, grid, settings))
        if len(cells) == 0:
            raise SkyfixError("index: expected a map with somewhere to drive, got none")
        with torch.inference_mode():
            features, feature_grid = map_features(self._net, map_raster)
            embeddings = self._embedded(features, feature_grid, grid.xy_from_pixel(cells + 0.5))
        return PlaceIndex(
            grid,
            cells,
            embeddings.clone(),
            PlaceIndex.kept(features),
            self._cell_m,
            round(settings.tile_m / settings.step_m),
            self._temperature,
            self._embedding.fingerprint,
            map_digest(map_raster),
        )

    def query(
        self, index: PlaceIndex, points: NDArray[np.float32], ground_z: float, k: int = 10, shortlist: int = 1000
    ) -> Retrieved:
        """The `k` best tiles for a scan (N, 4) whose ground under the vehicle is at `ground_z`, metres.

        See `PlaceIndex.query`.

        Raises
        ------
        SkyfixError
            If the index was made by other weights or another embedding, or the scan or the height of its ground cannot
            be used.
        """
        if index.fingerprint != (made_by := self._embedding.fingerprint):
            raise SkyfixError(
                f"index: expected one of weights and embedding {made_by[:12]}, got one of {index.fingerprint[:12]}"
            )
        counts = bev_counts(points, ground_z, self._net.settings.bev)
        with torch.inference_mode():
            features = self._net.scan_features(torch.from_numpy(log_density(counts))[None].float())
            embedding = self._embedding.of_scans(self._harmonics_of(features))[0]
            return index.query(embedding, features[0], k, shortlist)

    def _harmonics_of(self, features: Tensor) -> Tensor:
        return self._harmonics.of(functional.avg_pool2d(features, self._pool), self._basis)

    def _embedded(self, features: Tensor, grid: MapGrid, xy: FloatArray) -> Tensor:
        """Embeddings of places (N, 2) of a map's features (C, rows, cols) on a grid."""
        pooled = functional.avg_pool2d(features[None], self._pool)[0]
        half = self._harmonics.size // 2
        windows = functional.pad(pooled, (half, half, half, half))
        windows = windows.unfold(1, 2 * half, 1).unfold(2, 2 * half, 1)
        corner = np.rint(grid.pixel_from_xy(xy) / self._pool).astype(np.int64)
        row, col = (torch.from_numpy(np.clip(corner[:, axis], 0, windows.shape[1 + axis] - 1)) for axis in (0, 1))
        found = []
        for start in range(0, len(xy), _AT_ONCE):
            block = slice(start, start + _AT_ONCE)
            images = windows[:, row[block], col[block]].transpose(0, 1)
            found.append(self._embedding.of_places(self._harmonics.of(images, self._basis)))
        return torch.cat(found)


def map_features(net: RotMatchNet, map_raster: MapRaster) -> tuple[Tensor, MapGrid]:
    """A whole map's features (C, rows, cols) and their grid, which begins at the map's upper left corner."""
    metres_per_pixel, grid = net.bev.metres_per_pixel, map_raster.grid
    cell_m = net.stride * metres_per_pixel
    inner, margin = _INNER_CELLS, _MARGIN_CELLS
    down, across = (math.ceil(extent / cell_m / inner) for extent in (grid.height_m, grid.width_m))
    side = (inner + 2 * margin) * net.stride
    features = torch.zeros(net.settings.channels, down * inner, across * inner)
    top = grid.y0 + grid.height_m
    for i in range(down):
        for j in range(across):
            x0 = grid.x0 + (j * inner - margin) * cell_m
            y0 = top - (i * inner - margin) * cell_m - side * metres_per_pixel
            window = map_raster.resampled(MapGrid(side, side, metres_per_pixel, x0, y0))
            found = net.map_features(picture_tensor(window.picture)[None])[0]
            rows, cols = slice(i * inner, (i + 1) * inner), slice(j * inner, (j + 1) * inner)
            features[:, rows, cols] = found[:, margin : margin + inner, margin : margin + inner]
    return features, MapGrid(down * inner, across * inner, cell_m, grid.x0, top - down * inner * cell_m)


def fingerprint_of(net: RotMatchNet) -> str:
    """SHA-256 of a network's weights."""
    digest = hashlib.sha256()
    for name, weight in sorted(net.state_dict().items()):
        digest.update(name.encode())
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def map_digest(map_raster: MapRaster) -> str:
    """SHA-256 of a map: where it lies and what it shows."""
    digest = hashlib.sha256(repr(map_raster.grid).encode())
    digest.update(map_raster.picture.tobytes())
    return digest.hexdigest()


def _covering(grid: MapGrid, step_m: float) -> MapGrid:
    rows, cols = (math.ceil(extent / step_m - 1e-9) for extent in (grid.height_m, grid.width_m))
    return MapGrid(rows, cols, step_m, grid.x0, grid.y0 + grid.height_m - rows * step_m)


def _drivable(map_raster: MapRaster, cells: MapGrid, settings: TileSettings) -> BoolArray:
    """Cells (rows, cols) in the middle of which a vehicle can be, more or less."""
    row, col = np.mgrid[0 : cells.rows, 0 : cells.cols]
    middle = map_raster.grid.pixel_from_xy(cells.xy_from_pixel(np.stack([row, col], axis=-1) + 0.5))
    inside = (middle[..., 0] < map_raster.grid.rows) & (middle[..., 1] < map_raster.grid.cols)
    if map_raster.classes is None:
        return inside
    at = tuple(np.where(inside, middle[..., axis], 0).astype(np.int64) for axis in (0, 1))
    allowed = inside & ~np.isin(map_raster.classes, [CLASS_INDEX[name] for name in _BARRED])[at]
    roads = np.isin(map_raster.classes, [CLASS_INDEX[name] for name in _DRIVABLE])
    if roads.any():
        away = cv2.distanceTransform((~roads).astype(np.uint8), cv2.DIST_L2, 5) * map_raster.grid.metres_per_pixel
        allowed &= away[at] <= settings.road_within_m
    return allowed
