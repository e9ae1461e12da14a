"""A matcher is asked about a scan, and its answer looked at: it may be one of the user's own."""

from __future__ import annotations

import importlib
import sys
import traceback
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.likelihood import LikelihoodVolume
from fusion.location_orientation import LocationOrientationMaps
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion


def match_scan(
    matcher: MapMatcher, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
) -> LikelihoodVolume:
    """A matcher's answer as a volume; parameters are those of `learned.matcher.MapMatcher.match`.

    Raises
    ------
    SkyfixError
        If the matcher fails, or answers with no likelihood or one of another place.
    """
    try:
        answer: object = matcher.match(points, ground_z, map_raster, search)
        if isinstance(answer, LocationOrientationMaps | GaussianLikelihood):
            answer = answer.to_volume()
    except SkyfixError:
        raise
    except Exception as error:
        file = getattr(sys.modules.get(type(matcher).__module__), "__file__", None)
        raise SkyfixError(f"matcher {matcher.name}: match() failed: {failure_line(error, file)}") from error
    if not isinstance(answer, LikelihoodVolume):
        kind = type(answer).__name__
        raise SkyfixError(f"matcher {matcher.name}: expected match() to answer with a LikelihoodVolume, got {kind}")
    grid = answer.grid
    apart = np.abs(grid.centre_xy - search.centre[:2])
    if (apart > search.half_extent_m + 0.5 * np.array([grid.width_m, grid.height_m])).any():
        asked, got = (f"x {x:.0f} y {y:.0f}" for x, y in (search.centre[:2], grid.centre_xy))
        raise SkyfixError(f"matcher {matcher.name}: expected an answer about {asked}, got one about {got}")
    return answer


def failure_line(error: BaseException, file: str | None = None) -> str:
    """An error in one line: what it is, and where it came up, in a file if that is given and was passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<")]
    others = (str(Path(__file__).parent), str(Path(importlib.__file__).parent))
    theirs = [frame for frame in frames if not frame.filename.startswith(others)]
    at = [frame for frame in frames if frame.filename == file] or theirs
    where = f" ({Path(at[-1].filename).name}, line {at[-1].lineno})" if at else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"
