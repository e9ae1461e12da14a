"""Matchers that can look for a vehicle anywhere on a map, and how to ask one for it.

A matcher that votes can (`learned.map_search`). One that sees a fixed crop cannot: its answers for two crops are
normalised each by itself, and nothing says which of the crops fits better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.two_level import TwoLevelLikelihood
from learned.bev import BevSettings, bev_counts
from learned.map_raster import MapRaster
from learned.map_search import MapSearch
from learned.matcher import MapMatcher


class WholeMapSearch(Protocol):
    """A matcher's search of one whole map."""

    def match(self, points: NDArray[np.float32], ground_z: float, near: FloatArray | None = None) -> TwoLevelLikelihood:
        """Likelihood of all poses on the map given one scan.

        Parameters
        ----------
        points, ground_z
            As in `learned.matcher.MapMatcher.match`.
        near
            (M, 3) poses about which it is to look closely in any case.
        """
        ...

    def contrast(self, points: NDArray[np.float32], ground_z: float, pose: FloatArray, reach: FloatArray) -> float:
        """By how many nats the best place on the map fits one scan better than the best within reach of a pose.

        Parameters
        ----------
        points, ground_z
            As in `learned.matcher.MapMatcher.match`.
        pose, reach
            (3,) each: a box of `reach` to both sides of the pose, metres, metres, radians.
        """
        ...


@runtime_checkable
class WholeMapMatcher(Protocol):
    """A `MapMatcher` that can search a whole map."""

    def over_map(self, map_raster: MapRaster) -> WholeMapSearch | None:
        """Prepare a map, which may take seconds, to be searched with scans; None when the network cannot."""
        ...


def search_over(matcher: MapMatcher, map_raster: MapRaster) -> WholeMapSearch:
    """The matcher's search of a whole map.

    Raises
    ------
    SkyfixError
        If the matcher has none, or the map is too large or lacks what the matcher needs.
    """
    search = matcher.over_map(map_raster) if isinstance(matcher, WholeMapMatcher) else None
    if search is None:
        raise SkyfixError(
            f"whole-map search: expected a matcher that votes over any map (rotmatch, geometric, hybrid), "
            f"got {matcher.name}, which sees a fixed crop"
        )
    return search


@dataclass(frozen=True, slots=True)
class VotedMapSearch:
    """A `WholeMapSearch` by voting.

    Attributes
    ----------
    bev
        The bird's-eye view that the scan's features are made of.
    features
        Gives the scan's features (C, n, n) and the map to search with them, from counts (bands, n, n).
    """

    bev: BevSettings
    features: Callable[[NDArray[np.float32]], tuple[Tensor, MapSearch]]

    def match(self, points: NDArray[np.float32], ground_z: float, near: FloatArray | None = None) -> TwoLevelLikelihood:
        """See `WholeMapSearch.match`."""
        scan, search = self.features(bev_counts(points, ground_z, self.bev))
        return search.likelihood(scan, near)

    def contrast(self, points: NDArray[np.float32], ground_z: float, pose: FloatArray, reach: FloatArray) -> float:
        """See `WholeMapSearch.contrast`."""
        scan, search = self.features(bev_counts(points, ground_z, self.bev))
        return search.contrast(scan, pose, reach)
