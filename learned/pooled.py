"""Several matchers asked about each scan, their likelihoods pooled: right where one of them errs by itself.

The pool is logarithmic, a weighted geometric mean of densities (Genest & Zidek, "Combining probability distributions",
Statistical Science 1986): a place that any of them rules out is ruled out, and errors that they share, those of the map
above all, are not counted twice as a product would.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from learned.answers import match_scan
from learned.checkpoint import load_checkpoint
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion, error_correlation_length_m, largest_half_extent_m
from learned.rotmatch import RotMatch
from learned.whole_map import WholeMapMatcher, WholeMapSearch

_SHIPPED_WEIGHTS = (2.0, 1.0)
"""Of RotMatch and the hybrid: in Helsinki the former errs half as often."""


class PooledMatcher:
    """Implements `learned.matcher.MapMatcher`, and a whole-map search where the first of its matchers has one.

    Parameters
    ----------
    matchers
        One or more. The first one's cells are those of the answer.
    weights
        Of the matchers, positive; what counts is their proportion. Equal where left out.

    Raises
    ------
    SkyfixError
        If there is no matcher, or the weights are not one positive number each.
    """

    def __init__(self, matchers: Sequence[MapMatcher], weights: Sequence[float] | None = None) -> None:
        given = np.ones(len(matchers)) if weights is None else np.asarray(weights, np.float64)
        if len(matchers) == 0 or given.shape != (len(matchers),) or not (np.isfinite(given) & (given > 0.0)).all():
            raise SkyfixError(
                f"pooled matcher: expected matchers and a positive weight each, got {len(matchers)} and {weights}"
            )
        self.matchers = tuple(matchers)
        self.shares: FloatArray = given / given.sum()

    @classmethod
    def shipped(cls) -> Self:
        """RotMatch and the hybrid with the weights that come with the package."""
        with resources.as_file(resources.files("learned") / "weights" / "hybrid.safetensors") as path:
            return cls([RotMatch.shipped(), load_checkpoint(path)], _SHIPPED_WEIGHTS)

    @property
    def name(self) -> str:
        """Short name for tables."""
        return "pooled"

    @property
    def error_correlation_length_m(self) -> float:
        """The longest of any matcher's, metres."""
        return max(matcher.error_correlation_length_m for matcher in self.matchers)

    def error_correlation_length_on(self, map_raster: MapRaster) -> float:
        """The same on one map; see `learned.matcher.MapDependentErrors`."""
        return max(error_correlation_length_m(matcher, map_raster) for matcher in self.matchers)

    @property
    def largest_half_extent_m(self) -> float:
        """The smallest of any matcher's; see `learned.matcher.BoundedMatcher`."""
        return min(largest_half_extent_m(matcher) for matcher in self.matchers)

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """The pool of all answers; see `learned.matcher.MapMatcher.match`."""
        volumes = [match_scan(matcher, points, ground_z, map_raster, search) for matcher in self.matchers]
        first = volumes[0]
        valid = first.log_prob > first.floor
        scores = np.zeros(first.log_prob.shape)
        for volume, share in zip(volumes, self.shares, strict=True):
            scores[valid] += share * _at(volume, first, valid)
        return LikelihoodVolume.from_scores(scores, first.grid, valid=valid)

    def over_map(self, map_raster: MapRaster) -> WholeMapSearch | None:
        """The first matcher's search of a whole map; None where it has none."""
        first = self.matchers[0]
        return first.over_map(map_raster) if isinstance(first, WholeMapMatcher) else None


def _at(volume: LikelihoodVolume, like: LikelihoodVolume, valid: NDArray[np.bool_]) -> FloatArray:
    """Log densities of a volume at some cells of another one."""
    if volume.grid == like.grid and volume.log_prob.shape == like.log_prob.shape:
        return volume.log_prob[valid].astype(np.float64)
    row, col, turn = np.nonzero(valid)
    xy = like.grid.xy_from_pixel(np.column_stack([row, col]) + 0.5)
    return volume.log_density(np.column_stack([xy, se2.wrap(turn * (se2.TWO_PI / valid.shape[2]))]))
