"""The baseline with no learning: hand-made features of scan and map, matched by voting.

Three statements, each a term of one correlation: things that stand up lie on mapped walls, fences, hedges and
building outlines; they do not lie inside buildings; ground that the scan sees is near roads and not under buildings.
It is hard to beat and shows at once when an axis or a sign is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from learned.bev import BODY, GROUND, HIGH, BevSettings, bev_counts
from learned.map_lattice import MapLattice, MapSearchSettings
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.map_search import MapSearch
from learned.matcher import SearchRegion, matching_window
from learned.voting import bin_yaws, volume_from_scores, vote, yaw_bins_within
from learned.whole_map import VotedMapSearch, WholeMapSearch

_LINE_STRENGTH = {"wall": 1.0, "fence": 1.0, "hedge": 0.7, "tree": 0.4}


@dataclass(frozen=True, slots=True)
class GeometricWeights:
    """Weights per obstacle cell (wall, interior) and per ground cell (road, building); widths of the soft edges."""

    wall: float = 1.0
    interior: float = 1.5
    road: float = 0.05
    ground_in_building: float = 0.4
    wall_width_m: float = 0.5
    road_width_m: float = 3.0


@dataclass(frozen=True, slots=True)
class GeometricMatcher:
    """Hand-made features through voting; implements `learned.matcher.MapMatcher`.

    Attributes
    ----------
    yaw_bins
        Heading bins over the full circle (360: 1 degree each).
    temperature
        Divides the scores before they are normalised; fitted on simulated neighbourhoods.
    error_correlation_length_m
        Distance over which the errors of neighbouring frames decorrelate: they come from the map and from what the
        map lacks.
    """

    bev: BevSettings = field(default_factory=lambda: BevSettings(half_extent_m=72.0))
    weights: GeometricWeights = field(default_factory=GeometricWeights)
    yaw_bins: int = 360
    temperature: float = 19.0
    error_correlation_length_m: float = 6.0
    name: str = "geometric"

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Likelihood of the poses in the search region; see `learned.matcher.MapMatcher.match`."""
        return self.match_counts(bev_counts(points, ground_z, self.bev), map_raster, search)

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Match a bird's-eye view (bands, n, n) that has been made already."""
        mpp = self.bev.metres_per_pixel
        reach = self.bev.size / 2 * mpp
        crop = map_raster.resampled(matching_window(map_raster, search, reach, mpp))
        bins = yaw_bins_within(float(search.centre[2]), search.half_heading_rad, self.yaw_bins)
        scan = scan_features(counts)
        with torch.inference_mode():
            scores = vote(map_features(crop, self.weights), scan, bin_yaws(bins, self.yaw_bins))
        return volume_from_scores(scores / self.temperature, bins, self.yaw_bins, crop.grid)

    def over_map(self, map_raster: MapRaster) -> WholeMapSearch:
        """Prepare a whole map, see `learned.whole_map.WholeMapMatcher`."""
        settings = MapSearchSettings()
        mpp, size = self.bev.metres_per_pixel, self.bev.size
        lattice = MapLattice.over(map_raster.grid, mpp, size, self.yaw_bins, 1, settings)
        found = map_features(map_raster.resampled(lattice.window), self.weights)
        search = MapSearch(found, lattice, self.yaw_bins, self.temperature, settings)
        return VotedMapSearch(self.bev, lambda counts: (scan_features(counts), search))


def scan_features(counts: NDArray[np.float32]) -> Tensor:
    """Obstacle and visible-ground images (2, n, n) of a bird's-eye view's counts."""
    standing = counts[BODY] + counts[HIGH]
    obstacle = np.minimum(np.log1p(standing) / 2, 1.0)
    ground = (counts[GROUND] > 0) & (standing == 0)
    return torch.from_numpy(np.stack([obstacle, ground.astype(np.float32)]))


def map_features(crop: MapRaster, weights: GeometricWeights) -> Tensor:
    """What an obstacle and what visible ground is worth at each pixel of the map, (2, rows, cols) float32."""
    if crop.classes is None:
        raise SkyfixError("geometric matcher: expected a map with classes (buildings, roads), got a photograph")
    mpp = crop.grid.metres_per_pixel
    building = (crop.classes == CLASS_INDEX["building"]).astype(np.uint8)
    strength = (building - cv2.erode(building, np.ones((3, 3), np.uint8))).astype(np.float32)
    for name, value in _LINE_STRENGTH.items():
        strength[crop.classes == CLASS_INDEX[name]] = value
    wall = np.zeros(strength.shape, dtype=np.float32)
    for value in sorted(set(_LINE_STRENGTH.values())):
        wall = np.maximum(wall, value * _soft(strength >= value, weights.wall_width_m / mpp))
    interior = cv2.erode(building, np.ones((5, 5), np.uint8)).astype(np.float32)
    road = _soft(crop.classes == CLASS_INDEX["road"], weights.road_width_m / mpp)
    obstacle_value = weights.wall * wall - weights.interior * interior
    ground_value = weights.road * road - weights.ground_in_building * building
    return torch.from_numpy(np.stack([obstacle_value, ground_value]).astype(np.float32))


def _soft(mask: NDArray[np.bool_], sigma_pixels: float) -> NDArray[np.float32]:
    """One on the mask, falling off with distance as a Gaussian of the given width."""
    if not mask.any():
        return np.zeros(mask.shape, dtype=np.float32)
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return np.exp(-0.5 * (distance / sigma_pixels) ** 2).astype(np.float32)
