"""What turns a scan and a map into a likelihood: the protocol of every network and baseline, and how one is loaded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.location_orientation import LocationOrientationMaps
from learned.map_raster import MapRaster

_NAMES = ("rotmatch", "pooled", "geometric")


@dataclass(frozen=True, slots=True)
class SearchRegion:
    """Where to look: a square of positions about a centre and a range of headings about its yaw.

    Attributes
    ----------
    centre
        (3,) x, y (metres, map frame), yaw (radians).
    half_extent_m
        Half the side of the square of positions, metres.
    half_heading_rad
        Headings within this of the centre's; pi means any.
    """

    centre: NDArray[np.float64]
    half_extent_m: float
    half_heading_rad: float = math.pi

    def __post_init__(self) -> None:
        if np.shape(self.centre) != (3,) or not np.isfinite(self.centre).all():
            raise SkyfixError(f"search centre: expected three finite numbers (x, y, yaw), got {self.centre}")
        if not (self.half_extent_m > 0 and self.half_heading_rad > 0):
            raise SkyfixError(
                f"search region: expected positive ranges, got {self.half_extent_m} m and {self.half_heading_rad} rad"
            )


class MapMatcher(Protocol):
    """A measurement model: one scan against one map, over a region of poses."""

    @property
    def name(self) -> str:
        """Short name for tables."""
        ...

    @property
    def error_correlation_length_m(self) -> float:
        """Distance travelled over which errors of neighbouring frames decorrelate (1/e), metres."""
        ...

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume | LocationOrientationMaps | GaussianLikelihood:
        """Likelihood of the poses in the search region given one scan.

        Parameters
        ----------
        points
            (N, 4) float32 x, y, z, reflectance in the body frame, metres.
        ground_z
            Height of the ground under the vehicle in the scan's frame, metres.
        map_raster
            The map, of any size and resolution; what is needed is cut out.
        search
            The poses to score; others get the floor.

        Raises
        ------
        SkyfixError
            If the scan is empty or not finite, or the map lacks what the matcher needs.
        """
        ...


@runtime_checkable
class BoundedMatcher(Protocol):
    """A `MapMatcher` that refuses searches of more than some extent: one whose network sees a crop of one size."""

    @property
    def largest_half_extent_m(self) -> float:
        """Half the side of the largest square of positions that it searches, metres."""
        ...


@runtime_checkable
class MapDependentErrors(Protocol):
    """A `MapMatcher` whose errors repeat over another distance on some maps than on others."""

    def error_correlation_length_on(self, map_raster: MapRaster) -> float:
        """Distance travelled over which errors of neighbouring frames decorrelate on this map (1/e), metres."""
        ...


def error_correlation_length_m(matcher: MapMatcher, map_raster: MapRaster) -> float:
    """Distance over which a matcher's errors decorrelate on a map, metres; the matcher's own where maps are alike."""
    if isinstance(matcher, MapDependentErrors):
        return matcher.error_correlation_length_on(map_raster)
    return matcher.error_correlation_length_m


def largest_half_extent_m(matcher: MapMatcher) -> float:
    """Half the side of the largest square of positions that a matcher searches, metres; infinite where it says none."""
    return matcher.largest_half_extent_m if isinstance(matcher, BoundedMatcher) else math.inf


def matching_window(
    map_raster: MapRaster, search: SearchRegion, reach_m: float, metres_per_pixel: float, multiple_of: int = 2
) -> MapGrid:
    """Grid of the map crop that a search needs: positions within the half extent, and the scan's reach around them.

    It is snapped to the map's pixels where both have the same resolution, so that cropping copies pixels and does not
    resample. Its side is a multiple of an even number of pixels (what a network's strides ask for).
    """
    size = multiple_of * math.ceil(2 * (search.half_extent_m + reach_m) / metres_per_pixel / multiple_of)
    half_pixels = size // 2
    grid = map_raster.grid
    corner = np.asarray(search.centre[:2], dtype=np.float64) - half_pixels * metres_per_pixel
    steps = np.round((corner - (grid.x0, grid.y0)) / metres_per_pixel)
    x0, y0 = np.array([grid.x0, grid.y0]) + steps * metres_per_pixel
    return MapGrid(size, size, metres_per_pixel, float(x0), float(y0))


def load_matcher(name_or_path: str, backend: str | None = None) -> MapMatcher:
    """Load a matcher by name or from a file.

    'rotmatch' is the shipped network, 'pooled' asks the shipped hybrid beside it, 'geometric' has learned nothing.

    A checkpoint's .json says which network it is of, see `learned.checkpoint.load_checkpoint`.

    Parameters
    ----------
    name_or_path
        A name, a .safetensors file, a folder that `learned.export.export` wrote, or a matcher of one's own as
        `learned.own_matcher` names it: 'mine.py:MyNetwork'.
    backend
        What runs the encoders: 'torch' or a name of `learned.backends.BACKENDS`. None: torch; for a folder, the first
        runtime that is installed.

    Raises
    ------
    SkyfixError
        If a name is unknown, the file is missing, the checkpoint does not match this version's network, the
        backend is not installed or cannot run the matcher, or one's own cannot be imported.
    """
    from learned.backends import backend_named
    from learned.exported import load_exported, with_backend
    from learned.own_matcher import load_own_matcher, own_matcher_named

    runtime = None if backend in (None, "torch") else backend_named(str(backend))
    path = Path(name_or_path)
    if name_or_path not in _NAMES and path.is_dir():
        if backend == "torch":
            raise SkyfixError(f"backend: expected openvino or onnxruntime for the export {path}, got torch")
        return load_exported(path, runtime)
    own = own_matcher_named(name_or_path)
    matcher = _torch_matcher(name_or_path) if own is None else load_own_matcher(own)
    return matcher if runtime is None else with_backend(matcher, runtime)


def _torch_matcher(name_or_path: str) -> MapMatcher:
    from learned.checkpoint import load_checkpoint
    from learned.geometric import GeometricMatcher
    from learned.pooled import PooledMatcher
    from learned.rotmatch import RotMatch

    if name_or_path == "geometric":
        return GeometricMatcher()
    if name_or_path == "rotmatch":
        return RotMatch.shipped()
    if name_or_path == "pooled":
        return PooledMatcher.shipped()
    path = Path(name_or_path)
    if path.suffix == ".safetensors":
        return load_checkpoint(path)
    expected = "'rotmatch', 'pooled', 'geometric', FILE.py:NAME, a .safetensors file or a folder of `skyfix export`"
    raise SkyfixError(f"matcher: expected {expected}, got {name_or_path!r}")
